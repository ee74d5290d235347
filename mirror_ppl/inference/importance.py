"""Posteriors by importance: how a person may decide, weighted by what their rounds say of it.

Draws of the sites that perception does not read (how somebody decides) come from a proposal; what
they see is marginalized exactly under each of them. With S draws ``psi_s ~ q`` of a person::

    w_s = p(psi_s) sum_m p(m | psi_s) p(actions | m, psi_s) / q(psi_s)

where ``m`` runs over all combinations of the discrete sites that perception reads. So the posterior
is right whatever the proposal, if it has enough draws; Pareto k tells whether it has (Vehtari,
Simpson, Gelman, Yao and Gabry, *Pareto smoothed importance sampling*, 2015).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import pyro
import torch
from pyro import poutine
from torch import Tensor
from torch.distributions import MultivariateNormal, biject_to

from mirror_ppl.errors import HumanModelError
from mirror_ppl.inference.exact import acts_on_beliefs, combination_values, log_joints
from mirror_ppl.inference.views import restricted
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.sites import discrete_names, latent_sites
from mirror_ppl.models.view_table import ViewTable

Draws = dict[str, Tensor]

TRUSTED_PARETO_K = 0.7
"""Above this, the weights of so many draws cannot be relied on (the paper's threshold)."""


@dataclass(frozen=True)
class ImportanceOptions:
    """Settings of adaptive importance sampling.

    Attributes:
        proposals: draws of each stage.
        enough: effective draws at which no stage is added.
        stages: the largest number of stages.
        wider: factor on the covariance of what is proposed after the first stage.
        prune_margin: nats below the best by which a combination of discrete sites, under every draw
            of the first stage, is given up.
    """

    proposals: int = 512
    enough: float = 400.0
    stages: int = 8
    wider: float = 1.5
    prune_margin: float = 12.0

    def __post_init__(self) -> None:
        for name in ("proposals", "stages"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")


@dataclass(frozen=True)
class Weighted:
    """Weighted draws of one person's implants.

    Attributes:
        policy: values of the sites that perception does not read, ``[S, 1, 1, ...]``.
        combinations: of the discrete sites that it reads, numbers ``[C]`` of those still possible.
        log_joint: log-probability of each of them and of the recorded actions under each draw,
            ``[S, C]``, up to what all combinations share.
        log_weights: normalized and Pareto-smoothed, ``[S]``.
        pareto_k: of the weights.
    """

    policy: Draws
    combinations: Tensor
    log_joint: Tensor
    log_weights: Tensor
    pareto_k: float

    @property
    def effective(self) -> float:
        """Effective number of draws."""
        return float(1 / self.log_weights.exp().square().sum())

    def sample(self, number: int, values: Mapping[str, Tensor]) -> Draws:
        """Joint draws ``[number, 1, 1, ...]`` of all sites from the global random state.

        Args:
            number: of draws.
            values: of the discrete sites for every combination, ``[M]``.
        """
        # Systematic resampling, in random order: draws are repeated as little as can be.
        ladder = (torch.arange(number) + torch.rand(())) / number
        place = torch.searchsorted(self.log_weights.exp().cumsum(0), ladder.to(self.log_weights))
        place = place.clamp(max=len(self.log_weights) - 1)[torch.randperm(number)]
        chosen = torch.multinomial(torch.softmax(self.log_joint[place], -1), 1)
        combination = self.combinations[chosen]
        discrete = {site: value[combination][..., None] for site, value in values.items()}
        return {name: value[place] for name, value in self.policy.items()} | discrete


Propose = Callable[[int], tuple[Draws, Tensor]]
"""Draws ``[S, 1, 1, ...]`` of some sites, and the log density ``[S]`` that they have."""


def weigh_person(
    human: HumanModel, table: ViewTable, propose: Propose, number: int, margin: float
) -> Weighted:
    """Weighted draws of one person, of a single proposal.

    Args:
        human: the model of people.
        table: views of one person's rounds.
        propose: what some of the sites are drawn from; the others are drawn from the prior.
        number: of draws S.
        margin: see ``ImportanceOptions.prune_margin``.
    """
    given, log_proposed = propose(number)
    policy, log_prior = complete(human, table, given, number)
    combinations, joint = _joints(human, table, policy, margin)
    log_weights, pareto_k = _smoothed(joint.logsumexp(-1) + log_prior - log_proposed)
    return Weighted(policy, combinations, joint, log_weights, pareto_k)


def sample_exactly(human: HumanModel, table: ViewTable, options: ImportanceOptions) -> Weighted:
    """Weighted draws of one person by adaptive importance sampling from the prior on.

    The first stage draws from the prior. Each that follows draws the scalar sites from a Gaussian,
    in unconstrained space, that has the moments of the weighted draws so far, and the rest from the
    prior given those. All draws are weighted by the mixture of everything that was proposed (Veach
    and Guibas, *Optimally combining sampling techniques*, 1995).

    Args:
        human: the model of people.
        table: views of one person's rounds.
        options: settings.
    """
    sites = _scalars(human, table)
    stages = [_Stage(*_prior_stage(human, table, sites, options.proposals))]
    margin = options.prune_margin
    combinations, joint = _joints(human, table, stages[0].policy, math.inf)
    keep = (joint - joint.max()).amax(0) >= -margin
    combinations, joint = combinations[keep], joint[:, keep]
    table = _only(table, combinations)
    joints, proposals = [joint], []
    while True:
        policy = {
            name: torch.cat([stage.policy[name] for stage in stages]) for name in stages[0].policy
        }
        joint = torch.cat(joints)
        log_prior = torch.cat([stage.log_prior for stage in stages])
        place = torch.cat([stage.place for stage in stages])
        # The prior is one of the proposals, and so weights are bounded.
        proposed = [log_prior, *(proposal.log_prob(place) for proposal in proposals)]
        mixture = torch.logsumexp(torch.stack(proposed), 0) - math.log(len(proposed))
        raw = joint.logsumexp(-1) + log_prior - mixture
        log_weights, pareto_k = _smoothed(raw)
        found = Weighted(policy, combinations, joint, log_weights, pareto_k)
        enough = found.effective >= options.enough or len(stages) == options.stages
        if enough or not sites:
            return found
        proposals.append(_gaussian(place, log_weights, options.wider))
        stages.append(_Stage(*_next_stage(human, table, sites, proposals[-1], options.proposals)))
        joints.append(_joints(human, table, stages[-1].policy, math.inf)[1])


def draw_by_importance(
    human: HumanModel, table: ViewTable, number: int, seed: int, weigh: Callable[..., Weighted]
) -> tuple[Draws, Tensor]:
    """Joint draws ``[number, P, 1, ...]`` of all sites of P people, and Pareto k ``[P]``.

    Args:
        human: the model of people.
        table: views of everybody's rounds.
        number: of draws of each person.
        seed: of everything random.
        weigh: makes weighted draws of a table of one person, given that and the person's number.

    Raises:
        HumanModelError: actions depend on what is seen otherwise than through beliefs.
    """
    if not acts_on_beliefs(human, table):
        raise HumanModelError(
            "act() reads a site that perceive() reads, too; only --guide svi can fit such a model"
        )
    values = combination_values(human, table)
    draws, pareto_k = [], []
    with torch.random.fork_rng(devices=[]):
        for person in range(table.people):
            torch.manual_seed((seed + 1) * 10_000 + person)
            found = weigh(of_person(table, person), person)
            draws.append(found.sample(number, values))
            pareto_k.append(found.pareto_k)
    return (
        {name: torch.cat([own[name] for own in draws], 1) for name in draws[0]},
        torch.tensor(pareto_k),
    )


def of_person(table: ViewTable, person: int) -> ViewTable:
    """The part of a table that is one person's, without padding."""
    one = slice(person, person + 1)
    rounds = max(int(table.real[person].sum()), 1)
    views = max(int(table.view_counts[person]), 1)
    return replace(
        table,
        index=table.index[one, :rounds],
        belief=table.belief[one, :views],
        values=table.values[one, :views],
        view_actions=table.view_actions[one, :views],
        view_steps=table.view_steps[one, :views],
        recorded=table.recorded[one, :rounds],
        steps=table.steps[one, :rounds],
        view_counts=table.view_counts[one],
    )


@torch.no_grad()
def complete(
    human: HumanModel, table: ViewTable, given: Mapping[str, Tensor], number: int
) -> tuple[Draws, Tensor]:
    """Draws ``[S, 1, 1, ...]`` of every site that views do not depend on, some of them given.

    Returns:
        The draws, those that are not given from the prior; and the log prior density ``[S]`` of
        those that are given.
    """
    with (
        poutine.trace() as trace,
        poutine.condition(data=dict(given)),
        pyro.plate("draw", number, dim=-3),
        pyro.plate("person", 1, dim=-2),
    ):
        human.act(human.prior(), table.belief[:, :1], table.values[:, :1])
    log_prior = torch.zeros(number, device=table.index.device)
    for name in given:
        node = trace.trace.nodes[name]
        log_prior = log_prior + node["fn"].log_prob(node["value"]).expand(number, 1, 1).flatten()
    policy = dict(given)
    for name, node in latent_sites(trace.trace).items():
        if name not in table.sites:
            shape = (number, 1, 1, *node["fn"].event_shape)
            policy[name] = node["value"].expand(shape).clone()
    return policy, log_prior


@dataclass(frozen=True)
class _Stage:
    """Draws of one proposal.

    Attributes:
        policy: ``[S, 1, 1, ...]``.
        place: the scalar sites in unconstrained space ``[S, D]``.
        log_prior: density of the scalar sites there under the prior, ``[S]``.
    """

    policy: Draws
    place: Tensor
    log_prior: Tensor


def _scalars(human: HumanModel, table: ViewTable) -> dict[str, object]:
    """Continuous sites of one number a person, with the map from unconstrained space."""
    with (
        torch.random.fork_rng(devices=[]),
        poutine.trace() as trace,
        pyro.plate("draw", 1, dim=-3),
        pyro.plate("person", 1, dim=-2),
    ):
        human.act(human.prior(), table.belief[:, :1], table.values[:, :1])
    discrete = discrete_names(trace.trace)
    return {
        name: biject_to(node["fn"].support)
        for name, node in latent_sites(trace.trace).items()
        if name not in discrete and node["fn"].event_dim == 0
    }


def _prior_stage(human: HumanModel, table: ViewTable, sites, number: int):
    policy, _ = complete(human, table, {}, number)
    place = _place(sites, policy)
    _, log_prior = complete(human, table, {name: policy[name] for name in sites}, number)
    return policy, place, log_prior + _stretch(sites, place)


def _next_stage(human: HumanModel, table: ViewTable, sites, proposal, number: int):
    place = proposal.sample((number,))
    given = {
        name: site(place[:, column]).view(number, 1, 1)
        for column, (name, site) in enumerate(sites.items())
    }
    policy, log_prior = complete(human, table, given, number)
    return policy, place, log_prior + _stretch(sites, place)


def _place(sites, policy: Mapping[str, Tensor]) -> Tensor:
    columns = [site.inv(policy[name].flatten()) for name, site in sites.items()]
    return torch.stack(columns, -1) if columns else torch.zeros(0)


def _stretch(sites, place: Tensor) -> Tensor:
    """Log of by how much space is stretched on the way from unconstrained space, ``[S]``."""
    total = place.new_zeros(len(place))
    for column, site in enumerate(sites.values()):
        total = total + site.log_abs_det_jacobian(place[:, column], site(place[:, column]))
    return total


def _gaussian(place: Tensor, log_weights: Tensor, wider: float) -> MultivariateNormal:
    weights = log_weights.exp()[:, None]
    mean = (weights * place).sum(0)
    centred = place - mean
    covariance = wider * (weights * centred).T @ centred
    # Where few draws have all the weight, their spread says nothing.
    floor = 1e-3 * place.var(0) + 1e-8
    return MultivariateNormal(mean, covariance + torch.diag(floor))


def _joints(
    human: HumanModel, table: ViewTable, policy: Draws, margin: float
) -> tuple[Tensor, Tensor]:
    """Combinations ``[C]`` that are possible, and their log joint ``[S, C]`` under each draw."""
    possible = (table.index[0] >= 0).all(0) | ~table.real.any()
    joint = log_joints(human, table, policy)[:, 0, possible]
    combinations = possible.nonzero().squeeze(-1)
    if math.isfinite(margin):
        keep = (joint - joint.max()).amax(0) >= -margin
        combinations, joint = combinations[keep], joint[:, keep]
    return combinations, joint


def _only(table: ViewTable, combinations: Tensor) -> ViewTable:
    alive = torch.zeros(1, table.index.shape[-1], dtype=torch.bool, device=table.index.device)
    alive[0, combinations] = True
    return restricted(table, alive) if table.real.any() else table


def _smoothed(raw: Tensor) -> tuple[Tensor, float]:
    """Normalized, Pareto-smoothed log weights ``[S]`` and their Pareto k."""
    raw = raw.double()
    if float(raw.max() - raw.min()) < 1e-9:
        return torch.log_softmax(raw, 0), -math.inf
    import arviz as az

    smooth, pareto_k = az.psislw(raw.cpu().numpy())
    return torch.log_softmax(torch.as_tensor(smooth, device=raw.device), 0), float(pareto_k)
