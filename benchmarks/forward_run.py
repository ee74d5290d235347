"""How the program run forward differs from the simulator: action frequencies, step by step.

    python -m benchmarks.forward_run --output docs/results/forward_run.csv

2,000 people drawn from the prior act in a round each. Compared with the simulator are the program
in the domain's own world, in that of the self-model, and in that of the self-model's means (of
observations, then of states, too). Printed is, for each step, the largest difference of an action's
share between the two, how far it may be off by chance (three standard errors), and how far decoded
observations are from those of the state that the same actions lead to: the share of rounds of which
the ego's features differ, and the share of items of which anything does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pyro
import torch
import tyro
from pyro import poutine
from pyro.poutine.messenger import Messenger
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.domains.base import map_state, roll_out
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.models.world_program import TrueWorld

WORLDS = (
    ("driving", "fog", "mirror"),
    ("search_rescue", "smoke", "mirror"),
    ("bomb_defusal", "unlabelled", "policy-only"),
)
"""World, setting and human model; people are drawn from the prior, whatever the setting.

In bomb defusal the package's own model asks beforehand what is looked for at each stage, which
rounds that were not played yet do not say.
"""


@dataclass(frozen=True)
class Options:
    """What to measure."""

    people: int = 2000
    """Number of people."""
    steps: int = 15
    """Number of steps."""
    seed: int = 0
    """Seed of everything random."""
    output: Path | None = None
    """File for the table, as CSV."""


class Means(Messenger):
    """Takes the mean of the self-model's observations, and of its states if so said."""

    def __init__(self, names: tuple[str, ...]) -> None:
        super().__init__()
        self.names = names

    def _pyro_sample(self, msg: Any) -> None:
        if msg["name"].startswith(self.names) and not msg["done"]:
            msg["value"], msg["done"] = msg["fn"].mean, True


FORWARD: dict[str, Any] = {
    "true world": None,
    "self-model": Means(("nothing",)),
    "self-model, mean observations": Means(("observation_",)),
    "self-model, mean observations and states": Means(("observation_", "state_")),
}


def run_forward(
    human: HumanModel, rounds: Demonstrations, begin: Any, kind: str = "true world"
) -> tuple[Tensor, list[dict[str, Tensor]]]:
    """Let people who are drawn by the program act.

    Args:
        human: the model of people.
        rounds: of P people, one of each, as long as those to be drawn.
        begin: states ``[P]`` of the domain in which these begin.
        kind: one of ``FORWARD``, what there is to observe at later steps.

    Returns:
        Actions ``[P, T]``, and the observations drawn, in the networks' units, from the second
        step on.
    """
    first = human.domain.observe(begin)
    seen = rounds.observation()
    seen = {name: value[:, None, None].expand_as(seen[name]) for name, value in first.items()}
    rounds = Demonstrations.from_variables(
        rounds.domain, rounds.setting, rounds.people, {**rounds.variables(), **seen}
    )
    handler = FORWARD[kind]
    if handler is None:
        handler = TrueWorld(human.self_model, map_state(lambda part: part[:, None], begin))
    with torch.no_grad(), poutine.trace() as trace, handler:
        poutine.uncondition(human.model)(rounds, world=True)
    steps, names = range(rounds.shape[2]), human.self_model.decoders

    def drawn(site: str) -> Tensor:
        value = trace.trace.nodes[site]["value"]
        assert isinstance(value, Tensor)
        return value

    actions = torch.stack([drawn(f"action_{step}")[:, 0] for step in steps], -1)
    decoded = [{name: drawn(f"observation_{name}_{step}") for name in names} for step in steps[1:]]
    return actions, decoded


def counts(human: HumanModel, begin: Any, actions: Tensor) -> Tensor:
    """How often each action is done at each step, and how often none is any more, ``[T, A + 1]``.

    Args:
        human: the model of people.
        begin: states ``[P]`` in which rounds begin.
        actions: ``[P, T]``.
    """
    domain, number = human.domain, len(human.domain.actions)
    states = roll_out(domain, begin, actions.clamp(min=0))
    over = domain.over(map_state(lambda part: part[:, :-1], states)).cumsum(-1) > 0
    place = torch.where(over | (actions < 0), number, actions)
    return torch.nn.functional.one_hot(place, number + 1).sum(0).double()


def differences(
    human: HumanModel, begin: Any, actions: Tensor, decoded: list[dict[str, Tensor]]
) -> list[tuple[float, float]]:
    """Shares of egos and of items that were decoded wrongly, at each step from the second on."""
    domain, found = human.domain, []
    states = domain.observe(roll_out(domain, begin, actions))
    for step, one in enumerate(decoded, 1):
        now = domain.nearest(human.self_model.in_units(one))
        wrong = {name: (value[:, 0] != states[name][:, step]) for name, value in now.items()}
        ego = wrong.pop("ego").any(-1).double().mean()
        items = torch.cat([value.any(-1) for value in wrong.values()], -1).double().mean()
        found.append((float(ego), float(items)))
    return [(0.0, 0.0), *found]


def main() -> None:
    """Run the benchmark."""
    options = tyro.cli(Options, description=__doc__)
    rows = []
    for world, setting, name in WORLDS:
        human = load_human_model(name, load_self_model(shipped_weights(world))[0])
        type(human.domain).horizon = min(options.steps, human.domain.horizon)
        pyro.set_rng_seed(options.seed)
        implants = draw_prior(human, options.people, 1, options.seed)
        generator = torch.Generator().manual_seed(options.seed)
        begin = human.domain.initial(options.people, generator)
        rounds = play_rounds(
            human, {n: v[0] for n, v in implants.items()}, 1, setting, generator.manual_seed(0)
        )
        if rounds.shape[2] < human.domain.horizon:
            raise SystemExit("every round was over before the last step")
        theirs = human.domain.initial(options.people, generator.manual_seed(0))
        shares = counts(human, theirs, rounds.actions[:, 0]) / options.people
        for kind in FORWARD:
            actions, decoded = run_forward(human, rounds, begin, kind)
            found = counts(human, begin, actions) / options.people
            apart = (found - shares).abs()
            error = 3 * (shares * (1 - shares) * 2 / options.people).sqrt()
            wrong = differences(human, begin, actions, decoded)
            for step in range(len(found)):
                place = int(apart[step].argmax())
                rows.append(
                    {
                        "world": f"{world}, {setting}",
                        "forward": kind,
                        "step": step,
                        "difference": float(apart[step, place]),
                        "by_chance": float(error[step, place]),
                        "wrong_ego": wrong[step][0],
                        "wrong_items": wrong[step][1],
                    }
                )
    table = pd.DataFrame(rows)
    for (world, kind), part in table.groupby(["world", "forward"], sort=False):  # pyright: ignore
        worst = part.loc[part.difference.idxmax()]
        print(
            f"{world}, {kind}: at most {worst.difference:.3f} at step {worst.step}, by chance "
            f"{worst.by_chance:.3f}; root of the mean square "
            f"{math.sqrt((part.difference**2).mean()):.3f}"
        )
    if options.output is not None:
        table.to_csv(options.output, index=False, float_format="%.4f")


if __name__ == "__main__":
    main()
