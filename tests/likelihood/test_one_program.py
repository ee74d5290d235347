"""What is written in Pyro is what every engine computes."""

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_person import self_model
from pyro import poutine
from pyro.infer import Predictive
from pyro.infer.inspect import get_dependencies

from benchmarks.one_program import CHANGES, exact_mean, toy
from mirror_ppl.domains.driving import Driving
from mirror_ppl.errors import HumanModelError, InputError
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.svi import SVIOptions
from mirror_ppl.likelihood.compiled import compile
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.models import HumanModel
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.variants import VARIANTS
from mirror_ppl.people import simulate

PerItem = VARIANTS["per-item"]
STEPS, OBSERVED = 6, ("ego", "visual", "verbal")


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


# --- engines ----------------------------------------------------------------------------------


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("guide", ["importance", "svi"])
def test_engines_have_the_posterior_of_the_program(guide, change, recordings):
    """Importance within four standard errors; the Gaussian of svi within a fifth of the change."""
    options = InferenceOptions(engine=guide, draws=2000)
    if guide == "svi":
        options = InferenceOptions(guide, 100, SVIOptions(steps=150))
    found = infer(toy(change, self_model()), recordings, options, 0).draws["in_sight"].flatten()
    expected = exact_mean(change, recordings, self_model())
    if guide == "importance":
        # There are 400 effective draws at least, which systematic resampling keeps.
        assert abs(found.mean() - expected) < 4 * found.std() / math.sqrt(400)
    else:
        assert abs(found.mean() - expected) < 0.03


class Half(HumanModel):
    """Each recorded action counts half in the density."""

    likelihood_power = 0.5


@torch.no_grad()
def test_a_power_of_the_likelihood_counts_in_the_density_alone(recordings):
    whole, half = HumanModel(self_model()), Half(self_model())
    draws = draw_prior(whole, 1, 3, 0)
    tables, of_half = compile(whole, recordings), compile(half, recordings)
    predicted = tables.predict(draws)
    assert torch.equal(of_half.predict(draws), predicted)
    real, actions = recordings.mask, recordings.actions.clamp(min=0)
    chosen = predicted.gather(-1, actions.expand(3, *actions.shape)[..., None])[..., 0]
    likelihood = (chosen * real).sum((-2, -1))
    joint, of_half = tables.log_joint(draws), of_half.log_joint(draws)
    torch.testing.assert_close(of_half, joint - likelihood / 2, rtol=0, atol=1e-4)
    one = {name: value[1] for name, value in draws.items()}
    trace = poutine.trace(poutine.condition(half.model, data=one)).get_trace(recordings)
    torch.testing.assert_close(trace.log_prob_sum(), of_half[1, 0], rtol=0, atol=1e-4)


class StepByStep(PerItem):
    """A model that is run step by step, as it overrides the program."""

    spans = PerItem.spans

    def model(self, rounds, world=False):
        super().model(rounds, world)


class Searching(PerItem):
    """Attention of which weighted samples are used."""

    spans = HumanModel.spans


@torch.no_grad()
@pytest.mark.parametrize("kind", [PerItem, Searching, StepByStep])
def test_what_earlier_actions_say_of_attention_has_no_power(kind, monkeypatch, recordings):
    """Predictions are those of the program, however often a decision counts in posteriors."""
    monkeypatch.setattr(Driving, "horizon", STEPS)
    short = recordings.select_rounds([0])
    draws = draw_prior(PerItem(self_model()), 1, 2, 0)
    human = kind(self_model())
    human.likelihood_power = 1.0
    torch.manual_seed(0)
    expected = compile(human, short).predict(draws)
    human.likelihood_power = 0.5
    torch.manual_seed(0)
    torch.testing.assert_close(compile(human, short).predict(draws), expected)


@pytest.mark.parametrize("power", [0.0, -1.0, math.nan, 2.0, "half"])
def test_a_power_is_a_number_up_to_1(power):
    human = HumanModel(self_model())
    human.likelihood_power = power
    with pytest.raises(InputError, match=r"HumanModel\.likelihood_power must be"):
        check_contract(human)


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


def world_dependencies(model, recordings):
    """The implants on which the sites of the world depend, whatever lies between them."""
    found = get_dependencies(model, (recordings,), {"world": True})["prior_dependencies"]
    world = [name for name in found if name.startswith(("state_", "observation_", "reward_"))]
    assert len(world) == STEPS + 3 * (STEPS - 1) + STEPS
    reached, new = set(world), list(world)
    while new:
        before = set(found[new.pop()]) - reached
        reached |= before
        new += before
    return reached & set(draw_prior(HumanModel(self_model()), 1, 1, 0))


def test_the_world_does_not_depend_on_implants(recordings):
    """Given recordings; run forward it depends on all that decide what people do."""
    model = HumanModel(self_model()).model
    assert not world_dependencies(model, recordings)
    forward = world_dependencies(poutine.uncondition(model), recordings)
    assert {"sight_front_own", "consistency", "lapse", "residual_in"} <= forward


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
