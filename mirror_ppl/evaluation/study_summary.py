"""Summaries of studies: means, paired differences and probabilities of improvement.

People are the sample: differences are paired by person, intervals are from the bootstrap over
people (of all seeds), and the probability of improvement is the share of people in whom the first
of two models is better, ties counting half (Agarwal et al., *Deep reinforcement learning at the
edge of the statistical precipice*, 2021, with people in the place of runs).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple, Self

import numpy as np
import pandas as pd

from mirror_ppl.evaluation.assistance import REFERENCES
from mirror_ppl.evaluation.tables import Rows

RESAMPLES = 2000
LEVELS = (0.05, 0.95)
FIRST, POOLED = "mirror", "mirror-pooled"
"""Models that others are compared with; the second for those that pool people."""
POOLING = ("bc-pooled", "bc-informed-pooled", "sqil-pooled", "logistic")
"""Baselines that learn about a person from others."""
NONE, ORACLE = "none", "oracle"
"""Communicators at the beginning and the end of the way to the oracle."""
BASELINES = ("bc", "bc-everything", "sqil", "sqil-everything", "logistic")
"""Baselines that MIRROR is compared with: the paper's, and pooled logistic regression."""


class Place(NamedTuple):
    """Domain, setting and population of a comparison."""

    domain: str
    setting: str
    population: str


@dataclass(frozen=True)
class Interval:
    """A mean over people, with its 90% interval; its ends are NaN if there is one person."""

    mean: float
    low: float
    high: float

    @classmethod
    def of(cls, mean: float, resampled: np.ndarray, people: int) -> Self:
        """Take the interval from means of resampled people."""
        low, high = np.quantile(resampled, LEVELS) if people > 1 else (np.nan, np.nan)
        return cls(float(mean), float(low), float(high))

    def between(self, form: str, scale: float = 1.0) -> str:
        """The interval as text, scaled."""
        if np.isnan(self.low):
            return "(one person)"
        return f"[{scale * self.low:{form}}, {scale * self.high:{form}}]"


@dataclass(frozen=True)
class Paired:
    """Paired comparison of two models in the same people.

    Attributes:
        ahead: mean difference; above 0 the first is better.
        improvement: share of people in whom the first is better.
        people: number of people.
    """

    ahead: Interval
    improvement: Interval
    people: int


@dataclass(frozen=True)
class ModelResult:
    """Result of a model that learned from some rounds.

    Attributes:
        place: of the comparison.
        model: its name.
        rounds: number of training rounds; 0 if it learns nothing.
        measured: mean over people.
        people: number of people.
        mirror: advantage of MIRROR with the same rounds (of ``mirror-pooled`` over models that pool
            people, if it is there), or with the most where the model learns nothing; ``None`` where
            there is none.
    """

    place: Place
    model: str
    rounds: int
    measured: Interval
    people: int
    mirror: Paired | None


@dataclass(frozen=True)
class Claim:
    """MIRROR with the fewest rounds against a baseline with the most."""

    place: Place
    rounds: int
    baseline: str
    baseline_rounds: int
    paired: Paired


@dataclass(frozen=True)
class Way:
    """Share of the way from silence to the oracle that a model reaches.

    Attributes:
        place: of the comparison.
        model: its name.
        rounds: number of training rounds.
        people: number of people.
        share: of the way in mean net return, 1 for all of it; ``None`` without silence or oracle.
        learned: net return gained over the model's prior alone; ``None`` without a prior.
    """

    place: Place
    model: str
    rounds: int
    people: int
    share: Interval | None
    learned: Interval | None


@dataclass(frozen=True)
class Share:
    """Share of a communicator's items that was relevant.

    Attributes:
        place: of the comparison.
        model: with which messages were planned.
        rounds: number of training rounds.
        modality: of the communicated items; ``all`` for all together.
        items: number of communicated items.
        share: of the items that was relevant; ``None`` if there were none.
        mirror: advantage of MIRROR's share, with as many rounds or, for a model that learns
            nothing, with the most; over people with messages from both. ``None`` for MIRROR, and
            where there are no such people.
    """

    place: Place
    model: str
    rounds: int
    modality: str
    items: int
    share: Interval | None
    mirror: Paired | None = None


def interval(values: np.ndarray) -> Interval:
    """Mean of ``[n]`` people's values, with its bootstrap interval, unless there is one person."""
    return Interval.of(values.mean(), values[_drawn(len(values))].mean(1), len(values))


def paired(first: np.ndarray, second: np.ndarray) -> Paired:
    """Compare gains ``[n]`` of the same people; more is better."""
    difference = first - second
    better = (difference > 0) + 0.5 * (difference == 0)
    return Paired(interval(difference), interval(better), len(difference))


def summarize_study(rows: Rows, measure: str, sign: int = 1) -> list[ModelResult]:
    """Summarize each model at each number of rounds, with MIRROR's advantage over it.

    Args:
        rows: of a study.
        measure: column that is compared.
        sign: 1 if more is better, -1 if less is.
    """
    found, values = [], _by_model(rows, measure)
    for (place, model, rounds), people in values.items():
        mirror = _mirror(values, place, model, rounds)
        own = np.array(list(people.values()))
        ahead = _both(mirror, people, sign)
        found.append(ModelResult(place, model, rounds, interval(own), len(own), ahead))
    return found


def few_against_many(
    rows: Rows, measure: str, sign: int = 1, baselines: Iterable[str] = BASELINES
) -> list[Claim]:
    """Compare MIRROR with the fewest rounds to baselines with the most, where there are both."""
    values = _by_model(rows, measure)
    found = []
    for place in dict.fromkeys(place for place, _, _ in values):
        numbers = {
            name: [rounds for where, model, rounds in values if (where, model) == (place, name)]
            for name in (FIRST, *baselines)
        }
        for baseline in baselines:
            if not (numbers[FIRST] and numbers[baseline]):
                continue
            few, many = min(numbers[FIRST]), max(numbers[baseline])
            ahead = _both(values[place, FIRST, few], values[place, baseline, many], sign)
            if ahead is not None:
                found.append(Claim(place, few, baseline, many, ahead))
    return found


def ways_to_oracle(rows: Rows) -> list[Way]:
    """Compute each model's share of the way to the oracle; the bootstrap draws people.

    Args:
        rows: of a study of assistance.
    """
    values, found = _by_model(rows, "net"), []
    for (place, model, rounds), own in values.items():
        ends = [values.get((place, name, 0), {}) for name in (NONE, ORACLE)]
        who = [one for one in own if all(one in end for end in ends)]
        share = None
        if who:
            net, none, oracle = (np.array([part[one] for one in who]) for part in (own, *ends))
            drawn = _drawn(len(who))
            ways = (oracle - none)[drawn].mean(1)
            if (ways > 0).all():
                mean = (net - none).mean() / (oracle - none).mean()
                share = Interval.of(mean, (net - none)[drawn].mean(1) / ways, len(who))
        prior, learned = values.get((place, model, 0), {}), None
        if rounds and (both := _both(own, prior, 1)) is not None:
            learned = both.ahead
        found.append(Way(place, model, rounds, len(own), share, learned))
    return found


def relevance(rows: Rows, notion: str, modalities: Sequence[str]) -> list[Share]:
    """Compute the share of communicated items that was relevant; the bootstrap draws people.

    A share pools the items of all people. MIRROR's advantage is the mean of paired differences.

    Args:
        rows: of a study of assistance, of one domain.
        notion: of relevance; columns are ``<notion>_<modality>`` and ``items_<modality>``.
        modalities: by name.
    """
    found = []
    for name in ("all", *modalities):
        some = modalities if name == "all" else [name]
        told, right = (
            _by_model(
                [row | {"sum": sum(row[f"{kind}_{one}"] for one in some)} for row in rows], "sum"
            )
            for kind in ("items", notion)
        )
        shares_of = {
            key: {who: right[key][who] / items for who, items in people.items() if items}
            for key, people in told.items()
        }
        for (place, model, rounds), people in told.items():
            items = np.array(list(people.values()))
            good = np.array(list(right[place, model, rounds].values()))
            mirror = _mirror(shares_of, place, model, rounds)
            ahead = _both(mirror, shares_of[place, model, rounds], 1)
            share = None
            if items.sum():
                drawn = _drawn(len(items))
                totals = items[drawn].sum(1)
                shares = good[drawn].sum(1)[totals > 0] / totals[totals > 0]
                share = Interval.of(good.sum() / items.sum(), shares, len(items))
            found.append(Share(place, model, rounds, name, int(items.sum()), share, ahead))
    return found


def means_table(results: Sequence[ModelResult]) -> pd.DataFrame:
    """Means and intervals as columns, with place, model and number of rounds."""
    return pd.DataFrame(
        [
            one.place._asdict() | {"model": one.model, "rounds": one.rounds} | asdict(one.measured)
            for one in results
        ]
    )


def shares_table(shares: Sequence[Share]) -> pd.DataFrame:
    """Shares and intervals as columns, with place, model, rounds and modality; NaN if missing."""
    nothing = Interval(np.nan, np.nan, np.nan)
    return pd.DataFrame(
        [
            one.place._asdict()
            | {"model": one.model, "rounds": one.rounds, "modality": one.modality}
            | asdict(one.share or nothing)
            for one in shares
        ]
    )


def floors(rows: Rows) -> dict[Place, float]:
    """Mean entropy of people's own choices, where it is known for all people."""
    found = {}
    for place in dict.fromkeys(_place(row) for row in rows):
        own = {_who(row): row["floor"] for row in rows if _place(row) == place}
        if None not in own.values():
            found[place] = float(np.mean(list(own.values())))
    return found


def _by_model(
    rows: Rows, measure: str
) -> dict[tuple[Place, str, int], dict[tuple[int, str], float]]:
    """Each person's value, by place, model and number of rounds."""
    found: dict[tuple[Place, str, int], dict[tuple[int, str], float]] = {}
    for row in rows:
        key = (_place(row), row["model"], row["rounds"])
        found.setdefault(key, {})[_who(row)] = row[measure]
    return found


def _mirror(
    values: dict[tuple[Place, str, int], dict[tuple[int, str], float]],
    place: Place,
    model: str,
    rounds: int,
) -> dict[tuple[int, str], float]:
    """Values of MIRROR that a model is compared with; none for itself."""
    if model == FIRST:
        return {}
    if model in REFERENCES:
        rounds = max((n for where, name, n in values if (where, name) == (place, FIRST)), default=0)
    pooled = values.get((place, POOLED, rounds)) if model in POOLING else None
    return pooled or values.get((place, FIRST, rounds), {})


def _place(row: dict) -> Place:
    return Place(row["domain"], row["setting"], row["population"])


def _who(row: dict) -> tuple[int, str]:
    return row["seed"], row["person"]


def _both(
    first: dict[tuple[int, str], float], second: dict[tuple[int, str], float], sign: int
) -> Paired | None:
    who = [one for one in first if one in second]
    if not who:
        return None
    return paired(
        sign * np.array([first[one] for one in who]), sign * np.array([second[one] for one in who])
    )


def _drawn(number: int) -> np.ndarray:
    """Indices of each resample's people, ``[RESAMPLES, n]``; always the same."""
    return np.random.default_rng(0).integers(number, size=(RESAMPLES, number))
