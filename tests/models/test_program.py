"""The human model is one Pyro program: actions, observations and rewards in one trace."""

import pytest
import torch
from pyro import poutine
from torch.distributions import Normal

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.models import HumanModel
from mirror_ppl.models.weights import load_self_model, shipped_weights

PEOPLE, ROUNDS, STEPS = 2, 2, 15
IMPLANTS = ("sight_front_own", "assumes_clear", "consistency", "lapse", "residual_in")


@pytest.fixture(scope="module")
def human():
    return HumanModel(load_self_model(shipped_weights("driving"))[0])


@pytest.fixture(scope="module")
def recordings():
    demonstrations = load_demonstrations(asset_path("driving_fog_paper.nc"))
    return demonstrations.select_people([0, 1]).select_rounds([0, 1])


def trace_of(human, recordings, **data):
    """A run of the program, with the world, given these values."""
    program = poutine.condition(human.model, data=data)
    trace = poutine.trace(program).get_trace(recordings, world=True)
    trace.compute_log_prob()
    return trace


def of_the_world(trace):
    """The log density of the world's sites, each ``[P, B]``, by name."""
    return {
        name: node["log_prob"]
        for name, node in trace.nodes.items()
        if name.split("_")[0] in ("state", "observation", "reward")
    }


@pytest.fixture(scope="module")
def states(human):
    """States of the robot at each step, ``[P, B, T, Z]``."""
    generator = torch.Generator().manual_seed(3)
    return torch.randn(PEOPLE, ROUNDS, STEPS, human.self_model.latent, generator=generator)


def test_one_trace_holds_implants_actions_states_observations_and_rewards(human, recordings):
    trace = trace_of(human, recordings)
    sampled = {name for name, site in trace.nodes.items() if site["type"] == "sample"}
    assert {*IMPLANTS} <= sampled
    for step in range(STEPS):
        assert {f"action_{step}", f"state_{step}", f"reward_{step}"} <= sampled
        assert trace.nodes[f"action_{step}"]["is_observed"]
        assert trace.nodes[f"reward_{step}"]["is_observed"]
        assert not trace.nodes[f"state_{step}"]["is_observed"]
        for name in ("ego", "visual", "verbal"):
            # Rounds begin with what there is to observe at first.
            assert (f"observation_{name}_{step}" in sampled) == (step > 0)


def test_the_world_is_the_same_whoever_acts(human, recordings, states):
    """Given the actions, it does not depend on implants: that is why fitting them leaves it out."""
    data = {f"state_{step}": states[:, :, step] for step in range(STEPS)}
    with torch.no_grad():
        one, other = (trace_of(human, recordings, **data) for _ in range(2))
        assert not torch.equal(one.nodes["lapse"]["value"], other.nodes["lapse"]["value"])
        first, second = of_the_world(one), of_the_world(other)
        assert first.keys() == second.keys() and len(first) == 2 * STEPS + 3 * (STEPS - 1)
        for name, value in first.items():
            torch.testing.assert_close(value, second[name])
        # And implants and actions are the same with the world and without.
        given = data | {
            name: node["value"]
            for name, node in one.nodes.items()
            if node["type"] == "sample" and not node["is_observed"] and name not in data
        }
        program = poutine.condition(human.model, data=given)
        alone = poutine.trace(program).get_trace(recordings)
        total = alone.log_prob_sum() + sum(value.sum() for value in first.values())
        torch.testing.assert_close(one.log_prob_sum(), total)


def test_the_world_has_the_robot_s_own_densities(human, recordings, states):
    model, steps = human.self_model, slice(0, STEPS)
    data = {f"state_{step}": states[:, :, step] for step in range(STEPS)}
    with torch.no_grad():
        found = of_the_world(trace_of(human, recordings, **data))
        observation = {name: value[:, :, steps] for name, value in recordings.observation().items()}
        everything = {
            name: torch.ones(value.shape[:-1], dtype=torch.bool)
            for name, value in observation.items()
            if name != "ego"
        }
        actions = recordings.actions
        evidence = model.evidence(observation, everything, actions[..., :-1])
        first = model.encoder(torch.zeros_like(states[:, :, 0]), evidence[:, :, 0])
        later = model.transition(states[:, :, :-1], actions[..., :-1])
        reward = Normal(*model.reward(states, actions)).log_prob(recordings.rewards)
        expected = {"state_0": Normal(*first).log_prob(states[:, :, 0]).sum(-1)}
        moves = Normal(*later).log_prob(states[:, :, 1:]).sum(-1)
        for step in range(STEPS):
            expected[f"reward_{step}"] = reward[..., step]
            if step:
                expected[f"state_{step}"] = moves[..., step - 1]
        for name, target in model.targets(observation).items():
            density = Normal(*model.decoders[name](states)).log_prob(target).flatten(3).sum(-1)
            for step in range(1, STEPS):
                expected[f"observation_{name}_{step}"] = density[..., step]
    assert found.keys() == expected.keys()
    for name, value in found.items():
        torch.testing.assert_close(value, expected[name], rtol=1e-4, atol=1e-4)


def test_run_forward_without_data_it_is_a_prior(human, recordings):
    """Only the actions are observed; every implant is drawn for every person."""
    trace = poutine.trace(human.model).get_trace(recordings)
    observed = {
        name
        for name, site in trace.nodes.items()
        if site["type"] == "sample" and site["is_observed"] and not name.startswith("action_")
    }
    assert all(name.split("_")[0] in ("message", "belief") for name in observed)
    for site in ("sight_front_own", "consistency", "lapse"):
        assert trace.nodes[site]["value"].shape == (PEOPLE, 1)
