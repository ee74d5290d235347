"""What planners lose, decision by decision, against the best message in each situation.

    python -m benchmarks.regret

The oracle's values say exactly what every message is worth to a simulated person, so what a planner
loses is known for each of its decisions, without the chance of the round. Losses are in units of
reward a round, costs included: by silence where something should have been said, and by messages
that were not the best. For people in fog of whom the posterior knows 20 rounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from torch import Tensor

from mirror_ppl.commands import fit
from mirror_ppl.communication import RoundSoFar
from mirror_ppl.domains.driving.oracle import Oracle
from mirror_ppl.domains.driving.people import SimulatedDrivers
from mirror_ppl.evaluation.assistance import PlannerOptions, Truth, play, speaker
from mirror_ppl.evaluation.assistance_cells import Pairing
from mirror_ppl.randomness import person_id
from mirror_ppl.training.experience import map_state


@dataclass(frozen=True)
class Options:
    """What to measure."""

    posterior: Path | None = None
    """Posterior of simulated people; they are fitted into runs/ unless given."""
    setting: str = "fog"
    """Setting of the domain."""
    population: str = "paper"
    """Who the people are."""
    people: tuple[int, ...] = (2, 4, 7)
    """Numbers of people among the ten, from 1."""
    rounds: int = 20
    """Rounds of each."""
    horizons: tuple[int, ...] = (6, 8, 10)
    """Steps looked ahead; each with each length of plans is a planner."""
    patience: tuple[int, ...] = (1, 3)
    """Steps of plans."""
    seed: int = 1
    """Seed of the rounds."""


def main(options: Options) -> None:
    """Run the study."""
    torch.set_num_threads(1)
    posterior = options.posterior
    if posterior is None:
        folder = Path(f"runs/regret_{options.setting}_{options.population}")
        posterior = folder / "posterior.nc"
        if not posterior.exists():
            fit.main(
                fit.Options(setting=options.setting, population=options.population, out=folder)
            )
    people = tuple(person_id(number - 1) for number in options.people)
    print(f"{'planner':<24} {'lost':>6} {'silent':>6} {'spoken':>6}")
    for horizon in options.horizons:
        for patience in options.patience:
            pairing = Pairing(
                posterior, None, None, 64, options.setting, options.population, 0, people,
                options.rounds, PlannerOptions.of("driving", horizon=horizon, patience=patience),
                options.seed, False, plan_anyway=True,
            )  # fmt: skip
            parts = torch.stack([lost(pairing, person) for person in people]).mean(0)
            columns = " ".join(f"{part:>6.3f}" for part in (parts.sum(), *parts))
            print(f"horizon {horizon:>2}, plans of {patience}   {columns}", flush=True)


def lost(pairing: Pairing, person: str) -> Tensor:
    """Units of reward that one person loses in a round: by silence, by messages ``[2]``."""
    (listener,) = pairing.listeners([person])
    say = speaker("mirror", listener, pairing.planner, pairing.seed + pairing.numbers[person])
    flags, actions = [], None

    def noted(rounds: Sequence[RoundSoFar], truth: Truth):
        nonlocal actions
        actions = torch.stack([past.actions for past in rounds])
        chosen, decisions = say(rounds, truth)
        flags.append(chosen)
        return chosen, decisions

    play(listener, noted)
    assert actions is not None
    said = torch.stack(flags, 1)
    # What the last action was does not matter any more.
    actions = torch.nn.functional.pad(actions, [0, 1])
    assert isinstance(listener.driver, SimulatedDrivers)
    oracle = Oracle(listener.driver, map_state(lambda part: part[0], listener.start.state))
    losses = oracle.losses(said, actions)
    spoke = said.any(-1)
    return torch.stack([losses[~spoke].sum(), losses[spoke].sum()]) / len(said)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
