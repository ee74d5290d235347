"""Comparison of human models by the marginal likelihood of what people did.

Fits estimate ``log p(actions of a person | model)``, the log evidence in nats, by importance
sampling; it includes all rounds that were learned from. It is compared under two assumptions:

- All people follow one model: log evidences are summed over people (fixed effects).
- Each person follows one model, and the shares of the models among people have a uniform Dirichlet
  prior (random effects: Stephan, Penny, Daunizeau, Moran and Friston, *Bayesian model selection
  for group studies*, 2009). Their posterior is sampled, as a Dirichlet distribution that
  approximates it is too narrow where it is uncertain whom a model describes.

Shapes: M models, P people.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mirror_ppl.evaluation.compared_files import (
    EvidenceFile,
    check_same,
    compared_model,
    source_of,
)

INTERVAL = 0.9
"""Probability of intervals of shares."""
CHAINS, SWEEPS = 500, 200
"""Chains that sample the shares, and sweeps of each, of which the second half counts."""


@dataclass(frozen=True)
class Shares:
    """Posterior of the shares of M models among P people.

    Attributes:
        draws: of the shares, ``[S, M]``.
        followed: probability that each person follows each model ``[P, M]``.
    """

    draws: np.ndarray
    followed: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """Expected shares ``[M]``."""
        return (1 + self.followed.sum(0)) / (len(self.followed) + self.followed.shape[1])

    @property
    def interval(self) -> np.ndarray:
        """Central intervals of the shares ``[2, M]``."""
        return np.quantile(self.draws, [(1 - INTERVAL) / 2, (1 + INTERVAL) / 2], axis=0)


def model_shares(log_evidence: np.ndarray) -> Shares:
    """Infer the shares of models among people from log evidences ``[P, M]``.

    Gibbs sampling draws the model of each person given the shares, and the shares given these, in
    many chains that begin with the prior.
    """
    generator = np.random.default_rng(0)
    people, models = log_evidence.shape
    likelihood = np.exp(log_evidence - log_evidence.max(-1, keepdims=True))
    shares = generator.dirichlet(np.ones(models), CHAINS)
    draws, followed = [], np.zeros((people, models))
    for sweep in range(SWEEPS):
        weights = shares[:, None] * likelihood  # [C, P, M]
        edges = weights.cumsum(-1)
        chosen = (edges <= edges[..., -1:] * generator.random((CHAINS, people, 1))).sum(-1)
        counts = (chosen[..., None] == np.arange(models)).sum(1)
        drawn = generator.standard_gamma(1 + counts)
        shares = drawn / drawn.sum(-1, keepdims=True)
        if sweep >= SWEEPS // 2:
            followed += (weights / edges[..., -1:]).mean(0)
            draws.append(shares)
    return Shares(np.concatenate(draws), followed / len(draws))


def prior_share(models: int) -> tuple[float, float, float]:
    """Mean and ends of the central interval of a model's share before any data."""
    # The distribution function of a share is 1 - (1 - x)^(M - 1).
    levels = ((1 - INTERVAL) / 2, (1 + INTERVAL) / 2)
    if models == 1:
        return 1.0, 1.0, 1.0
    low, high = (1 - (1 - level) ** (1 / (models - 1)) for level in levels)
    return 1 / models, low, high


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
