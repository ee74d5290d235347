"""What engines add up of a prior, combination by combination, is the density of the program."""

import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro import poutine

from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.combination_sets import fixed_prior
from mirror_ppl.likelihood.combinations import discrete_sites
from mirror_ppl.likelihood.compiled import compile
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.likelihood.densities import log_correction
from mirror_ppl.likelihood.enumeration import log_joints
from mirror_ppl.models.prior import draw_prior, sample_sites
from mirror_ppl.models.toy import ToyHuman
from mirror_ppl.models.variants import VARIANTS
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import simulate

DRAWS = 30


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


def far(implants):
    return implants["reach"] > 2


def answered(implants):
    pyro.sample("q", dist.Normal(implants["in_sight"], 0.05), obs=torch.tensor(0.9))


def mask_of_observed(implants):
    with poutine.mask(mask=far(implants)):
        answered(implants)


def scale_of_observed(implants):
    with poutine.scale(scale=torch.where(far(implants), 3.0, 0.1)):
        answered(implants)


def scale_of_factor(implants):
    with poutine.scale(scale=torch.where(far(implants), 3.0, 0.1)):
        pyro.factor("q", 4 * implants["in_sight"])


def scale_of_latent(implants):
    with poutine.scale(scale=torch.where(far(implants), 3.0, 0.1)):
        pyro.sample("extra", dist.Normal(torch.tensor(0.0), 1.0))


def mask_of_latent(implants):
    with poutine.mask(mask=far(implants)):
        pyro.sample("extra", dist.Normal(torch.tensor(0.0), 1.0))


def own_scale_of_latent(implants):
    with poutine.scale(scale=2.0):
        pyro.sample("extra", dist.Normal(implants["in_sight"], 1.0))


def factor_of_both(implants):
    pyro.factor("q", implants["in_sight"] * far(implants))


def factor_of_another(implants):
    pyro.factor("q", 3 * implants["in_sight"])


SAID = [
    mask_of_observed,
    scale_of_observed,
    scale_of_factor,
    scale_of_latent,
    mask_of_latent,
    own_scale_of_latent,
    factor_of_both,
    factor_of_another,
]


def saying(say, base=ToyHuman):
    """A human model whose prior says something more."""

    class Saying(base):
        def prior(self):
            implants = super().prior()
            say(implants)
            return implants

    return Saying


@pytest.mark.parametrize("say", SAID)
@torch.no_grad()
def test_parts_add_up_to_the_program(say, self_model):
    human = saying(say)(self_model)
    rounds = simulate("driving", "fog", "paper", people=1, rounds=2, seed=100)
    compiled = compile(human, rounds)
    draws = draw_prior(human, 1, DRAWS, 3)
    perceived = {"reach": discrete_sites(human)["reach"]}
    policy = {name: value for name, value in draws.items() if name != "reach"}
    # What engines weigh draws by: the prior of what they draw, all that the program changes about
    # it, and each combination with its prior and likelihood.
    nodes = sample_sites(human, 1, DRAWS, draws)
    drawn = sum(nodes[name]["fn"].log_prob(policy[name])[:, 0, 0] for name in policy)
    parts = drawn + log_correction(human, perceived, policy, 1)[:, 0]
    joint = log_joints(human, compiled.table, policy)[:, 0]  # [S, M]
    values = compiled.table.grid["reach"]
    for place, value in enumerate(values):
        every = policy | {"reach": torch.full_like(draws["reach"], int(value))}
        expected = compiled.log_joint(every)[:, 0]
        torch.testing.assert_close(parts + joint[:, place], expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("say", SAID)
def test_a_prior_is_one_table_where_nothing_else_changes_it(say, self_model):
    human = saying(say)(self_model)
    grid = {"reach": discrete_sites(human)["reach"]}
    fixed = say in (own_scale_of_latent, factor_of_another)
    assert (fixed_prior(human, grid) is not None) == fixed


@torch.no_grad()
def test_discrete_sites_are_drawn_with_masks(self_model):
    """With a certain answer, nobody is drawn for whom it counts and is impossible."""
    human = saying(mask_of_observed)(self_model)
    rounds = simulate("driving", "fog", "paper", people=1, rounds=2, seed=100)
    given = {"in_sight": torch.full((40, 1, 1), 0.3), "otherwise": torch.full((40, 1, 1), 0.1)}
    drawn = compile(human, rounds).sample_discrete(given)
    assert not (drawn["reach"] > 2).any()


class LosesProvenance(VARIANTS["per-item"]):
    """A factor in ``round_latents`` of how far a person sees, by assignment."""

    def round_latents(self, implants):
        latents = super().round_latents(implants)
        weight = torch.zeros_like(implants["assumes_clear"], dtype=torch.float)
        weight[...] = implants["assumes_clear"]
        pyro.factor("more", 1.5 * weight * (1 + next(iter(latents.values()))))
        return latents

    spans = VARIANTS["per-item"].spans


def test_attention_that_depends_on_perception_is_refused_where_provenance_is_lost(self_model):
    rounds = simulate("driving", "fog", "paper", people=1, rounds=1, seed=100)
    with pytest.raises(HumanModelError, match="depends on a site that perceive"):
        compile(LosesProvenance(self_model), rounds)


class LateFactor(ToyHuman):
    """A factor in ``perceive`` that no short trial meets."""

    def perceive(self, implants, knowledge, observation, told, step):
        if step >= 6:
            pyro.factor("late", -3.0 * implants["reach"])
        return super().perceive(implants, knowledge, observation, told, step)


class FactorOfValues(ToyHuman):
    def action_values(self, belief):
        pyro.factor("values", belief[..., 0])
        return super().action_values(belief)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (LateFactor, 'perceive, evidence or believe has the site "late"'),
        (FactorOfValues, 'action_values has the site "values"'),
    ],
)
def test_sites_where_engines_see_none_are_refused(kind, message, self_model):
    rounds = simulate("driving", "fog", "paper", people=1, rounds=1, seed=100)
    with pytest.raises(HumanModelError, match=message):
        compile(kind(self_model), rounds)


def plate_of_questions(implants):
    with pyro.plate("questions", 5, dim=-3):
        pyro.sample("q", dist.Normal(implants["in_sight"], 0.1), obs=torch.zeros(5, 1, 1))


def factor_without_rounds(implants):
    pyro.factor("q", implants["in_sight"].squeeze(-1))


@pytest.mark.parametrize(
    ("say", "message"),
    [
        (plate_of_questions, 'in the plate "questions" at dimension -3'),
        (factor_without_rounds, r'"q" has a log density of shape \(2, 2\)'),
    ],
)
def test_dimensions_of_others_are_refused(say, message, self_model):
    with pytest.raises(HumanModelError, match=message):
        check_contract(saying(say)(self_model))
