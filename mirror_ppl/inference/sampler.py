"""Weighted draws of one person's implants, from several proposals.

With draws ``psi_s ~ q`` of a person::

    w_s = p(psi_s) sum_m p(m | psi_s) p(actions | m, psi_s) / q(psi_s)

where ``m`` runs over all joint values of the sites that perception reads, and densities are those
of the program with its observed sites, scales and factors. ``q`` is the mixture of all proposals
(Veach and Guibas, *Optimally combining sampling techniques for Monte Carlo rendering*, 1995), so
that weights are bounded. Pareto k diagnoses whether there are enough draws (Vehtari, Simpson,
Gelman, Yao and Gabry, *Pareto smoothed importance sampling*, 2015).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from mirror_ppl.errors import RuledOutError
from mirror_ppl.inference.pareto import pareto_smoothed
from mirror_ppl.inference.residual_proposal import SITE, ResidualProposal
from mirror_ppl.inference.weighted import Weighted
from mirror_ppl.likelihood.combination_sets import EquivalentCombinations, fixed_prior
from mirror_ppl.likelihood.densities import log_correction
from mirror_ppl.likelihood.enumeration import (
    expected_counts,
    log_joints,
    require_acting_on_beliefs,
)
from mirror_ppl.likelihood.merged_moments import merged_for
from mirror_ppl.likelihood.policies import ENOUGH, effective, within
from mirror_ppl.likelihood.tables import restricted
from mirror_ppl.likelihood.view_table import ViewTable
from mirror_ppl.models.dependencies import dependencies
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import Draws, sample_sites, scalar_sites, unconstrained, values_of
from mirror_ppl.randomness import forked

DEFENSIVE_SHARE = 0.1
"""Share of draws of the residual and of discrete sites from a defensive proposal near the prior.
"""
RESIDUAL_DRAWS = 64
"""Draws from which the proposal of the residual is fitted."""
MANY_MOMENTS = 8192
"""Number of moments from which those are merged that likely draws do not tell apart."""
MERGING_DRAWS = 32
"""Number of these draws."""


class Proposal(Protocol):
    """Protocol of a density over the scalar sites in unconstrained space, as in torch."""

    def sample(self, sample_shape: torch.Size) -> Tensor:
        """Draws ``[S, D]``."""
        ...

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density ``[S]``."""
        ...


class NoScalars:
    """Proposal for models without scalar sites."""

    def sample(self, sample_shape: torch.Size) -> Tensor:
        """Empty draws ``[S, 0]``."""
        return torch.zeros(*sample_shape, 0)

    def log_prob(self, value: Tensor) -> Tensor:
        """Zeros ``[S]``."""
        return value.new_zeros(len(value))


@dataclass(frozen=True)
class _Stage:
    """Proposal of a stage.

    Attributes:
        number: number of draws.
        scalars: proposal of the scalar sites; ``None`` for the prior.
        residual: True if the residual was proposed, too.
        log_probabilities: log-probabilities of values of the proposed discrete sites ``[n]``.
    """

    number: int
    scalars: Proposal | None = None
    residual: bool = False
    log_probabilities: Mapping[str, Tensor] = field(default_factory=dict)


class Sampler:
    """Importance sampler of one person with several proposals, the first of which is the prior.

    Proposals are over the scalar sites and, once fitted, over the residual of the policy and
    discrete sites that perception does not read; all other sites are drawn from the prior.

    Args:
        human: the model of people.
        table: views of one person's rounds.
        combinations: the possible combinations, if they are known.
        sites: result of :func:`scalar_sites` for a model that is known to act on beliefs alone;
            computed and checked by default.

    Raises:
        HumanModelError: percepts affect actions other than through beliefs.

    Attributes:
        combinations: the combinations of what perception reads that are still possible.
        place: the scalar sites of all draws, in unconstrained space ``[S, D]``.
        supports: supports of the discrete sites of the policy ``[n]``.
    """

    def __init__(
        self,
        human: HumanModel,
        table: ViewTable,
        combinations: EquivalentCombinations | None = None,
        sites: Mapping[str, Any] | None = None,
    ) -> None:
        if sites is None:
            require_acting_on_beliefs(human, table.sites)
        self.human = human
        self.table = table
        every = scalar_sites(human) if sites is None else sites
        self.sites = {name: site for name, site in every.items() if name not in table.sites}
        if combinations is None:
            combinations = EquivalentCombinations.of(table, fixed_prior(human, table.grid))
        self.combinations = combinations
        self.place = torch.zeros(0, len(self.sites), device=table.index.device)
        self.supports = _policy_supports(human, table)
        self._stages: list[_Stage] = []
        self._log_probabilities: dict[str, Tensor] = {}
        self._policies: list[Draws] = []
        self._joints: list[Tensor] = []
        self._log_prior = torch.zeros(2, 0, device=table.index.device)  # of scalars, of discrete
        self._corrections: list[Tensor] = []
        self._residual: ResidualProposal | None = None
        self._log_residual = torch.zeros(2, 0, device=table.index.device)

    def draw(self, number: int) -> None:
        """Draw from the prior."""
        policy, _ = complete(self.human, self.table, {}, number)
        self.add_prior_draws(policy, self._joint(policy, number))

    def add_prior_draws(self, policy: Draws, joint: Tensor) -> None:
        """Add given draws ``[S, 1, 1, ...]`` from the prior, with their log joint ``[S, G]``."""
        place = unconstrained(self.sites, policy, len(joint))
        # All sites are given, since priors may depend on any of them.
        own = (*self.sites, *self.supports)
        _, log_priors = complete(self.human, self.table, policy, len(joint), own)
        self._add(policy, joint, place, log_priors)
        self._stages.append(_Stage(len(joint)))

    def prune(self, margin: float) -> None:
        """Drop combinations that are behind the best by more than ``margin`` nats under every draw.

        Draws have to be from the prior. As none of them may resemble the person, those are kept,
        too, that are not behind under :attr:`ViewTable.likely`. None is dropped if the program adds
        factors or observed sites under which too few of the draws are effective. Those are kept
        that are impossible under a draw, as under others they may be the most probable.
        """
        joint, said = torch.cat(self._joints), torch.cat(self._corrections)
        if float(said.max() - said.min()) > 0 and effective(said) < min(ENOUGH, len(said) / 2):
            return
        keep = within(self.human, joint + said[:, None], margin) | joint.isneginf().any(0)
        likely = {s: own for s, own in self.table.likely.items() if s not in self.table.sites}
        if likely:
            number = len(next(iter(likely.values())))
            added = log_correction(self.human, self.table.grid, likely, 1)[:, 0].expand(number)
            every = torch.cat([joint, self._joint(likely, number)])
            keep |= within(self.human, every + torch.cat([said, added])[:, None], margin)
        if self.combinations.fixed:
            keep &= self.combinations.log_prior.isfinite()
        self.combinations = self.combinations.kept(keep)
        self._joints = [joint[:, keep] for joint in self._joints]
        if self.table.real.any():
            alive = torch.zeros_like(self.table.index[:, 0], dtype=torch.bool)
            alive[0, self.combinations.members] = True
            self.table = restricted(self.table, alive)

    def merge(self, found: Weighted, resolution: float) -> None:
        """Merge moments that draws from these weighted ones do not tell apart, if there are many.

        Later draws take less time then. Joints of earlier draws stay as they are.

        Args:
            found: weighted draws.
            resolution: see `merged_for`; 0 for not merging.
        """
        many = self.table.acted.numel() >= MANY_MOMENTS
        if not (many and resolution) or self.table.attention is not None:
            return
        likely = torch.multinomial(found.log_weights.exp(), MERGING_DRAWS, replacement=True)
        policies = {name: value[likely] for name, value in found.policy.items()}
        self.table = merged_for(self.human, self.table, policies, resolution)

    @property
    def proposes_residual(self) -> bool:
        """True if the residual is proposed."""
        return self._residual is not None

    def learn_residual(self, found: Weighted) -> None:
        """Fit a proposal of the residual to these weighted draws, and use it from now on.

        A share of :data:`DEFENSIVE_SHARE` of later draws still has a residual from the prior.
        """
        if SITE not in found.policy or not self.table.real.any():
            return
        # It replaces drawn residuals, on which no other drawn site may depend.
        parents = dependencies(self.human).prior
        if any(SITE in parents[name] for name in found.policy):
            return
        # Under draws that the recorded actions rule out, moments have no expected counts.
        possible = int((found.log_weights > -torch.inf).sum())
        best = found.log_weights.topk(min(RESIDUAL_DRAWS, possible)).indices
        counts = expected_counts(
            self.human,
            self.table,
            {name: value[best] for name, value in found.policy.items()},
            found.log_weights[best],
            self.combinations.first,
            self.combinations.log_prior if self.combinations.fixed else None,
        )
        self._residual = ResidualProposal.of(self.human, self.table, counts)
        own = self._policy()
        self._log_residual = self._residual_densities(own, self._residual.gaussian(own))

    def learn_discrete(self, found: Weighted) -> None:
        """Fit proposals of discrete sites of the policy, and use them from now on.

        Sites are independent. A share of :data:`DEFENSIVE_SHARE` is defensive, in equal parts by
        the first draws, which are from the prior, and uniform.
        """
        for name, support in self.supports.items():
            own = found.policy[name].flatten()[:, None] == support
            anybody = own[: self._stages[0].number].double().mean(0)
            likely = found.log_weights.exp().double() @ own.double()
            anyhow = (anybody + 1 / len(support)) / 2  # in few draws the prior may miss some
            self._log_probabilities[name] = (
                DEFENSIVE_SHARE * anyhow + (1 - DEFENSIVE_SHARE) * likely
            ).log()

    def _residual_densities(self, policy: Draws, gaussian: MultivariateNormal) -> Tensor:
        """Log densities ``[2, S]`` of residuals under the prior and under the proposal."""
        _, prior = complete(self.human, self.table, policy, len(policy[SITE]), (SITE,))
        return torch.stack([prior[SITE], gaussian.log_prob(policy[SITE].flatten(1))])

    def propose(self, proposal: Proposal, number: int) -> None:
        """Add draws from a proposal."""
        place = proposal.sample(torch.Size([number]))
        given: dict[str, Tensor] = {
            name: site(place[:, column]).view(number, 1, 1)
            for column, (name, site) in enumerate(self.sites.items())
        }
        for name, log_probabilities in self._log_probabilities.items():
            chosen = torch.multinomial(log_probabilities.exp(), number, replacement=True)
            given[name] = self.supports[name][chosen].view(number, 1, 1)
        drawn = (*self.sites, *self.supports)
        policy, log_priors = complete(self.human, self.table, given, number, drawn)
        if self._residual is not None:
            gaussian = self._residual.gaussian(policy)
            own = policy[SITE]
            drawn = gaussian.sample().view(own.shape)
            anyhow = torch.arange(number, device=own.device) < DEFENSIVE_SHARE * number
            policy[SITE] = torch.where(anyhow.view(number, *(1,) * (own.dim() - 1)), own, drawn)
            found = self._residual_densities(policy, gaussian)
            self._log_residual = torch.cat([self._log_residual, found], 1)
        self._add(policy, self._joint(policy, number), place, log_priors)
        residual = self._residual is not None
        self._stages.append(_Stage(number, proposal, residual, dict(self._log_probabilities)))

    def _add(
        self, policy: Draws, joint: Tensor, place: Tensor, log_priors: Mapping[str, Tensor]
    ) -> None:
        self._policies.append(policy)
        self._joints.append(joint)
        found = log_correction(self.human, self.table.grid, policy, 1)[:, 0]
        self._corrections.append(found.expand(len(joint)))
        self.place = torch.cat([self.place, place])
        groups = []
        for names in (self.sites, self.supports):
            own = [log_priors[name] for name in names]
            groups.append(torch.stack(own).sum(0) if own else place.new_zeros(len(joint)))
        groups[0] = groups[0] + _log_abs_det(self.sites, place)
        self._log_prior = torch.cat([self._log_prior, torch.stack(groups)], 1)

    def _policy(self) -> Draws:
        """All draws so far ``[S, 1, 1, ...]``."""
        return {
            name: torch.cat([one[name] for one in self._policies]) for name in self._policies[0]
        }

    def weighted(self) -> Weighted:
        """All draws so far, with their weights."""
        joint, policy = torch.cat(self._joints), self._policy()
        of_scalars, of_discrete = self._log_prior
        prior = either = torch.zeros_like(of_scalars)
        if self._residual is not None:
            prior, proposed = self._log_residual
            either = torch.logaddexp(
                prior + math.log(DEFENSIVE_SHARE), proposed + math.log1p(-DEFENSIVE_SHARE)
            )
        places_in = {
            name: (policy[name].flatten()[:, None] == support).long().argmax(-1)
            for name, support in self.supports.items()
        }
        parts = []
        for stage in self._stages:
            density = of_scalars if stage.scalars is None else stage.scalars.log_prob(self.place)
            density = density + (either if stage.residual else prior)
            discrete = of_discrete
            if stage.log_probabilities:
                own = [
                    probabilities[places_in[name]]
                    for name, probabilities in stage.log_probabilities.items()
                ]
                discrete = torch.stack(own).sum(0).to(density)
            parts.append(density + discrete + math.log(stage.number / len(joint)))
        mixture = torch.logsumexp(torch.stack(parts), 0)
        target = joint.logsumexp(-1) + of_scalars + of_discrete + prior
        target = target + torch.cat(self._corrections)
        if bool((target == -math.inf).all()):
            raise RuledOutError(
                "the recorded actions have probability 0 under all draws of the implants: act() "
                "has to give every recorded action some probability, as lapses do"
                if bool((joint == -math.inf).all())
                else "factors or observed sites of the model have probability 0 under all draws of "
                "the implants that allow the recorded actions: prior() has to leave some possible"
            )
        weights = (target - mixture).double()
        log_weights, pareto_k = pareto_smoothed(weights)
        log_evidence = float(weights.logsumexp(0)) - math.log(len(weights))
        return Weighted(
            policy,
            self.combinations,
            joint,
            log_weights,
            pareto_k,
            log_evidence,
            self.proposes_residual,
        )

    def _joint(self, policy: Draws, number: int) -> Tensor:
        combinations = self.combinations
        prior = combinations.log_prior if combinations.fixed else None
        joint = log_joints(self.human, self.table, policy, combinations.first, prior)[:, 0]
        return joint.expand(number, -1)


@torch.no_grad()
def complete(
    human: HumanModel,
    table: ViewTable,
    given: Mapping[str, Tensor],
    number: int,
    asked: Sequence[str] | None = None,
) -> tuple[Draws, dict[str, Tensor]]:
    """Complete draws ``[S, 1, 1, ...]`` of all sites that views do not depend on.

    Returns:
        The draws, with missing sites from the prior; and log prior densities ``[S]`` of the sites
        ``asked``, by default of the given ones.
    """
    nodes = sample_sites(human, 1, number, given)
    values = values_of(nodes)
    log_priors = {
        name: nodes[name]["fn"].log_prob(values[name]).view(number)
        for name in (given if asked is None else asked)
    }
    policy = {name: value for name, value in values.items() if name not in table.sites}
    return policy, log_priors


def _policy_supports(human: HumanModel, table: ViewTable) -> dict[str, Tensor]:
    """Supports ``[n]`` of discrete sites that perception does not read."""
    with forked():
        return {
            name: node["fn"].enumerate_support(expand=False).flatten()
            for name, node in sample_sites(human, 1).items()
            if node["fn"].has_enumerate_support
            and node["fn"].event_dim == 0
            and name not in table.sites
        }


def _log_abs_det(sites: Mapping[str, Any], place: Tensor) -> Tensor:
    """Log absolute determinant of the Jacobian of the map from unconstrained space, ``[S]``."""
    total = place.new_zeros(len(place))
    for column, site in enumerate(sites.values()):
        total = total + site.log_abs_det_jacobian(place[:, column], site(place[:, column]))
    return total
