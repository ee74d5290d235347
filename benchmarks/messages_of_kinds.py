r"""What messages are worth to drivers whom the human model `mirror` does not describe.

    python -m benchmarks.messages_of_kinds --seeds 0 1 2 3
    python -m benchmarks.messages_of_kinds --seeds 0 1 --human-model all \
        --kinds "a step late" "another goal" "two steps late" "notices half" "mostly forgets" \
        "as modelled" "dislikes switching"

Drivers of the kinds of benchmarks/model_check.py, and drivers whom no message reaches, play 20
rounds in fog, without messages. Posteriors of the human model are inferred from these. Then each
driver plays further rounds twice: in silence, and with messages planned with that posterior, which
learns from round to round only whether messages reach them. Messages are planned for all drivers;
the table also shows what is gained if those with the verdict `unexplained` get none, as without
`plan_anyway`. Both rounds have the same initial states and the same random numbers. This writes a
row for each driver to docs/results/driving_messages_of_kinds.csv; seeds that are there are not done
again. The tables of docs/communicator.md are printed.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import mirror_ppl
from benchmarks._rows import rows_in
from benchmarks.model_check import drawn_implants, kinds
from mirror_ppl.communication.messages import Channels
from mirror_ppl.communication.objectives import predicted_choices
from mirror_ppl.communication.person import Person, PlanningContext
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.domains.base import total_reward
from mirror_ppl.errors import UnexplainedPerson
from mirror_ppl.evaluation.study_summary import interval
from mirror_ppl.inference.results.criticism import UNEXPLAINED
from mirror_ppl.models import HumanModel
from mirror_ppl.models.family import HardOfHearing
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.weights import load_self_model, shipped_weights

ROWS = Path(__file__).parents[1] / "docs/results/driving_messages_of_kinds.csv"
PEOPLE, LEARNED, PLAYED = 5, 20, 6


def every_kind(self_model: SelfModel) -> dict[str, tuple[HumanModel, dict[str, float]]]:
    """Return the program of each kind of people, and values of sites that all of them have."""
    deaf = HardOfHearing(self_model)
    silent = {f"hears_{m.name}": 0.0 for m in deaf.domain.modalities}
    return kinds(self_model) | {"no message reaches them": (deaf, silent)}


@torch.no_grad()
def play(
    planner: mirror_ppl.Communicator | None, driver: Person, state: Tensor, chance: Tensor
) -> tuple[RoundSoFar, float, float]:
    """Play a round from a state ``[1]``; returns it with its reward and cost.

    Args:
        planner: chooses messages; none are sent without it.
        driver: with the true implants.
        state: the first state of the round.
        chance: uniform random number of each step, by which actions are drawn.
    """
    world = driver.human.domain
    channels = Channels(world)

    def observed() -> dict[str, Tensor]:
        return {name: value[0] for name, value in world.observe(state).items()}

    past, reward, cost = RoundSoFar.begin(world, observed()), 0.0, 0.0
    for number in chance:
        if bool(world.over(state)):
            break
        sent = torch.zeros(1, len(channels), dtype=torch.bool)
        if planner is not None:
            sent = planner.plan(past).flags[None]
        acting = predicted_choices(PlanningContext.of(driver, past), sent)[0, 0]
        action = (acting.cumsum(0) < number).sum().clamp(max=len(acting) - 1)
        following = world.transition(state, action[None])
        reward += float(total_reward(world.rewards(state, action[None], following)))
        cost += float(channels.cost(sent))
        state = following
        items = {name: mask[0] for name, mask in channels.split(sent).items()}
        past = past.then(items, action, observed())
    return past, reward, cost


def measured(
    name: str, human: HumanModel, known: dict[str, float], seed: int, fitted: str
) -> list[dict[str, str]]:
    """Return a row for each driver of a kind and seed: means over rounds.

    Args:
        name: of the kind.
        human: its program.
        known: values of sites that all of them have.
        seed: of the drivers and rounds.
        fitted: name of the human model that is fitted and planned with.
    """
    implants = drawn_implants(human, known, PEOPLE, seed)
    generator = torch.Generator().manual_seed(seed)
    recordings = play_rounds(human, implants, LEARNED, "fog", generator)
    fit = mirror_ppl.infer(recordings, human=fitted, seed=seed, train_rounds=LEARNED, explore=0)
    rows, world = [], human.domain
    for place, person in enumerate(recordings.people):
        driver = Person(human, {site: value[place][None, None] for site, value in implants.items()})
        generator = torch.Generator().manual_seed(1_000_000 + 1000 * seed + place)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnexplainedPerson)
            planner = mirror_ppl.Communicator(fit, person, plan_anyway=True)
        found = []
        for _ in range(PLAYED):
            state = world.initial(1, generator)
            chance = torch.rand(world.horizon, generator=generator)
            _, silent, _ = play(None, driver, state, chance)
            past, reward, cost = play(planner, driver, state, chance)
            planner = planner.after(past)
            found.append((silent, reward, cost))
        silent, reward, cost = np.mean(found, 0)
        rows.append(
            {
                "kind": name,
                "human_model": fitted,
                "seed": str(seed),
                "person": person,
                "verdict": fit.check["verdict"][person],
                "silence": f"{silent:.4f}",
                "reward": f"{reward:.4f}",
                "cost": f"{cost:.4f}",
            }
        )
    return rows


def table(rows: Sequence[dict[str, str]]) -> str:
    """Return the table of docs/communicator.md; intervals are of a bootstrap over drivers."""
    lines = [
        "| Kind of driver | Planned with | Drivers | In silence | Net, with messages | "
        "Gain over silence | Cost a round | Unexplained | Gain, if these get none |",
        "|---" * 9 + "|",
    ]
    for kind, fitted in dict.fromkeys((row["kind"], row["human_model"]) for row in rows):
        own = [row for row in rows if (row["kind"], row["human_model"]) == (kind, fitted)]
        silent, reward, cost = (
            np.array([float(row[name]) for row in own]) for name in ("silence", "reward", "cost")
        )
        gain = interval(reward - cost - silent)
        unexplained = np.array([row["verdict"] == UNEXPLAINED for row in own])
        kept = interval(np.where(unexplained, 0.0, reward - cost - silent))
        known = all(row["verdict"] for row in own)
        cells = [
            kind,
            f"`{fitted}`",
            f"{len(own)}",
            f"{silent.mean():.2f}",
            f"{(reward - cost).mean():.2f}",
            f"{gain.mean:.2f} [{gain.low:.2f}, {gain.high:.2f}]",
            f"{cost.mean():.3f}",
            f"{unexplained.sum()}" if known else "-",
            f"{kept.mean:.2f} [{kept.low:.2f}, {kept.high:.2f}]" if known else "-",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def ahead(rows: Sequence[dict[str, str]]) -> str:
    """Return how much more net return `all` gains than `mirror`, of drivers who had both."""
    found = {}
    for row in rows:
        driver = row["kind"], row["seed"], row["person"]
        found[driver, row["human_model"]] = float(row["reward"]) - float(row["cost"])
    lines = ["| Kind of driver | `all` ahead of `mirror` |", "|---|---|"]
    for kind in dict.fromkeys(row["kind"] for row in rows if row["human_model"] == "all"):
        drivers = [driver for driver, model in found if driver[0] == kind and model == "all"]
        more = interval(np.array([found[one, "all"] - found[one, "mirror"] for one in drivers]))
        lines.append(f"| {kind} | {more.mean:.2f} [{more.low:.2f}, {more.high:.2f}] |")
    return "\n".join(lines)


def main() -> None:
    """Measure the seeds and kinds that are missing, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=[], help="of drivers and rounds")
    parser.add_argument("--kinds", nargs="*", default=[], help="of drivers; all unless given")
    parser.add_argument("--human-model", default="mirror", help="that is planned with")
    given = parser.parse_args()
    torch.set_num_threads(1)
    self_model, _ = load_self_model(shipped_weights("driving"))
    rows, every = rows_in(ROWS) if ROWS.exists() else [], every_kind(self_model)
    for seed in given.seeds:
        for name in given.kinds or every:
            human, known = every[name]
            cell = name, given.human_model, str(seed)
            if cell not in {(row["kind"], row["human_model"], row["seed"]) for row in rows}:
                new = measured(name, human, known, seed, given.human_model)
                rows = rows_in(ROWS, rows + new)
                print(f"seed {seed}: {name}", flush=True)
    print(table(rows), ahead(rows), sep="\n\n")


if __name__ == "__main__":
    main()
