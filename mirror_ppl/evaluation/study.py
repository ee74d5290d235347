"""Studies: how well learners predict people, and how much planning with them helps.

Rows are tidy: one person, one model, one number of rounds in each.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch

from mirror_ppl.domains import get_domain
from mirror_ppl.domains.registry import code_of
from mirror_ppl.errors import AssetError, UnknownNameError
from mirror_ppl.evaluation.assistance import REFERENCES, PlannerOptions, play_together, speaker
from mirror_ppl.evaluation.learned import Plannable, Trained
from mirror_ppl.evaluation.learners import (
    ALSO_PLANNABLE,
    ASKED_FOR,
    LEARNERS,
    PLANNABLE,
    SLOW,
    TEST,
    Group,
    is_own,
    learn,
    learns_from_nothing,
)
from mirror_ppl.evaluation.tables import Rows
from mirror_ppl.inference.results.summary import score
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.models.loading import file_of, load_human_model
from mirror_ppl.models.weights import fingerprint, load_self_model, shipped_weights
from mirror_ppl.people import has_oracle
from mirror_ppl.randomness import person_id
from mirror_ppl.training.guide_file import shipped_guide

CODE = (
    *(f"{name}/**/*.py" for name in ("baselines", "communication", "data", "domains")),
    *(f"{name}/**/*.py" for name in ("inference", "likelihood", "models", "people")),
    *(f"evaluation/{name}.py" for name in ("assistance", "known_sight", "learned", "learners")),
    *(f"evaluation/{name}.py" for name in ("played", "reachable_oracle", "study")),
    "cross_entropy.py",
    "minimization.py",
    "randomness.py",
    "row_appending.py",
    "row_hashing.py",
    "shapes.py",
    "training/guide_file.py",
    "data/assets/*guide*.safetensors",
)
"""Files whose change invalidates earlier results."""
BEGINNINGS = 100
"""Initial states that are drawn to test if a setting hides anything."""
EVERYTHING = "-everything"
"""Suffix of learners that read everything that could be seen."""
MEMBERS = 5
"""Networks of each person to plan messages with, so that their planner is uncertain, too."""
UTILITY, KL = "mirror", "mirror-kl"
"""The planner by expected utility, and that by KL of beliefs, which only ``mirror`` has."""


@dataclass(frozen=True)
class Prediction:
    """A learner in a group, as a cell of the prediction study.

    Attributes:
        group: the people.
        model: the learner.
        rounds: number of training rounds.
    """

    group: Group
    model: str
    rounds: int

    @property
    def label(self) -> str:
        """Name in progress messages."""
        return _label(self)


def predict(cell: Prediction) -> Rows:
    """Score a learner's predictions of held-out rounds: a row for each person.

    Additional columns: ``nll`` in nats an action, ``accuracy``, ``floor`` (entropy of the person's
    own choices).
    """
    group = cell.group
    test = group.recordings().select_rounds(TEST)
    learned = learn(cell.model, group, cell.rounds, group.seed)
    found = score(learned.log_predictive(test)[None], test)
    return [
        _row(group, cell.model, cell.rounds, person) | measured
        for person, measured in zip(test.people, found, strict=True)
        if measured is not None
    ]


@dataclass(frozen=True)
class Assistance:
    """Communicators that plan with a learner, or a reference, as a cell of the assistance study.

    Attributes:
        group: the people.
        model: the learner, or one of ``REFERENCES``.
        rounds: number of training rounds; 0 for references.
        played: rounds of each person that are played with messages.
        draws: posterior draws to plan with; 0 for references.
    """

    group: Group
    model: str
    rounds: int
    played: int
    draws: int

    @property
    def label(self) -> str:
        """Name in progress messages."""
        return _label(self)


def assist(cell: Assistance) -> Rows:
    """Measure returns and messages: a row for each person and communicator.

    Additional columns: ``played``, the number of rounds with messages; means per round of ``task``,
    ``cost``, ``net`` and ``mishaps``; totals over these rounds of ``items`` of each modality, and
    of those that were relevant by each notion. The rounds are the same for all communicators, and
    were not learned from.
    """
    group, learned = cell.group, None
    if cell.model not in REFERENCES:
        learned = cast(Plannable, learn(cell.model, group, cell.rounds, group.seed, MEMBERS))
    # Networks learn from recordings if people react to messages, so this is not inferred.
    taken_for_granted = 1.0 if isinstance(learned, Trained) else None
    options, rows = PlannerOptions.of(group.domain, hears=taken_for_granted), []
    people = group.listeners(cell.played)
    if learned is not None:
        people = [
            replace(one, person=learned.person(number, cell.draws))
            for number, one in enumerate(people)
        ]
    for objective in _objectives(cell.model):
        who = cell.model if objective == UTILITY else objective
        says = [
            speaker(objective, one, options, group.seed + number)
            for number, one in enumerate(people)
        ]
        for number, played in enumerate(play_together(people, says)):
            rows.append(
                _row(group, who, cell.rounds, person_id(number))
                | {
                    "played": cell.played,
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


def prediction_cells(
    group: Group, models: Sequence[str], rounds: Sequence[int]
) -> list[Prediction]:
    """List the prediction cells of a group.

    Args:
        group: the people.
        models: learners, or human models in files, ``path/to/file.py:Class``; all applicable
            learners except slow ones unless given.
        rounds: numbers of training rounds.

    Raises:
        UnknownNameError: there is no such learner.
        HumanModelError: a file has no such human model, or the model breaks its contract.
        AssetError: a learner needs a trained guide that does not ship.
    """
    chosen, guide = _known(models, tuple(LEARNERS), group), _has_guide(group.domain)
    if "mirror-amortized" in chosen and not guide:
        raise AssetError(f"mirror-amortized: no trained guide ships for {group.domain}")
    if not chosen:
        left_out = {*SLOW, *get_domain(group.domain).record.slow, *ASKED_FOR}
        if not guide:
            left_out.add("mirror-amortized")
        # Learners that read everything differ from others only where something is hidden.
        ends = (EVERYTHING,) if _shows_everything(group) else ()
        chosen = [name for name in LEARNERS if name not in left_out and not name.endswith(ends)]
    return [Prediction(group, name, number) for name in chosen for number in sorted({*rounds})]


def assistance_cells(
    group: Group, models: Sequence[str], rounds: Sequence[int], played: int, draws: int
) -> list[Assistance]:
    """List the assistance cells of a group; arguments as above and of `Assistance`."""
    known = (*PLANNABLE, *ALSO_PLANNABLE, *REFERENCES)
    chosen = _known(models, known, group)
    if not chosen:
        there = has_oracle(group.domain, group.population)
        chosen = [name for name in (*PLANNABLE, *REFERENCES) if there or name != "oracle"]
    return [
        Assistance(group, name, number, played, 0 if name in REFERENCES else draws)
        for name in chosen
        for number in ((0,) if name in REFERENCES else sorted({*rounds}))
        if number or name in REFERENCES or learns_from_nothing(name)
    ]


def _objectives(model: str) -> tuple[str, ...]:
    """Communicators that are played: a learner's planners, or the reference itself."""
    if model in REFERENCES:
        return (model,)
    return (UTILITY, KL) if model == UTILITY else (UTILITY,)


def identities(domains: Iterable[str]) -> Callable[[Prediction | Assistance], str]:
    """Return a function of a cell that identifies the code and weights its results depend on."""
    digest, root = hashlib.sha256(torch.__version__.encode()), Path(__file__).parents[1]
    for part in CODE:
        for path in sorted(root.glob(part)):
            digest.update(path.read_bytes())
    code = digest.hexdigest()
    weights = {
        name: fingerprint(load_self_model(shipped_weights(name), name)[0])
        + code_of(get_domain(name))
        for name in {*domains}
    }

    def identity(cell: Prediction | Assistance) -> str:
        own = file_of(cell.model) if is_own(cell.model) else None
        file = "" if own is None else hashlib.sha256(own.read_bytes()).hexdigest()
        return f"{code} {weights[cell.group.domain]} {file}"

    return identity


def _known(models: Sequence[str], known: Sequence[str], group: Group) -> list[str]:
    """Each model once, in the order in which they are shown; then those in users' files."""
    own = [name for name in dict.fromkeys(models) if is_own(name)]
    for name in models:
        if name not in known and name not in own:
            raise UnknownNameError.of("model", name, known)
    for name in own:
        check_contract(load_human_model(name, group.self_model))
    return [*(name for name in known if name in models), *own]


def _shows_everything(group: Group) -> bool:
    """True if the setting hides nothing visual at the beginning of rounds."""
    domain = get_domain(group.domain)
    begin = domain.observe(domain.initial(BEGINNINGS, torch.Generator().manual_seed(0)))
    return bool(domain.visibility(group.setting, begin)["visual"].all())


def _has_guide(domain: str) -> bool:
    try:
        shipped_guide(domain)
    except AssetError:
        return False
    return True


def _label(cell: Prediction | Assistance) -> str:
    of = f" of {cell.rounds} round{'s' * (cell.rounds > 1)}" if cell.rounds else ""
    return f"{cell.model}{of} in {cell.group}"


def _row(group: Group, model: str, rounds: int, person: str) -> dict[str, Any]:
    return {
        "domain": group.domain,
        "setting": group.setting,
        "population": group.population,
        "seed": group.seed,
        "told": group.told,
        "person": person,
        "model": model,
        "rounds": rounds,
    }
