"""What is written in Pyro is what every engine computes."""

import math
import sys

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_person import self_model
from paths import EXAMPLES
from pyro import poutine
from pyro.infer import Predictive, TraceEnum_ELBO, config_enumerate
from pyro.infer.inspect import get_dependencies

from mirror_ppl.errors import HumanModelError
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.likelihood.densities import log_correction
from mirror_ppl.likelihood.enumeration import combination_values, log_joints
from mirror_ppl.likelihood.tables import build_view_table
from mirror_ppl.models import HumanModel
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.toy import ToyHuman, toy_posterior
from mirror_ppl.models.variants import VARIANTS
from mirror_ppl.people import simulate

sys.path.insert(0, str(EXAMPLES))
from distracted import DistractedPerson  # noqa: E402
from late_reactions import LatePerson  # noqa: E402

# --- additions that Pyro counts ---------------------------------------------------------------


class FactorInPrior(HumanModel):
    def prior(self):
        implants = super().prior()
        pyro.factor("seldom", -50 * implants["lapse"])
        return implants


class FactorOfSight(HumanModel):
    def prior(self):
        implants = super().prior()
        pyro.factor("near", -implants["sight_front_own"] * 0.7 + implants["assumes_clear"])
        return implants


class Questionnaire(HumanModel):
    def prior(self):
        implants = super().prior()
        answer = dist.Normal(implants["consistency"], 0.5)
        pyro.sample("questionnaire", answer, obs=torch.tensor(1.0))
        return implants


class Chart(HumanModel):
    """An eye chart, whose letters people name as far as they see."""

    def prior(self):
        implants = super().prior()
        rate = 0.1 + 0.1 * implants["sight_front_own"]
        pyro.sample("chart", dist.Binomial(10, rate), obs=torch.tensor(7.0))
        return implants


class ScaledPrior(HumanModel):
    def prior(self):
        with poutine.scale(scale=0.3):
            return super().prior()


class MaskedPrior(HumanModel):
    def prior(self):
        implants = super().prior()
        with poutine.mask(mask=False):
            pyro.factor("nothing", 100 * implants["lapse"])
        with poutine.mask(mask=implants["consistency"] > 2):
            pyro.factor("strict", -30 * implants["lapse"])
        return implants


class ObservedInAct(HumanModel):
    """Somebody who says at each step how well they like it."""

    def act(self, implants, belief, values):
        spread = values.max(-1).values - values.min(-1).values
        with poutine.scale(scale=0.5):
            pyro.sample("mood", dist.Normal(spread, 2.0), obs=torch.tensor(0.3))
        pyro.factor("calm", -0.1 * implants["consistency"])
        return super().act(implants, belief, values)


class InRounds(DistractedPerson):
    """Somebody who says after each round whether they were distracted."""

    def round_latents(self, implants):
        with poutine.scale(scale=0.8):
            latents = super().round_latents(implants)
        sure = 0.2 + 0.6 * latents["away"]
        pyro.sample("said", dist.Bernoulli(sure), obs=torch.tensor(1.0))
        pyro.factor("sleepy", 0.5 * implants["distracted"])
        return latents


ENUMERATED = [HumanModel, VARIANTS["one-radius"], LatePerson, DistractedPerson, Chart]
"""Programs that Pyro itself enumerates here."""
STEPS, OBSERVED = 6, ("ego", "visual", "verbal")
PROGRAMS = [
    *(VARIANTS[name] for name in ("perceptual-only", "policy-only", "no-implants")),
    *(FactorInPrior, FactorOfSight, Questionnaire, ScaledPrior, MaskedPrior, ObservedInAct),
    *(*ENUMERATED, InRounds),
]


@pytest.fixture(scope="module")
def recordings():
    """One person's rounds of different lengths, the last of them padding."""
    made = simulate("driving", "fog", "paper", 1, 3, 100, told=0.1)
    variables = {
        name: value[:, :, : STEPS + (name in OBSERVED)] if value.dim() > 2 else value
        for name, value in made.variables().items()
    }
    changed = {"length": torch.tensor([[4, STEPS, 0]]), "round_count": torch.tensor([2])}
    return type(made).from_variables("driving", "fog", made.people, variables | changed)


@pytest.mark.parametrize("kind", PROGRAMS)
@torch.no_grad()
def test_the_compiled_density_is_that_of_the_program(kind, recordings):
    """With discrete sites summed out, given all others."""
    human = kind(self_model())
    table = build_view_table(human, recordings)
    policy = {
        name: value for name, value in draw_prior(human, 1, 2, 0).items() if name not in table.sites
    }
    grid = combination_values(human, table)
    compiled = log_joints(human, table, policy)[:, 0].logsumexp(-1)
    compiled = compiled + log_correction(human, grid, policy, 1)[:, 0]
    for draw, found in enumerate(compiled):
        own = {name: value[draw] for name, value in policy.items()}
        expected = [summed_out(human, recordings, own, grid)]
        if kind in ENUMERATED and draw == 0:
            expected.append(enumerated(human, recordings, own))
        for one in expected:
            torch.testing.assert_close(found, one, rtol=0, atol=1e-4)


def log_prior(human, policy):
    """Of these values, as they are drawn."""
    with pyro.plate("person", 1, dim=-2):
        trace = poutine.trace(poutine.condition(human.prior, data=policy)).get_trace()
    return sum(trace.nodes[name]["fn"].log_prob(value).sum() for name, value in policy.items())


def summed_out(human, recordings, policy, grid):
    """Log-density of all else, by going through all values of discrete sites."""
    given = {name: value.view(1, -1, 1, 1) for name, value in grid.items()}
    if human.has_round_latents:
        given["away"] = torch.tensor([0.0, 1.0]).view(2, 1, 1, 1)
    program = poutine.condition(human.model, data={**policy, **given})
    trace = poutine.trace(program).get_trace(recordings)
    trace.compute_log_prob()
    of_person, of_rounds = torch.zeros(1, 1, 1, 1), torch.zeros(1, 1, 1, 1)
    for node in trace.nodes.values():
        plates = {plate.name for plate in node.get("cond_indep_stack", ())}
        if node["type"] == "sample" and "round" in plates:
            of_rounds = of_rounds + node["log_prob"]
        elif node["type"] == "sample" and "person" in plates:
            of_person = of_person + node["log_prob"]
    # A round of padding has latents, which come to 1, and nothing else.
    of_rounds = of_rounds.expand(*of_rounds.shape[:-1], 3)[..., :2]
    total = of_person[..., 0] + of_rounds.logsumexp(0, keepdim=True).sum(-1)
    return total.flatten().logsumexp(0) - log_prior(human, policy)


def enumerated(human, recordings, policy):
    """The same by Pyro's enumeration."""
    program = config_enumerate(poutine.condition(human.model, data=policy), "parallel")
    elbo = TraceEnum_ELBO(max_plate_nesting=2, strict_enumeration_warning=False)
    together = -elbo.loss(program, lambda rounds: None, recordings)
    return torch.as_tensor(together) - log_prior(human, policy)


def test_a_table_that_forgets_a_factor_is_noticed(recordings, monkeypatch):
    from mirror_ppl.likelihood import densities

    original = densities.log_prob
    monkeypatch.setattr(
        densities,
        "log_prob",
        lambda node: original(node) * (node["name"] != "calm"),
    )
    with pytest.raises(AssertionError):
        test_the_compiled_density_is_that_of_the_program(ObservedInAct, recordings)


# --- engines ----------------------------------------------------------------------------------


def toy(change):
    """A toy person whose density of the first rate is changed."""

    class Changed(ToyHuman):
        def prior(self):
            if change == "scale":
                with poutine.scale(scale=4.0):
                    return super().prior()
            implants = super().prior()
            if change == "factor":
                pyro.factor("more", 20 * torch.log(implants["in_sight"]))
            if change == "observed":
                answer = dist.Normal(implants["in_sight"], 0.05)
                pyro.sample("answer", answer, obs=torch.tensor(0.7))
            return implants

        def act(self, implants, belief, values):
            if change == "act":
                pyro.factor("each", torch.log(implants["in_sight"]))
            return super().act(implants, belief, values)

    return Changed(self_model())


def log_change(change, rate, steps):
    """What that is as a function of the rate."""
    return {
        "none": 0 * rate,
        "scale": 3 * dist.Beta(2.0, 2.0).log_prob(rate),
        "factor": 20 * rate.log(),
        "observed": dist.Normal(rate, 0.05).log_prob(torch.tensor(0.7)),
        "act": steps * rate.log(),
    }[change]


def exact_mean(change, recordings):
    """Posterior mean of the first rate, on a fine grid."""
    human, steps = toy("none"), int(recordings.mask.sum())
    posterior = toy_posterior(human, recordings)
    # Given the bin, rates are independent; only the first is changed, and scaling the second
    # changes the bins.
    grid = (torch.arange(4000) + 0.5).double() / 4000
    first, second = posterior.rates["in_sight"][0], posterior.rates["otherwise"][0]
    of_first = dist.Beta(first[:, :1], first[:, 1:]).log_prob(grid)
    of_first = of_first + log_change(change, grid, steps)
    total = of_first.logsumexp(-1) - math.log(len(grid))
    if change == "scale":
        of_second = dist.Beta(second[:, :1], second[:, 1:]).log_prob(grid)
        of_second = of_second + 3 * dist.Beta(1.0, 4.0).log_prob(grid)
        total = total + of_second.logsumexp(-1) - math.log(len(grid))
    bins = torch.softmax(posterior.reach[0].log() + total, -1)
    return float(bins @ (of_first.softmax(-1) @ grid))


@pytest.mark.parametrize("change", ["none", "scale", "factor", "observed", "act"])
@pytest.mark.parametrize("guide", ["importance", "svi"])
def test_engines_have_the_posterior_of_the_program(guide, change, recordings):
    """Importance within four standard errors; the Gaussian of svi within a fifth of the change."""
    options = InferenceOptions(engine=guide, draws=2000 if guide == "importance" else 400)
    found = infer(toy(change), recordings, options, 0).draws["in_sight"].flatten()
    expected = exact_mean(change, recordings)
    if guide == "importance":
        # There are 400 effective draws at least, which systematic resampling keeps.
        assert abs(found.mean() - expected) < 4 * found.std() / math.sqrt(400)
    else:
        assert abs(found.mean() - expected) < 0.03


# --- Pyro's own tools -------------------------------------------------------------------------


def test_predictive_runs_the_program(recordings):
    human = HumanModel(self_model())
    found = Predictive(human.model, num_samples=3)(recordings)
    assert found["sight_front_own"].shape == (3, 1, 1)
    free = Predictive(poutine.uncondition(human.model), num_samples=40)(recordings)
    actions = torch.stack([free[f"action_{step}"] for step in range(STEPS)], -1)
    assert actions.shape == (40, 1, 3, STEPS) and len(actions.unique()) == 2


def test_messages_can_be_replaced(recordings):
    """What is said at a step changes what is believed from there on."""
    human = HumanModel(self_model())
    said = {
        f"message_{name}_2": torch.ones_like(mask[..., 2, :])
        for name, mask in recordings.told.items()
    }
    beliefs = []
    for program in (human.model, poutine.do(human.model, data=said)):
        pyro.set_rng_seed(0)
        trace = poutine.trace(program).get_trace(recordings)
        beliefs.append([trace.nodes[f"belief_{step}"]["value"] for step in range(STEPS)])
    same = [torch.equal(*both) for both in zip(*beliefs, strict=True)]
    assert all(same[:2]) and not same[2]


def test_the_world_does_not_depend_on_implants(recordings):
    human = HumanModel(self_model())
    found = get_dependencies(human.model, (recordings,), {"world": True})["prior_dependencies"]
    implants = set(draw_prior(human, 1, 1, 0))
    world = {name for name in found if name.startswith(("state_", "observation_", "reward_"))}
    assert len(world) == STEPS + 3 * (STEPS - 1) + STEPS
    for name in world:
        assert not implants & set(found[name]), name


def test_the_program_runs_without_a_simulator(recordings):
    human = HumanModel(self_model())
    program = poutine.uncondition(human.model)
    pyro.set_rng_seed(0)
    with torch.no_grad():
        trace = poutine.trace(program).get_trace(recordings, world=True)
    # At first there is what was recorded; after that what the self-model says.
    assert trace.nodes["observation_verbal_5"]["value"].isfinite().all()
    assert "observation_verbal_0" not in trace.nodes


def test_recorded_worlds_are_seen_as_they_were(recordings):
    human = HumanModel(self_model())
    beliefs = []
    for world in (False, True):
        pyro.set_rng_seed(0)
        data = {name: value[0] for name, value in draw_prior(human, 1, 1, 0).items()}
        program = poutine.condition(human.model, data=data)
        trace = poutine.trace(program).get_trace(recordings, world=world)
        beliefs.append(trace.nodes["belief_5"]["value"][:, :2])
    torch.testing.assert_close(*beliefs)


# --- what cannot be compiled ------------------------------------------------------------------


class OfOthers(HumanModel):
    def prior(self):
        implants = super().prior()
        answer = dist.Normal(implants["consistency"], 0.5)
        pyro.sample("questionnaire", answer, obs=torch.ones(4, 1))
        return implants


class NotANumber(HumanModel):
    def act(self, implants, belief, values):
        return super().act(implants, belief, values) * torch.nan


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (NotANumber, "NotANumber.act returns nan"),
        (OfOthers, '"questionnaire" has a log density of shape'),
    ],
)
@pytest.mark.parametrize("guide", ["importance", "svi"])
def test_what_cannot_be_compiled_is_refused(kind, message, guide, recordings):
    options = InferenceOptions(engine=guide, draws=10)
    with pytest.raises(HumanModelError, match=message):
        infer(kind(self_model()), recordings, options, 0)
