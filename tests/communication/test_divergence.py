"""What beliefs differ by, and what the person's next action is worth: both by hand."""

import pytest
import torch
from example_course import beliefs_of, perceived
from example_person import (
    CHANNELS,
    Averaging,
    human,
    implants,
    person,
    random_round,
    self_model,
    varied_draws,
)
from example_plans import ACTIONS, candidates_of, robot
from torch.distributions import Independent, Normal, kl_divergence

from mirror_ppl.communication import (
    Channels,
    Divergence,
    ExpectedUtility,
    Person,
    PlanningContext,
    RoundSoFar,
)
from mirror_ppl.communication.objectives import ExpectedValue
from mirror_ppl.communication.planners import PlannerOptions, planner_of
from mirror_ppl.errors import HumanModelError, UnknownNameError
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.weights import load_self_model, shipped_weights


def told_belief(draw, past, told):
    """``q(zH_t | told)`` of one draw: the belief before, and a step from it."""
    eyes = {name: value[0] for name, value in draw.items() if not value.is_floating_point()}
    now = past.then(CHANNELS.split(told), 0, past.now)
    observation = {name: value[None, :-1] for name, value in now.observation.items()}
    view = perceived(human(), eyes, observation, {n: mask[None] for n, mask in now.told.items()})
    evidence = human().evidence(view, observation)[0, -1]
    before, last = torch.zeros(self_model().latent), torch.tensor(ACTIONS)
    if past.time:
        before = beliefs_of(human(), view, observation, now.actions[None])[0, -2]
        last = past.actions[-1]
    return human().believe(before, evidence, last)


@torch.no_grad()
@pytest.mark.parametrize("time", [0, 1, 4])
@pytest.mark.parametrize(("measure", "weight"), [("kl", 1.0), ("kl", 2.5), ("squared", 0.5)])
def test_divergence_is_that_of_two_gaussians(generator, time, measure, weight):
    past, _ = random_round(time, generator)
    someone = Person(human(), varied_draws(4, generator))
    candidates = candidates_of(past, generator, 2)
    valued = Divergence(weight, measure).at(PlanningContext.of(someone, past), 5, 0)(candidates)
    assert valued.actions is None
    mine = robot(past)
    for c, candidate in enumerate(candidates):
        for s in range(4):
            draw = {name: value[s] for name, value in someone.draws.items()}
            theirs = told_belief(draw, past, candidate[0])
            if measure == "kl":
                apart = kl_divergence(*(Independent(Normal(*q), 1) for q in (mine, theirs)))
            else:
                apart = (mine.mean - theirs.mean).pow(2).sum()
            expected = -weight * apart - CHANNELS.cost(candidate[0])
            torch.testing.assert_close(valued.utility[c, s], expected, rtol=1e-4, atol=1e-4)
    # Where all is still to tell, more than costs is at stake.
    apart = valued.utility + CHANNELS.cost(candidates[:, 0])[:, None]
    assert time > 0 or apart.std(0).max() > 0.1


@torch.no_grad()
@pytest.mark.parametrize("time", [0, 3])
def test_expected_values_are_those_of_the_next_action(generator, time):
    """Utility is the robot's values weighted by each draw's probabilities of actions."""
    past, _ = random_round(time, generator)
    someone = Person(human(), varied_draws(4, generator))
    candidates = candidates_of(past, generator, 2)
    valued = ExpectedValue().at(PlanningContext.of(someone, past), 5, 0)(candidates)
    values = self_model().action_values(robot(past).mean)
    assert valued.actions is not None and valued.actions.shape == (len(candidates), 1, ACTIONS)
    for c, candidate in enumerate(candidates):
        found = []
        for s in range(4):
            draw = {name: value[s, None] for name, value in someone.draws.items()}
            belief = told_belief({n: v[0] for n, v in draw.items()}, past, candidate[0]).mean
            own = human().action_values(belief)
            found.append(Person(human(), draw).act(belief[None, None], own[None, None]).exp())
            expected = (found[-1][0, 0] * values).sum() - CHANNELS.cost(candidate[0])
            torch.testing.assert_close(valued.utility[c, s], expected, rtol=1e-4, atol=1e-4)
        mean = torch.cat(found).mean(0)
        torch.testing.assert_close(valued.actions[c], mean, rtol=1e-4, atol=1e-5)


def test_what_mirror_predicts_with_is_chosen_by_name():
    kinds = {
        name: type(planner_of("mirror", person(), PlannerOptions(predict_with=name), 0).objective)
        for name in ("simulator", "self-model", "values")
    }
    assert list(kinds.values()) == [ExpectedUtility, ExpectedUtility, ExpectedValue]
    with pytest.raises(UnknownNameError, match="self-model, simulator, values"):
        PlannerOptions(predict_with="luck")


def test_models_without_a_density_are_refused(generator):
    past, _ = random_round(1, generator)
    model = Averaging(self_model())
    with pytest.raises(HumanModelError) as error:
        Divergence().at(PlanningContext.of(Person(model, implants(2, model)), past), 5, 0)
    assert str(error.value) == (
        "beliefs of Averaging have no density like the robot's, which mirror-kl compares: its "
        "believe returns no Gaussian, or one of another size"
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"measure": "js"}, 'measure must be kl or squared, not "js"'),
        ({"weight": 0.0}, "weight must be positive, not 0.0"),
        ({"weight": -1.0}, "weight must be positive, not -1.0"),
        ({"weight": float("nan")}, "weight must be positive, not nan"),
    ],
)
def test_impossible_measures_are_refused(options, message):
    with pytest.raises(ValueError) as error:
        Divergence(**options)
    assert str(error.value) == message


@torch.no_grad()
def test_beliefs_of_an_unchanged_bomb_do_not_drift_apart():
    """Who was shown and heard everything believes what the robot believes, however long ago."""
    model, _ = load_self_model(shipped_weights("bomb_defusal"))
    bomb = load_human_model(None, model)
    channels, world = Channels(model.domain), model.domain
    someone = Person(bomb, draw_prior(bomb, 1, 4, 0))
    state = world.initial(1, torch.Generator().manual_seed(0))
    past = RoundSoFar.begin(world, {n: value[0] for n, value in world.observe(state).items()})
    everything = channels.join(world.communicable(past.now))
    for step in range(4):
        silence = torch.zeros(1, 1, len(channels), dtype=torch.bool)
        value = Divergence().at(PlanningContext.of(someone, past), 5, 0)
        apart = value(silence).utility
        assert (apart < -1).any() if step == 0 else (apart.abs() < 1e-3).all()
        sent = everything if step == 0 else torch.zeros_like(everything)
        press = 0 if step < 3 else 1  # a new stage begins after the fourth step
        state = world.transition(state, torch.tensor([press]))
        now = {n: value[0] for n, value in world.observe(state).items()}
        past = past.then(channels.split(sent), press, now)
    apart = Divergence().at(PlanningContext.of(someone, past), 5, 0)(silence).utility
    assert (apart < -1).any()
