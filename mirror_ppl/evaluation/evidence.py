"""Comparison of human models by the marginal likelihood of what people did.

Fits estimate ``log p(actions of a person | model)``, the log evidence in nats, by importance
sampling; it includes all rounds that were learned from. It is compared under two assumptions:

- All people follow one model: log evidences are summed over people (fixed effects).
- Each person follows one model, and the shares of the models among people have a uniform Dirichlet
  prior (random effects). Their posterior is approximated by a Dirichlet distribution (Stephan,
  Penny, Daunizeau, Moran and Friston, *Bayesian model selection for group studies*, 2009).

Shapes: M models, P people.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import digamma, log_softmax
from scipy.stats import beta

from mirror_ppl.evaluation.compared_files import (
    EvidenceFile,
    check_same,
    compared_model,
    source_of,
)

INTERVAL = 0.9
"""Probability of intervals of shares."""
STEPS, TOLERANCE = 1000, 1e-6
"""Most iterations of the approximation, and the change at which it has converged."""


@dataclass(frozen=True)
class Shares:
    """Approximate posterior of the shares of M models among people.

    Attributes:
        counts: parameters of the Dirichlet distribution ``[M]``.
        followed: probability that each person follows each model ``[P, M]``.
    """

    counts: np.ndarray
    followed: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """Expected shares ``[M]``."""
        return self.counts / self.counts.sum()

    @property
    def interval(self) -> np.ndarray:
        """Central intervals of the shares ``[2, M]``."""
        edges = [[(1 - INTERVAL) / 2], [(1 + INTERVAL) / 2]]
        return beta.ppf(edges, self.counts, self.counts.sum() - self.counts)


def model_shares(log_evidence: np.ndarray) -> Shares:
    """Infer the shares of models among people from log evidences ``[P, M]``."""
    prior = np.ones(log_evidence.shape[1])
    counts, followed = prior, np.empty(0)
    for _ in range(STEPS):
        # digamma(counts.sum()) is the same for all models.
        followed = np.exp(log_softmax(log_evidence + digamma(counts), -1))
        before, counts = counts, prior + followed.sum(0)
        if np.abs(counts - before).max() < TOLERANCE:
            break
    return Shares(counts, followed)


@dataclass(frozen=True)
class PersonEvidence:
    """Evidence of one model for one person.

    Attributes:
        log_evidence: nats.
        evidence_error: its standard error, nats.
        difference: to that of the best model of all people, nats.
        difference_error: standard error of the difference, nats.
        probability: that this person follows this model, under random effects.
    """

    log_evidence: float
    evidence_error: float
    difference: float
    difference_error: float
    probability: float


@dataclass(frozen=True)
class ModelEvidence:
    """Evidence of one model.

    Attributes:
        label: its name in the comparison.
        path: its posterior.
        human_model: its name in commands.
        log_evidence: summed over people, nats.
        evidence_error: its standard error, nats.
        difference: to the best model, nats.
        difference_error: standard error of the difference, nats.
        share: expected share of people who follow it.
        share_interval: central 90% interval of the share.
        people: of each of the P people.
    """

    label: str
    path: Path
    human_model: str
    log_evidence: float
    evidence_error: float
    difference: float
    difference_error: float
    share: float
    share_interval: tuple[float, float]
    people: tuple[PersonEvidence, ...]


@dataclass(frozen=True)
class EvidenceComparison:
    """A comparison of models by evidence, from the highest to the lowest sum.

    Attributes:
        attributes: the domain, the setting and the provenance of the recordings.
        people: ids of the P people.
        rounds: number of rounds of each person that were learned from ``[P]``.
        models: M of them.
    """

    attributes: Mapping[str, str]
    people: tuple[str, ...]
    rounds: tuple[int, ...]
    models: tuple[ModelEvidence, ...]

    by = "evidence"

    def table(self) -> pd.DataFrame:
        """Differences as `mirror_ppl.plots.comparison.plot_comparison` draws them."""
        return pd.DataFrame(
            [
                {
                    "model": model.label,
                    "person": person,
                    "rounds": number,
                    "log_density": one.log_evidence,
                    "difference": one.difference,
                    "difference_se": one.difference_error,
                }
                for model in self.models
                for person, one, number in zip(
                    (None, *self.people),
                    (model, *model.people),
                    (sum(self.rounds), *self.rounds),
                    strict=True,
                )
            ]
        )

    def as_data(self) -> dict[str, Any]:
        """The comparison as plain values for JSON, people by id."""
        models = []
        for rank, model in enumerate(self.models, 1):
            own = asdict(model)
            own["posterior"] = str(own.pop("path"))
            people = zip(self.people, own.pop("people"), strict=True)
            models.append(
                {"rank": rank, **own, "people": [{"id": name} | one for name, one in people]}
            )
        return {"by": self.by, "unit": "nats", **self.attributes, "models": models}


def compare_evidence(files: Sequence[EvidenceFile], labels: Sequence[str]) -> EvidenceComparison:
    """Rank models by the marginal likelihood of the same people's actions.

    Args:
        files: one of each model.
        labels: distinct names of the models.

    Raises:
        PosteriorError: files are of different recordings.
    """
    check_same(files)
    # Ties are ordered by name, so that the order of the arguments makes no difference.
    named = dict(zip(labels, files, strict=True))
    order = sorted(named, key=lambda label: (-named[label].log_evidence.sum(), label))
    ranked = [named[label] for label in order]
    shares = model_shares(np.stack([file.log_evidence for file in ranked], -1))
    intervals, first = shares.interval, ranked[0]

    def standing(place: int) -> ModelEvidence:
        file = ranked[place]
        differences = file.log_evidence - first.log_evidence
        # Fits are independent; the best has no difference to itself.
        errors = np.hypot(file.error, first.error) * (place > 0)
        numbers = (file.log_evidence, file.error, differences, errors, shares.followed[:, place])
        return ModelEvidence(
            order[place],
            file.path,
            compared_model(file),
            float(file.log_evidence.sum()),
            float(np.linalg.norm(file.error)),
            float(differences.sum()),
            float(np.linalg.norm(errors)),
            float(shares.mean[place]),
            (float(intervals[0, place]), float(intervals[1, place])),
            tuple(PersonEvidence(*map(float, one)) for one in zip(*numbers, strict=True)),
        )

    rounds = tuple((first.actions >= 0).any(-1).sum(-1).tolist())
    models = tuple(map(standing, range(len(order))))
    return EvidenceComparison(source_of(first), first.people, rounds, models)
