"""Evidence and posteriors, exact over discrete sites, against enumeration by hand."""

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from exact import log_joint, log_prior, marginals
from example_combinations import COMBINATIONS, LENGTHS, PRIOR, SITES, fixed_policy, some_policy
from example_views import Few, log_likelihoods_by_hand
from pyro.infer import TraceEnum_ELBO, config_enumerate

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.inference.marginal_elbo import MarginalELBO
from mirror_ppl.inference.svi import continuous_guide
from mirror_ppl.likelihood.compiled import ViewTables
from mirror_ppl.likelihood.table_program import TableProgram
from mirror_ppl.likelihood.tables import build_view_table, restricted
from mirror_ppl.models import HumanModel
from mirror_ppl.models.simulation import play_rounds


class Nested(Few):
    """Few, but how likely each assumption is depends on a continuous site."""

    def prior(self):
        trust = pyro.sample("trust", dist.Beta(2.0, 2.0))
        own = super().prior()
        probabilities = torch.stack([1 - trust, trust], -1)
        own["assumes_clear"] = pyro.sample("assumes_clear_too", dist.Categorical(probabilities))
        return own | {"assumes_clear_too": own["assumes_clear"], "trust": trust}

    def perceive(self, implants, knowledge, observation, told, step):
        own = {site: implants[site] for site in ("sight_front_own", "assumes_clear_too")}
        own["assumes_clear"] = own["assumes_clear_too"]
        return super().perceive(own, knowledge, observation, told, step)


def log_prior_by_hand(policy):
    """Log prior density of the policy's implants, summed over people."""
    priors = {
        "consistency": dist.LogNormal(math.log(3.0), 0.5),
        "lapse": dist.Beta(1.0, 30.0),
        "residual_in": dist.Normal(0.0, 48**-0.5),
        "residual_out": dist.Normal(0.0, 0.1),
    }
    return sum(priors[name].log_prob(value).sum() for name, value in policy.items())


def bound_at(human, table, values):
    """The evidence lower bound with a guide that is certain of the continuous sites."""

    def guide(table):
        with pyro.plate("person", table.people, dim=-2):
            for name, value in values.items():
                pyro.sample(name, dist.Delta(value, event_dim=value.dim() - 2))

    model = config_enumerate(TableProgram(human), "parallel")
    return -TraceEnum_ELBO(max_plate_nesting=2).loss(model, guide, table)


def test_bound_at_a_point_is_the_exact_evidence(few, table):
    policy = some_policy(few, table.people)
    evidence = torch.logsumexp(log_joint(few, table, policy), -1)
    expected = log_prior_by_hand(policy) + evidence.sum()
    assert bound_at(few, table, policy) == pytest.approx(expected.item(), rel=1e-5)


def test_bound_at_a_point_is_the_exact_evidence_of_the_own_model(self_model, rounds):
    human = HumanModel(self_model)
    one = rounds.select_people([0]).select_rounds([0])
    table = build_view_table(human, one, [torch.arange(0, 9604, 7)])
    policy = some_policy(human)
    joint = log_joint(human, table, policy)
    assert (joint > -1e5).sum() == 9604 / 7
    expected = log_prior_by_hand(policy) + torch.logsumexp(joint, -1).sum()
    assert bound_at(human, table, policy) == pytest.approx(expected.item(), rel=1e-5)


def test_prior_of_combinations_by_hand(few, table):
    prior = log_prior(few, table, some_policy(few))
    torch.testing.assert_close(prior, PRIOR.log().expand(3, -1))


def test_prior_of_combinations_may_depend_on_other_sites(self_model, rounds):
    human = Nested(self_model)
    table = build_view_table(human, rounds)
    assert table.sites == ("sight_front_own", "assumes_clear_too")
    policy = some_policy(human, 3) | {"trust": torch.tensor([[0.1], [0.5], [0.8]])}
    trust = policy["trust"]
    probabilities = torch.stack([1 - trust, trust], -1)  # [P, 1, 2]
    expected = (torch.arange(1.0, 8)[:, None] / 28 * probabilities).log().flatten(1)
    torch.testing.assert_close(log_prior(human, table, policy), expected)


def test_marginals_equal_brute_force(few, table, rounds):
    policy = some_policy(few)
    found = marginals(table, log_joint(few, table, policy))
    for person, lengths in enumerate(LENGTHS):
        joint = PRIOR.log().clone()
        for number in range(len(lengths)):
            joint += log_likelihoods_by_hand(few, rounds, person, number, COMBINATIONS, policy)
        weights = joint.exp() / joint.exp().sum()
        for site in SITES:
            by_value = torch.zeros(table.sizes[SITES.index(site)])
            for weight, value in zip(weights, COMBINATIONS[site], strict=True):
                by_value[value] += weight
            torch.testing.assert_close(found[site][person], by_value, rtol=1e-3, atol=1e-5)
    # Of a person without rounds nothing is learned.
    torch.testing.assert_close(found["sight_front_own"][1], torch.arange(1.0, 8) / 28)


def test_people_of_the_model_are_recognized(few, generator):
    people, policy = 40, fixed_policy(40, 3.0)
    truth = torch.multinomial(PRIOR, people, replacement=True, generator=generator)
    implants = {site: value[truth] for site, value in COMBINATIONS.items()}
    known = policy | {site: value[:, None] for site, value in implants.items()}
    table = build_view_table(few, play_rounds(few, known, 10, "fog", generator))
    found = marginals(table, log_joint(few, table, policy))
    for site in SITES:
        p = found[site].double()
        right = p.gather(-1, implants[site][:, None]).squeeze(-1)
        # Truth and data are drawn together, so the truth is a draw from the posterior: its
        # probability has the mean sum p^2, and the variance sum p^3 - (sum p^2)^2.
        mean, variance = p.square().sum(-1), p.pow(3).sum(-1) - p.square().sum(-1).square()
        assert (right - mean).sum().abs() < 4.5 * variance.sum().sqrt()
        # It has more than half of the mass as often as the posterior itself says, which is for
        # most people.
        expected = torch.where(p.amax(-1) > 0.5, p.amax(-1), 0.0)
        error = 4.5 * (expected * (1 - expected)).sum().sqrt()
        assert ((right > 0.5).sum() - expected.sum()).abs() < error
        assert expected.mean() > 0.5


def test_the_marginal_elbo_is_that_of_enumeration(self_model):
    """Loss and gradients, before and after giving up combinations."""
    human = HumanModel(self_model)
    recordings = load_demonstrations(asset_path("driving_fog_paper.nc")).select_people([0, 4])
    table = build_view_table(human, recordings.select_rounds([0, 1]))
    alive = torch.zeros(2, 9604, dtype=torch.bool)
    alive[0, ::97] = alive[1, ::53] = True
    for some in (table, restricted(table, alive)):
        compiled = ViewTables(human, some)
        guide, found = continuous_guide(compiled), []
        enumerated = TraceEnum_ELBO(max_plate_nesting=2, strict_enumeration_warning=False)
        for elbo in (MarginalELBO(compiled), enumerated):
            guide.zero_grad()
            torch.manual_seed(3)
            with pyro.settings.context(module_local_params=True):
                program = config_enumerate(compiled.program, "parallel")
                value = elbo.differentiable_loss(program, guide)
            value.backward()
            found.append([value.detach(), *(p.grad.clone() for p in guide.parameters())])
        for one, other in zip(*found, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3)
