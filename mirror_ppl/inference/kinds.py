"""Bayesian model averaging: people of several kinds, each inferred by its own human model.

The program of :class:`mirror_ppl.models.family.OneOfKinds` has a site for the kind, on which no
other site of the prior depends, and a person's actions do not depend on implants of other kinds.
The posterior is therefore exactly a mixture of the separate models' posteriors::

    p(kind | rounds)        ~  p(kind) p(rounds | kind)
    p(implants | rounds)    =  sum_kind p(kind | rounds) p(implants | kind, rounds)

in which implants of other kinds have their prior. Each model has fewer beliefs than the whole
program, and a proposal of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from mirror_ppl.inference.engine import Inferred, Job
from mirror_ppl.likelihood.combinations import perceived_sites
from mirror_ppl.models.family import KIND, OneOfKinds
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import draw_prior, sample_sites
from mirror_ppl.progress import Report
from mirror_ppl.randomness import forked

LITTLE = 0.01
"""Posterior probability of a kind below which its Pareto k and combinations are ignored."""


def models_by_kind(human: HumanModel) -> dict[str, HumanModel]:
    """Human models of the kinds of people; empty if a subclass or instance changes the model."""
    kind = type(human)
    if not isinstance(human, OneOfKinds) or "members" not in vars(kind):
        return {}
    # What the mixture overrides beside its members, they do not have.
    known = {OneOfKinds, *(base for member in human.members.values() for base in member.__mro__)}
    for own in set(kind.__mro__) - known:
        changed = {name for name in vars(own) if not name.startswith("_")} - {"members"}
        if changed or not issubclass(own, OneOfKinds):
            return {}
    if any(callable(getattr(type(human), name, None)) for name in vars(human)):
        return {}
    found = {}
    for name, kind in human.members.items():
        # Includes what the model has learned about the world.
        found[name] = copy(human)
        found[name].__class__ = kind
    return found


def infer_kinds(
    job: Job, models: dict[str, HumanModel], infer: Callable[[Job], Inferred]
) -> Inferred:
    """Infer people by each model, and mix the posteriors by the models' probabilities.

    Args:
        job: what to infer.
        models: human models of the kinds.
        infer: infers by one of them, and estimates evidences.
    """
    people = job.rounds.num_people
    found = []
    for place, model in enumerate(models.values()):
        # Progress counts each person once per model, so that it only increases.
        report = partial(_report, job.report, place, len(models))
        found.append(infer(replace(job, human=model, report=report)))
    with forked():
        probabilities = sample_sites(job.human, 1)[KIND]["fn"].probs.flatten()
    evidences = torch.stack([_given(one.log_evidence) for one in found], -1)  # [P, K]
    errors = torch.stack([_given(one.evidence_error) for one in found], -1)
    log_joint = evidences + probabilities.log().to(evidences)
    shares = log_joint.softmax(-1)
    drawn = []
    for person in range(people):
        seed = job.seed_of(person)
        own = draw_prior(job.human, 1, job.draws, seed % 2**32)
        own[KIND] = _kinds(shares[person], job.draws, seed).view(-1, 1, 1).to(own[KIND])
        for kind, one in enumerate(found):
            rows = (own[KIND].flatten() == kind).nonzero().squeeze(-1)
            for site, value in one.draws.items():
                own[site][rows] = value[rows, person : person + 1].to(own[site])
        drawn.append(own)
    joined = {name: torch.cat([own[name] for own in drawn], 1) for name in drawn[0]}
    weights = torch.stack([_given(one.pareto_k) for one in found], -1)
    return Inferred(
        joined,
        weights.masked_fill(shares < LITTLE, -torch.inf).amax(-1),
        log_joint.logsumexp(-1),
        (shares * errors).square().sum(-1).sqrt(),
        _combinations(job.human, models, found, shares),
        engines=found[0].engines,
    )


def _combinations(
    human: HumanModel, models: dict[str, HumanModel], found: list[Inferred], shares: Tensor
) -> tuple[Tensor, ...]:
    """Probable combinations of each person under their probable kinds.

    Empty where the models' combinations are not of the same values as those of the whole program,
    or are points.
    """
    first, *others = (
        [(site, len(support)) for site, support in perceived_sites(model).items()]
        for model in (human, *models.values())
    )
    alike = all(other == first for other in others)
    if not (alike and all(one.combinations for one in found)):
        return ()
    return tuple(
        torch.cat([found[kind].combinations[person] for kind in kinds.nonzero().flatten()]).unique()
        for person, kinds in enumerate(shares >= LITTLE)
    )


def _report(
    report: Report, place: int, models: int, what: str, done: int, of: int, unit: str
) -> None:
    report(what, place * of + done, models * of, unit)


def _given(numbers: Tensor | None) -> Tensor:
    assert numbers is not None
    return numbers.double()


def _kinds(shares: Tensor, number: int, seed: int) -> Tensor:
    """Sample kinds by systematic resampling, in random order."""
    generator = torch.Generator().manual_seed(seed)
    ladder = (torch.arange(number) + torch.rand((), generator=generator)) / number
    kinds = torch.searchsorted(shares.cpu().cumsum(0), ladder.double()).clamp(max=len(shares) - 1)
    return kinds[torch.randperm(number, generator=generator)]
