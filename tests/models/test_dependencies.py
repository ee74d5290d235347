"""What depends on what, of shipped models and examples, against what is written in them."""

import sys
from importlib import import_module

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_models import SHIPPED
from example_person import self_model
from paths import EXAMPLES

from mirror_ppl.domains import get_domain
from mirror_ppl.errors import HumanModelError
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.hierarchical_proposal import dependent_sites
from mirror_ppl.inference.population.pooling import Pooling
from mirror_ppl.likelihood.combination_sets import fixed_prior
from mirror_ppl.likelihood.combinations import perceived_sites, require_own_attention
from mirror_ppl.likelihood.grid import grid_of
from mirror_ppl.models import HumanModel
from mirror_ppl.models.dependencies import dependencies
from mirror_ppl.models.family import Preferring
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import scalar_sites
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.toy import ToyHuman, toy_posterior
from mirror_ppl.people import simulate

sys.path.insert(0, str(EXAMPLES))

WORLD_NAMES = ("driving", "search_rescue", "bomb_defusal", "highway")
RESIDUAL = {"residual_in", "residual_out"}
CHOICE = {"consistency", "lapse"}
TERMINALS = tuple(f"notices_terminal {number}" for number in range(1, 7))
RULES = {"rule_type_a", "rule_type_b"}
SEARCH = {"notice_mean", "notice_concentration"}
FOUND = {f"found_{stage}": set(TERMINALS) for stage in range(3)}
"""What each latent of rounds depends on."""
PARENTS = {
    ("bomb_defusal", "mirror"): (dict.fromkeys(TERMINALS, SEARCH), FOUND),
    ("bomb_defusal", "perceptual-only"): (dict.fromkeys(TERMINALS, SEARCH), FOUND),
    **{
        ("bomb_defusal", name): (dict.fromkeys(TERMINALS, SEARCH), FOUND)
        for name in ("late", "preferring", "hard-of-hearing", "all")
    },
}
"""What sites of the prior and latents of rounds depend on; all others on nothing."""
ACTIONS = {
    "mirror": CHOICE | RESIDUAL,
    "one-radius": CHOICE | RESIDUAL,
    "per-item": CHOICE | RESIDUAL,
    "perceptual-only": CHOICE,
    "policy-only": CHOICE | RESIDUAL,
    "no-implants": CHOICE,
    "late": CHOICE | RESIDUAL | {"late"},
    "noticing": CHOICE | RESIDUAL | {"notices"},
    "forgetting": CHOICE | RESIDUAL | {"forgets"},
    "preferring": CHOICE | RESIDUAL,
    "hard-of-hearing": CHOICE | RESIDUAL,
    "all": CHOICE | RESIDUAL | {"late", "notices", "forgets", "kind"},
}
KNOWING = ("mirror", "policy-only", "late", "preferring", "hard-of-hearing", "all")
TIED = {"sight_ahead_aside": {"sight_ahead"}, "sight_behind": {"sight_behind_aside"}}
"""On the highway, in models with a reach in each direction."""
BELIEVED = {("bomb_defusal", name): RULES for name in KNOWING}


@pytest.fixture(scope="module")
def robots():
    torch.manual_seed(0)
    return {name: SelfModel(get_domain(name)) for name in WORLD_NAMES}


@pytest.mark.parametrize(("world", "name"), SHIPPED)
def test_shipped_models_depend_on_what_is_written_in_them(world, name, robots):
    human = load_human_model(name, robots[world])
    prior, latents = PARENTS.get((world, name), ({}, {}))
    if name == "per-item" and not latents:
        items = next(m.items for m in human.domain.modalities if m.name == "visual")
        latents = {f"noticed_{item}": {f"notices_{item}"} for item in items}
    found = dependencies(human)
    tied = TIED if world == "highway" and "sight_ahead_aside" in found.prior else {}
    assert with_parents(found.prior) == prior | tied
    assert with_parents(found.round_latents) == latents
    preferred = {"shares_goal", *human.preferences} if isinstance(human, Preferring) else set()
    expected = ACTIONS[name] | BELIEVED.get((world, name), set()) | preferred
    if world == "bomb_defusal":
        expected -= {"notices", "forgets"}
    assert found.actions == expected
    assert bool(found.round_latents) == human.has_round_latents
    # What follows for engines.
    read = perceived_sites(human)
    assert not found.actions & set(read)
    assert fixed_prior(human, grid_of(read)) is not None
    require_own_attention(human, read)
    assert set(dependent_sites(human, scalar_sites(human))) == set(prior)
    assert not set(Pooling(human).sites) & set(prior)


def with_parents(found):
    return {site: set(parents) for site, parents in found.items() if parents}


@pytest.mark.parametrize(
    ("file", "kind", "latents", "actions"),
    [
        ("late_reactions", "LatePerson", {}, CHOICE | RESIDUAL | {"late"}),
        ("distracted", "DistractedPerson", {"away": {"distracted"}}, CHOICE | RESIDUAL),
    ],
)
def test_so_do_the_examples(file, kind, latents, actions, robots):
    human = getattr(import_module(file), kind)(robots["driving"])
    found = dependencies(human)
    assert not with_parents(found.prior)
    assert with_parents(found.round_latents) == latents
    assert found.actions == actions


class Everything(ToyHuman):
    """Every way for a site to depend on another."""

    def prior(self):
        own = super().prior()
        rate, reach = own["in_sight"], own["reach"]
        doubled = pyro.deterministic("doubled", 2 * rate)
        with pyro.poutine.scale(scale=1 + reach):
            pyro.sample("scaled", dist.Normal(0.0, 1.0))
        with pyro.poutine.mask(mask=reach > 1):  # pyright: ignore[reportArgumentType]
            pyro.sample("masked", dist.Normal(0.0, 1.0))
        pyro.sample("child", dist.Normal(doubled, 1.0))
        pyro.sample("indexed", dist.Normal(torch.arange(9.0)[reach], 1.0))
        pyro.sample("compared", dist.Normal((rate > 0.5).float(), 1.0))
        pyro.sample("observed", dist.Normal(rate, 1.0), obs=reach.float())
        pyro.sample("multiplied", dist.Normal(0 * rate, 1.0))
        shape = dist.Normal(rate.new_full((1, 1), 0.5) + torch.zeros_like(rate), 1.0)
        pyro.sample("shaped", shape)
        pyro.sample("cast", dist.Normal(torch.zeros(1).double().to(rate).expand_as(rate), 1.0))
        pyro.factor("factor", own["otherwise"] * reach)
        return own

    def act(self, implants, belief, values):
        pyro.factor("seen", (implants["reach"] > 3) + 0 * belief[..., 0])
        return super().act(implants, belief, values)


def test_values_are_followed_wherever_they_go_and_shapes_are_not(robots):
    """Also into factors, scales and masks; zero times a value counts, for safety."""
    found = dependencies(Everything(robots["driving"]))
    assert with_parents(found.prior) == {
        "scaled": {"reach"},
        "masked": {"reach"},
        "child": {"in_sight"},
        "indexed": {"reach"},
        "compared": {"in_sight"},
        "observed": {"in_sight", "reach"},
        "multiplied": {"in_sight"},
        "factor": {"otherwise", "reach"},
    }
    assert found.actions == {"in_sight", "otherwise", "reach"}


def test_the_global_random_state_is_left_alone(robots):
    human, state = HumanModel(robots["driving"]), torch.random.get_rng_state()
    assert dependencies(human) is dependencies(human)
    assert torch.equal(torch.random.get_rng_state(), state)


class FactorOfSight(ToyHuman):
    """A factor of every action depends on reach beyond what is believed."""

    def act(self, implants, belief, values):
        pyro.factor("far", (implants["reach"] > 1) + 0 * belief[..., 0])
        return super().act(implants, belief, values)


class TimesZero(ToyHuman):
    """Reach is as before, but its prior is computed from a rate."""

    def prior(self):
        like = next(self.self_model.parameters())
        rate = pyro.sample("in_sight", dist.Beta(like.new_tensor(2.0), like.new_tensor(2.0)))
        other = pyro.sample("otherwise", dist.Beta(like.new_tensor(1.0), like.new_tensor(4.0)))
        even = like.new_zeros(len(self.domain.reach_bins)) + 0 * rate[..., None]
        reach = pyro.sample("reach", dist.Categorical(logits=even))
        return {"in_sight": rate, "otherwise": other, "reach": reach}


def test_what_engines_cannot_compile_is_refused():
    rounds = simulate("driving", "fog", "paper", 1, 1, 0)
    with pytest.raises(HumanModelError, match="only the engines svi and nuts"):
        infer(FactorOfSight(self_model()), rounds, InferenceOptions("importance"), 0)


def test_a_dependence_that_is_none_costs_time_and_changes_nothing():
    """Every combination stands for itself; the posterior is that of conjugacy."""
    robot, rounds = self_model(), simulate("driving", "fog", "paper", 1, 3, 0)
    human = TimesZero(robot)
    assert fixed_prior(human, grid_of(perceived_sites(human))) is None
    draws = infer(human, rounds, InferenceOptions("importance", 2000), 0).draws
    exact = toy_posterior(ToyHuman(robot), rounds)
    for site in ("in_sight", "otherwise"):
        error = 4.5 * float(exact.variance(site) / 400) ** 0.5
        assert float(draws[site].mean()) == pytest.approx(float(exact.mean(site)), abs=error)
