"""The amortized guide: a person's posterior at once, from any number of rounds in any order.

What a network reads of a person is what the human model says about their rounds: for a few ways to
decide, drawn from the prior once and for all, the log-evidence of the recorded actions, with what
the person sees marginalized exactly. Evidence adds up over rounds, so their order does not matter
and a new round is one more term. From it the network proposes how this person decides::

    e_w   = log sum_m p(m | psi_w) p(actions | m, psi_w)     for ways psi_w ~ prior
    psi   ~ q(. | e_1 .. e_W, number of steps)               scalar sites, a mixture of Gaussians
    m     ~ p(m | psi, actions)                              exact

and importance weights take care of what it gets wrong
(:mod:`mirror_ppl.inference.adaptive_importance`).

The network is trained on people drawn from the prior and simulated in the true domain (inference
compilation: Le, Baydin and Wood, 2017), see :mod:`mirror_ppl.training.guide`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor, nn

from mirror_ppl.errors import InputError
from mirror_ppl.inference.adaptive_importance import (
    LEARNED_FROM,
    PLAIN_STAGES,
    ImportanceOptions,
)
from mirror_ppl.inference.engine import Engine, Inferred, Job
from mirror_ppl.inference.importance import infer_by_importance
from mirror_ppl.inference.margins import PriorMargins, prior_knots
from mirror_ppl.inference.sampler import Sampler, Weighted
from mirror_ppl.likelihood.combination_sets import EquivalentCombinations
from mirror_ppl.likelihood.view_table import ViewTable
from mirror_ppl.likelihood.view_table_builder import Screening, ViewTableBuilder
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import scalar_sites, unconstrained

WAYS = 64
COMPONENTS = 4
HIDDEN = 128
DROPOUT = 0.2
TEMPERATURES = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
PRIOR_DRAWS = 20_000
LEAST_EVIDENCE = -30.0
SOFTPLUS_ONE = 0.5413  # its softplus is 1


@dataclass(frozen=True)
class AmortizedOptions:
    """Settings of proposing by a network.

    Attributes:
        proposals: draws from the guide of a stage.
        enough: effective draws at which no stage is added.
        stages: the largest number of stages.
        prune_margin: see :class:`ImportanceOptions`.
    """

    proposals: int = 64
    enough: float = 400.0
    stages: int = 16
    prune_margin: float = 12.0

    def __post_init__(self) -> None:
        for name in ("proposals", "stages"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")


def guide_screening() -> Screening:
    """The screening that an amortized guide needs: its ways are what the network reads."""
    return Screening(policies=WAYS)


@dataclass(frozen=True)
class Evidence:
    """What the rounds of one person say about ways to decide.

    Attributes:
        log_evidence: of each way ``[W]``.
        combinations: of what the person sees, those still possible.
        joint: log joint of these G sets under each way, ``[W, G]``.
        ways: the ways, draws ``[W, 1, 1, ...]`` of the sites that perception does not read.
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
    """Log-evidence ``[W]`` of a person's rounds so far under each way to decide."""
    alive = builder.alive
    return (builder.score[:, alive] + builder.log_prior[:, alive]).logsumexp(-1)


def evidence_of(builder: ViewTableBuilder) -> Evidence:
    """What a person's rounds so far say."""
    table = builder.table()
    combinations = EquivalentCombinations.of(table, builder.fixed_prior)
    prior = (
        combinations.log_prior if combinations.fixed else builder.log_prior[:, combinations.first]
    )
    joint = builder.score[:, combinations.first] + prior
    ways = {name: way for name, way in builder.policies.items() if name not in table.sites}
    return Evidence(joint.logsumexp(-1), combinations, joint, ways, table, int(table.steps.sum()))


class AmortizedGuide(nn.Module):
    """``q(psi | rounds)`` of the scalar sites of a human model, in unconstrained space.

    Before it has learned anything it is about the prior's margins, and independent.

    Args:
        places: of the ways that evidence is about, ``[W, D]``.
        prior: of draws from the prior, for its margins, ``[S, D]``; the ways if not given.

    Attributes:
        knots: of the prior's margins, see :class:`PriorMargins`, ``[D, K]``.
        ways: places of the ways, in which the prior is standard normal, ``[W, D]``.
        gate: how much of the mean, at each temperature of the evidence, is that of importance
            sampling from the prior, ``[temperatures, D]``.
    """

    ways: Tensor
    knots: Tensor

    def __init__(self, places: Tensor, prior: Tensor | None = None) -> None:
        super().__init__()
        number, self.dimensions = places.shape
        self.register_buffer("knots", prior_knots(places if prior is None else prior))
        self.register_buffer("ways", PriorMargins(self.knots).inv(places))
        moments = 2 * self.dimensions + 1
        triangle = self.dimensions * (self.dimensions + 1) // 2
        self.body = nn.Sequential(
            nn.Linear(number + len(TEMPERATURES) * moments + 1, HIDDEN),
            nn.ReLU(),
            nn.Dropout(DROPOUT),
            nn.Linear(HIDDEN, HIDDEN),
            nn.ReLU(),
            nn.Dropout(DROPOUT),
        )
        self.head = nn.Linear(HIDDEN, COMPONENTS * (1 + self.dimensions + triangle))
        nn.init.normal_(self.head.weight, std=0.01)
        nn.init.normal_(self.head.bias, std=0.1)
        self.gate = nn.Parameter(torch.zeros(len(TEMPERATURES), self.dimensions))

    def features(self, log_evidence: Tensor, steps: Tensor) -> tuple[Tensor, Tensor]:
        """What the network reads ``[..., F]`` of evidence ``[..., W]`` of so many steps ``[...]``.

        Besides the evidence itself: what importance sampling from the prior would give for mean
        and spread, also with evidence tempered, where few ways have all the weight. These means
        once more, ``[..., temperatures, D]``.
        """
        relative = log_evidence - log_evidence.amax(-1, keepdim=True)
        parts, means = [relative.clamp(min=LEAST_EVIDENCE) / 10.0], []
        for temperature in TEMPERATURES:
            weights = torch.softmax(relative / temperature, -1)
            mean = weights @ self.ways
            spread = (weights @ self.ways.square() - mean.square()).clamp(min=0).sqrt()
            effective = 1 / weights.square().sum(-1, keepdim=True)
            parts += [mean, spread, effective / len(self.ways)]
            means.append(mean)
        parts.append(torch.log1p(steps.to(relative))[..., None] / 5.0)
        return torch.cat(parts, -1), torch.stack(means, -2)

    def reads(self, places: Tensor) -> bool:
        """Whether it learned to read evidence about ways at these places ``[W, D]``."""
        if self.ways.shape != places.shape:
            return False
        own = PriorMargins(self.knots)(self.ways)
        return torch.allclose(own, places.to(own), atol=1e-3)

    def density(self, log_evidence: Tensor, steps: Tensor) -> dist.TorchDistribution:
        """``q`` over places ``[..., D]`` in unconstrained space."""
        size = self.dimensions
        features, means = self.features(log_evidence, steps)
        out = self.head(self.body(features)).unflatten(-1, (COMPONENTS, -1))
        logits, mean, triangle = out.split([1, size, size * (size + 1) // 2], -1)
        mean = mean + (self.gate * means).sum(-2)[..., None, :]
        rows, columns = torch.tril_indices(size, size)
        lower = mean.new_zeros(*triangle.shape[:-1], size, size)
        lower[..., rows, columns] = triangle
        # Without anything learned it is one, as the prior's.
        diagonal = nn.functional.softplus(lower.diagonal(dim1=-2, dim2=-1) + SOFTPLUS_ONE) + 1e-3
        mixture = dist.MixtureSameFamily(
            dist.Categorical(logits=logits.squeeze(-1)),
            dist.MultivariateNormal(
                mean, scale_tril=torch.tril(lower, -1) + torch.diag_embed(diagonal)
            ),
        )
        return dist.TransformedDistribution(mixture, [PriorMargins(self.knots)])

    def forward(
        self, sites: Mapping[str, dist.transforms.Transform], log_evidence: Tensor, steps: Tensor
    ) -> None:
        """The guide as a Pyro program over the scalar sites of P people, ``[P, W]`` and ``[P]``."""
        with pyro.plate("person", len(log_evidence), dim=-2):
            place = pyro.sample(
                "place",
                self.density(log_evidence[:, None], steps[:, None]),
                infer={"is_auxiliary": True},
            )
            for column, (name, site) in enumerate(sites.items()):
                value = site(place[..., column])
                stretch = site.log_abs_det_jacobian(place[..., column], value)
                pyro.sample(name, dist.Delta(value, log_density=-stretch))


def reference_places(human: HumanModel, number: int = WAYS) -> Tensor:
    """Places ``[W, D]`` of ways from the prior; always the same of a human model."""
    builder = ViewTableBuilder(human, Screening(policies=number))
    return unconstrained(scalar_sites(human), builder.draw_policies())


def require_network_of(human: HumanModel, network: AmortizedGuide) -> None:
    """Refuse networks that were trained for another human model.

    Raises:
        InputError: this is one.
    """
    if not network.reads(reference_places(human)):
        raise InputError(
            f"the network is for another human model than {type(human).__name__} in "
            f"{human.domain.name}; see load_guide"
        )


@torch.no_grad()
def sample_amortized(
    human: HumanModel,
    guide: AmortizedGuide,
    builder: ViewTableBuilder,
    options: AmortizedOptions | None = None,
    sites: Mapping[str, Any] | None = None,
) -> Weighted:
    """Weighted draws of one person: the guide's, and the ways that evidence is about.

    Args:
        human: the model of people that the guide was trained for.
        guide: the trained network.
        builder: the person's rounds so far.
        options: settings.
        sites: see :class:`Sampler`.
    """
    options = options or AmortizedOptions()
    evidence = evidence_of(builder)
    sampler = Sampler(human, evidence.table, evidence.combinations, sites)
    sampler.add_prior_draws(evidence.ways, evidence.joint)
    sampler.prune(options.prune_margin)
    steps = torch.tensor(evidence.steps, device=evidence.log_evidence.device)
    density = guide.density(evidence.log_evidence, steps)
    for stage in range(options.stages):
        sampler.propose(density, options.proposals)
        found = sampler.weighted()
        if found.effective >= options.enough:
            break
        # The network says nothing about the residual; draws do, once there are some.
        if stage >= PLAIN_STAGES and not sampler.proposes_residual:
            sampler.learn_residual(found.tempered(LEARNED_FROM))
    return found


def infer_amortized(job: Job) -> Inferred:
    """Person after person, each at once."""
    network = job.network
    assert network is not None
    return infer_by_importance(
        replace(job, screening=guide_screening(), settings=ImportanceOptions()),
        lambda builder, _: (
            ENGINE.name,
            sample_amortized(job.human, network, builder, job.settings),
        ),
    )


ENGINE = Engine(
    "amortized",
    infer_amortized,
    AmortizedOptions,
    pooled_draws=4000,
    weighted=True,
    takes_network=True,
    needs_network=True,
)
