"""The amortized guide: proposes a person's posterior from any number of rounds in any order.

The features that the network reads come from the human model: for W fixed draws of the policy
implants from the prior (*ways*), the log-evidence of the recorded actions, with perceptual implants
marginalized exactly. Log-evidence is a sum over rounds, so their order does not matter and a new
round is one more term. The network maps it to a proposal of the person's policy implants::

    e_w   = log sum_m p(m | psi_w) p(actions | m, psi_w)     for ways psi_w ~ prior
    psi   ~ q(. | e_1 .. e_W, number of steps)               scalar sites, a mixture of Gaussians
    m     ~ p(m | psi, actions)                              exact

and importance weights correct its errors. If too few draws are effective, stages of adaptive
importance sampling follow (:mod:`mirror_ppl.inference.adaptive_importance`).

The network is trained on people drawn from the prior and simulated in the true domain (inference
compilation: Le, Baydin and Wood, 2017), see :mod:`mirror_ppl.training.guide`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.checks import require_kind, whole_number
from mirror_ppl.inference.adaptive_importance import ImportanceOptions, adapt, near_to
from mirror_ppl.inference.amortized_guide import AmortizedGuide, guide_screening
from mirror_ppl.inference.engine import Engine, Inferred, Job
from mirror_ppl.inference.importance import infer_by_importance
from mirror_ppl.inference.refining import refined
from mirror_ppl.inference.sampler import Sampler
from mirror_ppl.inference.weighted import Weighted
from mirror_ppl.likelihood.combination_sets import EquivalentCombinations
from mirror_ppl.likelihood.compiled import ViewTables
from mirror_ppl.likelihood.view_table import ViewTable
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import unconstrained


@dataclass(frozen=True)
class AmortizedOptions:
    """Settings of the amortized guide.

    Attributes:
        proposals: draws from the network's density.
        adaptation: settings of the later stages, which propose near all draws so far.
        refine: gradient steps on the person's rounds before the network's density is used.
    """

    proposals: int = 128
    adaptation: ImportanceOptions = ImportanceOptions(proposals=256)
    refine: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "proposals", whole_number(self.proposals, "proposals", 2))
        object.__setattr__(self, "refine", whole_number(self.refine, "refine", 0))
        require_kind(self.adaptation, ImportanceOptions, "adaptation")


@dataclass(frozen=True)
class Evidence:
    """Evidence of one person's rounds under each way.

    Attributes:
        log_evidence: log-evidence of each way ``[W]``.
        combinations: the possible combinations of perceptual implants, in G sets.
        joint: log joint of these sets under each way, ``[W, G]``.
        ways: draws ``[W, 1, 1, ...]`` of the sites that perception does not read.
        table: views of the rounds.
        steps: number of recorded actions.
    """

    log_evidence: Tensor
    combinations: EquivalentCombinations
    joint: Tensor
    ways: dict[str, Tensor]
    table: ViewTable
    steps: int


def log_evidence(builder: ViewTableBuilder) -> Tensor:
    """Log-evidence ``[W]`` of a person's rounds so far under each way."""
    alive = builder.alive
    return (builder.score[:, alive] + builder.log_prior[:, alive]).logsumexp(-1)


def evidence_of(builder: ViewTableBuilder) -> Evidence:
    """Evidence of a person's rounds so far."""
    table = builder.table()
    combinations = EquivalentCombinations.of(table, builder.fixed_prior)
    prior = (
        combinations.log_prior if combinations.fixed else builder.log_prior[:, combinations.first]
    )
    joint = builder.score[:, combinations.first] + prior
    ways = {name: way for name, way in builder.policies.items() if name not in table.sites}
    return Evidence(joint.logsumexp(-1), combinations, joint, ways, table, int(table.steps.sum()))


@torch.no_grad()
def sample_amortized(
    human: HumanModel,
    guide: AmortizedGuide,
    builder: ViewTableBuilder,
    options: AmortizedOptions | None = None,
    sites: Mapping[str, Any] | None = None,
    near: Weighted | None = None,
) -> Weighted:
    """Weighted draws of one person, from the ways and from the guide.

    If too few are effective, stages of adaptive importance sampling are added.

    Args:
        human: the model of people that the guide was trained for.
        guide: the trained network.
        builder: the person's rounds so far.
        options: settings.
        sites: see :class:`Sampler`.
        near: draws from a similar posterior, whose moments replace the network's proposal.
    """
    options = options or AmortizedOptions()
    evidence = evidence_of(builder)
    sampler = Sampler(human, evidence.table, evidence.combinations, sites)
    sampler.add_prior_draws(evidence.ways, evidence.joint)
    sampler.prune(options.adaptation.prune_margin)
    if near is not None:
        if near.proposed_residual:
            sampler.learn_residual(near)
        place = unconstrained(sampler.sites, near.policy)
        density = near_to(sampler, place, near, options.adaptation)
    elif options.refine and sampler.sites:
        compiled = ViewTables(human, sampler.table)
        density = refined(guide, compiled, evidence.log_evidence, evidence.steps, options.refine)
    else:
        steps = torch.tensor(evidence.steps, device=evidence.log_evidence.device)
        density = guide.density(evidence.log_evidence, steps)
    sampler.propose(density, options.proposals)
    return adapt(sampler, options.adaptation)


def infer_amortized(job: Job) -> Inferred:
    """Infer each person with the network of the job."""
    network = job.network
    assert network is not None
    options = replace(job.settings, refine=job.refine)
    return infer_by_importance(
        replace(job, screening=guide_screening(), settings=ImportanceOptions()),
        lambda builder, _: (
            ENGINE.name,
            sample_amortized(job.human, network, builder, options),
        ),
    )


ENGINE = Engine(
    "amortized",
    infer_amortized,
    AmortizedOptions,
    each_alone=True,
    pooled_draws=4000,
    takes_network=True,
    needs_network=True,
)
