"""What is compared: how learners predict people, and how much those help who plan with them.

Rows are tidy: one person, one model, one number of rounds in each.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

from mirror_ppl.domains import get_domain
from mirror_ppl.evaluation.assistance import Listener, PlannerOptions, play, speaker
from mirror_ppl.evaluation.learners import TEST, TRAINING, Group, Plannable, learn
from mirror_ppl.evaluation.sweep import Rows
from mirror_ppl.inference.summary import score
from mirror_ppl.people import draw_starts, simulated_people

SHARES = (0.0, 0.05, 0.1, 0.25, 0.5, 1.0)
"""Shares of the training rounds that are learned from; at least one round."""
REFERENCES = ("none", "all", "oracle")
"""Communicators that learn nothing of people."""
OBJECTIVES = {"mirror": ("mirror", "mirror-kl"), "bc": ("mirror",), "sqil": ("mirror",)}
"""Planners for each learner: expected utility, and of MIRROR the divergence of beliefs, too."""


def rounds_of(share: float) -> int:
    """How many of the training rounds a share is, at least one."""
    return max(1, round(share * TRAINING))


@dataclass(frozen=True)
class Prediction:
    """A learner in a group, with several numbers of rounds.

    Attributes:
        domain, setting, population, people, seed: the group.
        model: the learner.
        rounds: numbers of rounds that it learns from.
    """

    domain: str
    setting: str
    population: str
    people: int
    seed: int
    model: str
    rounds: tuple[int, ...]

    @property
    def label(self) -> str:
        """What it is, for people who wait."""
        return f"{self.model} in {self.domain}, {self.setting}, seed {self.seed}"


def predict(cell: Prediction) -> Rows:
    """How well a learner predicts held-out rounds: a row for each person and number of rounds.

    Columns of their own: ``nll`` in nats an action, ``accuracy``, ``floor`` (the person's own
    entropy).
    """
    group = _group(cell)
    test = group.recordings().select_rounds(TEST)
    rows = []
    for number in cell.rounds:
        learned = learn(cell.model, group, number, cell.seed)
        found = score(learned.log_predictive(test)[None], test)
        rows += [
            _row(cell, cell.model, number, person) | measured
            for person, measured in zip(test.people, found, strict=True)
            if measured is not None
        ]
    return rows


@dataclass(frozen=True)
class Assistance:
    """Communicators that plan with what a learner made of some rounds, or that learn nothing.

    Attributes:
        domain, setting, population, people, seed: the group.
        model: the learner, or one of ``REFERENCES``.
        rounds: how many it learns from; 0 of references.
        played: rounds of each person in which they are spoken to.
        draws: posterior draws that are planned with.
    """

    domain: str
    setting: str
    population: str
    people: int
    seed: int
    model: str
    rounds: int
    played: int
    draws: int

    @property
    def label(self) -> str:
        """What it is, for people who wait."""
        of = f" of {self.rounds} round{'s' * (self.rounds > 1)}" if self.rounds else ""
        return f"{self.model}{of} in {self.domain}, {self.setting}, seed {self.seed}"


def assist(cell: Assistance) -> Rows:
    """What people gain and are told: a row for each person and communicator.

    Columns of their own: means a round of ``task``, ``cost``, ``net`` and ``mishaps``; in all
    rounds ``items`` of each modality, and how many were relevant by each notion. The rounds are the
    same for all communicators, and others than those that were learned from.
    """
    group, domain = _group(cell), get_domain(cell.domain)
    everybody = simulated_people(cell.domain, cell.setting, cell.population, cell.people, cell.seed)
    starts = draw_starts(
        cell.people,
        cell.played,
        cell.seed,
        "assist",
        cell.setting,
        domain=domain,
        fates=everybody.fates,
    )
    learned = None
    if cell.model not in REFERENCES:
        learned = cast(Plannable, learn(cell.model, group, cell.rounds, cell.seed))
    options, rows = PlannerOptions.of(cell.domain), []
    for number in range(cell.people):
        start = starts.select(slice(number, number + 1))
        listener = Listener(domain, cell.setting, everybody.select([number]), start)
        if learned is not None:
            listener = replace(listener, person=learned.person(number, cell.draws))
        for objective in OBJECTIVES.get(cell.model, (cell.model,)):
            who = cell.model if objective == "mirror" else objective
            played = play(listener, speaker(objective, listener, options, cell.seed + number))
            rows.append(
                _row(cell, who, cell.rounds, f"person-{number + 1:02d}")
                | {
                    "task": sum(played.task) / cell.played,
                    "cost": sum(played.cost) / cell.played,
                    "net": float(played.net.mean()),
                    "mishaps": sum(played.mishaps) / cell.played,
                }
                | {f"items_{name}": sum(items) for name, items in played.items.items()}
                | {
                    f"{notion}_{name}": sum(items)
                    for notion, modalities in played.relevant.items()
                    for name, items in modalities.items()
                }
            )
    return rows


def _group(cell: Prediction | Assistance) -> Group:
    return Group(cell.domain, cell.setting, cell.population, cell.people, cell.seed)


def _row(cell: Prediction | Assistance, model: str, rounds: int, person: str) -> dict[str, Any]:
    return {
        "domain": cell.domain,
        "setting": cell.setting,
        "population": cell.population,
        "seed": cell.seed,
        "person": person,
        "model": model,
        "rounds": rounds,
    }
