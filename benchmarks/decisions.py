"""Whether messages are chosen as by another version, and if not, which of the two are better.

    python -m benchmarks.decisions --against 5008c39

Both versions plan with default settings in the same recorded moments of drivers in fog, each with
its own posterior. Where they differ, this version values both messages for now, with the best of
the plans for later steps that it considers: with 400 other posterior draws, to the end of the
round, and with action sequences enumerated down to a probability of one in a hundred. Interval: of
a bootstrap over drivers, at 90%.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

from benchmarks._speed_work import human_and_rounds, moments, planner
from benchmarks._state import ROOT
from benchmarks.speed import git, work
from mirror_ppl.communication import Communicator, RoundSoFar
from mirror_ppl.communication.person import PlanningContext
from mirror_ppl.communication.search import Patient, joined
from mirror_ppl.evaluation.study_summary import interval

DRAWS, ENUMERATED = 400, 0.01


@dataclass(frozen=True)
class Options:
    """What to compare."""

    against: str = "5008c39"
    """The other revision; version 0.1.0 unless given."""
    people: int = 10
    """Drivers."""
    moments: int = 50
    """Number of moments for each driver."""


@torch.no_grad()
def values(judge: Communicator, past: RoundSoFar, flags: torch.Tensor) -> torch.Tensor:
    """Expected utility of messages for now ``[M, N]``, with the best later ones."""
    domain = judge.person.human.domain
    context = PlanningContext.of(judge.person, past)
    value = judge.objective.at(context, domain.horizon - past.time, seed=1)
    search = Patient()
    now = torch.nn.functional.pad(flags[:, None], [0, 0, 0, search.steps - 1])
    found = search(value, flags.any(0), 0)
    if found.candidates.shape[1] < search.steps:
        more = search.steps - found.candidates.shape[1]
        padded = torch.nn.functional.pad(found.candidates, [0, 0, 0, more])
        found = type(found)(padded, found.valued)
    found, _ = joined(found, now, value)
    mean = found.valued.utility.mean(-1)
    same = (found.candidates[:, None, 0] == flags).all(-1)  # [C, M]
    return torch.where(same, mean[:, None], -torch.inf).amax(0)


def main(options: Options) -> None:
    """Compare, and print the table."""
    torch.set_num_threads(1)
    asked = "decide", str(options.people), str(options.moments)
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / "other"
        git("worktree", "add", "--detach", str(other), options.against)
        try:
            both = [work(tree, *asked)["flags"] for tree in (ROOT, other)]
        finally:
            git("worktree", "remove", "--force", str(other))
    here, there = (torch.tensor(flags, dtype=torch.bool) for flags in both)
    here, there = (flags.unflatten(0, (options.people, -1)) for flags in (here, there))
    human, recordings = human_and_rounds("driving", "fog", options.people)
    gains = np.zeros(here.shape[:2])
    for place, name in enumerate(recordings.people):
        own = recordings.select_people([name])
        judge = planner(
            human,
            own,
            DRAWS,
            seed=1,
            horizon=human.domain.horizon,
            enumerate_above=ENUMERATED,
        )
        for number, past in enumerate(moments(own, options.moments)):
            pair = torch.stack([here[place, number], there[place, number]])
            if not torch.equal(*pair):
                first, second = values(judge, past, pair)
                gains[place, number] = float(first - second)
    differ = (here != there).any(-1)
    gain = interval(gains.mean(-1))
    print(f"decisions: {gains.size}, of which {int(differ.sum())} differ")
    print(f"messages here: {int(here.any(-1).sum())}, there: {int(there.any(-1).sum())}")
    print(f"of those that differ, better here: {(gains > 0).sum()}, there: {(gains < 0).sum()}")
    print(
        f"gain of a decision here: {gain.mean:.4f} [{gain.low:.4f}, {gain.high:.4f}], "
        "in units of reward"
    )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
