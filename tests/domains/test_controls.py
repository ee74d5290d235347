"""Continuous actions: their grid, how noise executes them, and their way through recordings."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pyro
import pytest
import torch
from torch.special import ndtr

import mirror_ppl
from mirror_ppl.communication import (
    Communicator,
    Companion,
    ExpectedUtility,
    Person,
    SimulatorWorld,
)
from mirror_ppl.data import (
    Demonstrations,
    asset_path,
    load_demonstrations,
    save_demonstrations,
)
from mirror_ppl.data.contradictions import check_world
from mirror_ppl.data.demonstrations import concatenate
from mirror_ppl.domains import Control, Modality, World, add_domain, get_domain
from mirror_ppl.domains.controls import (
    action_at,
    action_names,
    execution,
    grid,
    nearest_action,
)
from mirror_ppl.errors import DemonstrationsError, DomainError, InputError
from mirror_ppl.inference.results.posterior_predictive import predict_rounds
from mirror_ppl.models import HumanModel, SelfModel
from mirror_ppl.models.family import Preferring
from mirror_ppl.models.implants import MOTOR_NOISE
from mirror_ppl.models.prior import draw_prior, scalar_sites
from mirror_ppl.models.variants import NoImplants, OneRadius, PerceptualOnly, PolicyOnly
from mirror_ppl.people import recorded
from mirror_ppl.people.robot_like import simulated_robot_like

BOTH = (Control("steering"), Control("speed", 0, 4, 5, "m/s"))


@dataclass(frozen=True)
class Where:
    place: torch.Tensor
    mark: torch.Tensor


class Slide(World):
    """A slider that has to reach a mark."""

    modalities = (Modality("visual", ("mark",), ("offset",), ("m",), (8.0,), 0.01),)
    ego_features = ("place",)
    controls = (Control("speed", -1, 1, 3, "m"),)
    horizon = 3
    positions = ("offset",)

    def initial(self, batch, generator, scenario=None):
        del scenario
        return Where(torch.zeros(batch), 4 * torch.rand(batch, generator=generator) - 2)

    def transition(self, state, action):
        return Where(state.place + self.control_values(action)[..., 0], state.mark)

    def rewards(self, state, action, following):
        return {"reward": -(following.place - state.mark).abs()}

    def observe(self, state):
        offset = (state.mark - state.place)[..., None, None]
        return {"ego": state.place[..., None], "visual": offset}

    def state_behind(self, observation):
        place = observation["ego"][..., 0]
        return Where(place, place + observation["visual"][..., 0, 0])


def test_actions_are_the_grid_of_controls():
    assert len(action_names(BOTH)) == len(grid(BOTH)) == 15
    assert action_names(BOTH)[:2] == ("steering -1 and speed 0 m/s", "steering -1 and speed 1 m/s")
    assert grid(BOTH)[7].tolist() == [0.0, 2.0]
    assert nearest_action(BOTH, grid(BOTH)).tolist() == list(range(15))
    assert Slide().actions == ("speed -1 m", "speed 0 m", "speed 1 m")


@pytest.mark.parametrize(
    ("values", "nearest"), [([-0.6, 3.4], 3), ([0.49, 0.5], 6), ([0.5, 4.0], 14)]
)
def test_what_is_executed_counts_as_the_nearest_action(values, nearest):
    assert int(nearest_action(BOTH, torch.tensor(values))) == nearest
    assert action_at(BOTH, np.array(values)) == nearest


def test_noise_executes_neighbours_with_probabilities_of_the_normal_distribution():
    noise = torch.tensor(0.4, dtype=torch.float64)
    one = execution(BOTH[:1], noise)
    half, more = ndtr(0.5 / noise), ndtr(1.5 / noise)
    wanted = [
        [half, more - half, 1 - more],
        [1 - half, 2 * half - 1, 1 - half],
        [1 - more, more - half, half],
    ]
    assert torch.allclose(one, torch.tensor(wanted, dtype=torch.float64), atol=1e-12)
    both = execution(BOTH, noise)
    product = torch.kron(one, execution(BOTH[1:], noise))
    assert torch.allclose(both, product, atol=1e-12)
    assert torch.allclose(both.sum(-1), torch.ones(15, dtype=torch.float64))


def test_noise_executes_as_often_as_in_simulation():
    number, noise = 100_000, 0.7
    generator = torch.Generator().manual_seed(0)
    intended = 7
    values = grid(BOTH)[intended] + noise * torch.randn(number, 2, generator=generator)
    low, high = torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 4.0])
    share = torch.bincount(nearest_action(BOTH, values.clamp(low, high)), minlength=15) / number
    wanted = execution(BOTH, torch.tensor(noise))[intended]
    # Five standard errors of a share, for each of 15.
    assert ((share - wanted).abs() <= 5 * (wanted * (1 - wanted) / number).sqrt() + 1e-6).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"levels": 1}, "expected 2 or more levels, found 1"),
        ({"low": 1.0, "high": 1.0}, "expected finite bounds"),
        ({"high": math.inf}, "expected finite bounds"),
        ({"low": -math.inf}, "expected finite bounds"),
    ],
)
def test_bad_controls_are_refused(settings, message):
    with pytest.raises(DomainError, match=message):
        Control("steering", **settings)


def test_a_world_has_actions_or_controls():
    with pytest.raises(DomainError, match="derived from controls"):
        type("Both", (Slide,), {"actions": ("left", "right")})()


@pytest.mark.parametrize("given", [0.5, [0.5], [0.0, 9.0], ["left", "fast"], None])
def test_what_nobody_can_execute_is_refused(given):
    with pytest.raises(InputError, match=r"shape \(2,\), steering -1 to 1, speed 0 to 4"):
        action_at(BOTH, given)


# --- people -----------------------------------------------------------------------------------


@pytest.fixture
def human():
    torch.manual_seed(0)
    return HumanModel(SelfModel(add_domain(Slide)))


def test_people_execute_what_they_intend_with_noise(human):
    with pyro.plate("person", 2, dim=-2):
        implants = human.prior()
    belief = torch.randn(2, 4, human.belief_size)
    values = human.action_values(belief)
    found = human.act(implants, belief, values).exp()
    intended = human.act({**implants, MOTOR_NOISE: torch.full((2, 1), 1e-3)}, belief, values).exp()
    for person in range(2):
        slips = execution(human.domain.controls, implants[MOTOR_NOISE][person, 0])
        assert torch.allclose(found[person], intended[person] @ slips, atol=1e-5)


@pytest.mark.parametrize("kind", [HumanModel, OneRadius, PerceptualOnly, NoImplants, PolicyOnly])
def test_only_people_with_controls_have_motor_noise(human, kind):
    assert MOTOR_NOISE in scalar_sites(kind(human.self_model))
    assert MOTOR_NOISE not in scalar_sites(kind(SelfModel(get_domain("driving"))))


# --- recordings -------------------------------------------------------------------------------


def recordings(controls, **changes):
    """Rounds of one person, who executes ``[B, T]``."""
    slide = add_domain(Slide)
    control = torch.as_tensor(controls, dtype=torch.float)[None, ..., None]
    generator = torch.Generator().manual_seed(0)
    states = [slide.initial(control.shape[1], generator)]
    for step in range(control.shape[2]):
        states.append(slide.transition(states[-1], control[0, :, step]))
    seen = [slide.observe(state) for state in states]
    variables = {name: torch.stack([one[name] for one in seen], 1)[None] for name in seen[0]}
    given = {**variables, "control": control, **changes}
    return Demonstrations.from_variables("slide", "everyday", ["ada"], given)


def test_controls_are_recorded_with_the_actions_nearest_to_them(tmp_path):
    found = recordings([[0.2, -0.9, 0.7], [-0.4, 0.6, 1.0]])
    assert found.actions.tolist() == [[[1, 0, 2], [1, 2, 2]]]
    again = load_demonstrations(save_demonstrations(tmp_path / "slide.nc", found))
    assert again.equals(found)
    twice = concatenate(
        [found, found.select_rounds([0]).part(range(1))._like(found.variables(), ["ben"])]
    )
    assert twice.controls.shape == (2, 2, 3, 1)


def test_what_follows_is_that_of_controls_not_of_the_nearest_actions():
    found = recordings([[0.2, -0.9, 0.7]])
    assert check_world(found, 0.0).share == 0
    without = {name: part for name, part in found.variables().items() if name != "control"}
    with pytest.raises(DemonstrationsError, match="contradict"):
        check_world(Demonstrations.from_variables("slide", "everyday", ["ada"], without), 0.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"control": torch.full((1, 1, 3, 1), 1.5)}, r"within its bounds \(speed -1 to 1\)"),
        ({"control": torch.zeros(1, 1, 3, 2)}, "steps and 1 controls"),
        ({"control": torch.full((1, 1, 3, 1), torch.nan), "length": [[3]]}, "whole number"),
        ({"action": [[[1, 1, 1]]]}, "the action nearest to the control"),
    ],
)
def test_bad_controls_of_recordings_are_refused(changes, message):
    with pytest.raises(DemonstrationsError, match=message):
        recordings([[0.2, -0.9, 0.7]], **changes)


def test_companions_are_told_what_was_executed(human):
    utility = ExpectedUtility(SimulatorWorld(human.domain), 2)
    companion = Companion(Communicator(Person(human, draw_prior(human, 1, 8, 0)), utility))
    with pytest.raises(InputError, match="no round has begun"):
        companion.observe({"ego": [0.8], "visual": [[0.7]]}, [0.8])
    first = {"ego": [0.0], "visual": [[1.5]]}
    companion.begin(first)
    companion.observe({"ego": [0.8], "visual": [[0.7]]}, [0.8])
    assert companion.past.actions.tolist() == [2]
    assert companion.decide().gain is not None
    with pytest.raises(InputError, match=r"shape \(1,\), speed -1 to 1"):
        companion.observe(first, [3.0])


@pytest.mark.parametrize("error", [0.0, 0.5])
def test_simulated_people_are_the_human_model(human, error, monkeypatch):
    """What they do has the probabilities that the program gives it, noise of controls included."""
    record = replace(human.domain.record, value_error=error)
    monkeypatch.setattr(human.domain, "record", record, raising=False)
    with torch.no_grad():  # values that differ by about the error
        human.self_model.q_network.value.weight *= 5
    people = simulated_robot_like(human.self_model, "everyday", "diverse", 3, 0)
    rounds = recorded(people, "everyday", "diverse", 4, 0)
    model, known = people.modelled()
    found = predict_rounds(model, rounds, known)[0]
    entropy = torch.special.entr(found.exp()).sum(-1)
    assert torch.allclose(entropy[rounds.mask], rounds.action_entropy[rounds.mask], atol=1e-4)
    assert torch.equal(rounds.truth[MOTOR_NOISE], people.motor_noise)
    precise = replace(people, motor_noise=torch.full((3,), 1e-3))
    other = recorded(precise, "everyday", "diverse", 4, 0)
    assert not torch.allclose(other.action_entropy, rounds.action_entropy)


def test_noise_of_controls_is_inferred(human):
    """Half of the people are precise; their intervals are below those of the others."""
    with torch.no_grad():  # values that differ between actions, as those of a trained network
        human.self_model.q_network.value.weight *= 100
    people = simulated_robot_like(human.self_model, "everyday", "diverse", 4, 0)
    noise = torch.tensor([0.1, 0.1, 1.0, 1.0])
    sure = replace(people, motor_noise=noise)
    rounds = recorded(sure, "everyday", "diverse", 40, 0)
    fit = mirror_ppl.infer(rounds, human=human, draws=100, explore=0)
    drawn = fit.posterior.draws[MOTOR_NOISE][..., 0]
    assert drawn[:, :2].quantile(0.95) < drawn[:, 2:].quantile(0.05)


def test_borders_are_the_same_for_recordings_and_recorders():
    """0.4 lies between two levels, where 32 and 64 bits may round differently."""
    controls = (Control("v", -1, 1, 6),)
    assert action_at(controls, [0.4]) == int(nearest_action(controls, torch.tensor([0.4])))
    full = (Control("v", -0.1, 0.1),)
    assert action_at(full, np.array([0.1], np.float32)) == 2


def test_controls_of_a_world_without_them_are_refused():
    driving = load_demonstrations(asset_path("driving_fog_paper.nc")).select_people([0])
    given = {**driving.variables(), "control": torch.zeros(*driving.shape, 1)}
    with pytest.raises(DemonstrationsError, match="actions of driving are numbered"):
        Demonstrations.from_variables("driving", "fog", driving.people, given)


@pytest.mark.parametrize(
    ("controls", "message"),
    [
        (Control("v"), "have to be a tuple"),
        ((Control("v", levels=12), Control("w", levels=11)), "more than 127 combinations"),
    ],
)
def test_bad_grids_are_refused(controls, message):
    with pytest.raises(DomainError, match=message):
        type("Bad", (Slide,), {"controls": controls})()


def test_preferences_are_of_what_is_intended(human):
    """Liking one action hardly makes an imprecise hand precise."""
    preferring = Preferring(human.self_model)
    with pyro.plate("person", 1, dim=-2):
        implants = preferring.prior()
    for site in preferring.preferences:
        implants[site] = torch.zeros(1, 1)
    implants |= {preferring.preferences[0]: torch.full((1, 1), 30.0)}
    implants |= {MOTOR_NOISE: torch.ones(1, 1)}
    belief = torch.randn(1, 3, human.belief_size)
    found = preferring.act(implants, belief, human.action_values(belief)).exp()
    slips = execution(human.domain.controls, torch.tensor(1.0))[1]
    assert torch.allclose(found, slips.expand_as(found), atol=1e-4)
