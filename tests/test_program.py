"""The human model is one Pyro program: actions, observations and rewards in one trace."""

import pyro
import pytest
import torch
from pyro import poutine
from pyro.infer import TraceEnum_ELBO, config_enumerate
from torch.testing import assert_close

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.inference.svi import PLATES, continuous_guide
from mirror_ppl.inference.views import Screening, build_view_table
from mirror_ppl.models import HumanModel, Rounds
from mirror_ppl.models.weights import load_self_model, shipped_weights


@pytest.fixture(scope="module")
def human():
    return HumanModel(load_self_model(shipped_weights("driving"))[0])


@pytest.fixture(scope="module")
def recordings():
    demonstrations = load_demonstrations(asset_path("driving_fog_paper.nc"))
    return demonstrations.select_people([0, 1]).select_rounds([0, 1])


@pytest.fixture(scope="module")
def table(human, recordings):
    return build_view_table(human, recordings, screening=Screening())


@pytest.fixture(scope="module")
def world(recordings):
    flat = {name: value.flatten(0, 1) for name, value in recordings.observation().items()}
    visible = {
        name: torch.ones(value.shape[:-1], dtype=torch.bool)
        for name, value in flat.items()
        if name != "ego"
    }
    return Rounds(flat, visible, recordings.actions.flatten(0, 1), recordings.rewards.flatten(0, 1))


def test_one_trace_holds_implants_actions_states_observations_and_rewards(human, table, world):
    trace = poutine.trace(human.model).get_trace(table, world)
    sampled = {name for name, site in trace.nodes.items() if site["type"] == "sample"}
    assert {"sight_front_own", "assumes_clear", "consistency", "lapse", "residual_in"} <= sampled
    assert {"actions", "z", "x_ego", "x_visual", "x_verbal", "reward"} <= sampled
    assert trace.nodes["actions"]["is_observed"]
    assert trace.nodes["reward"]["is_observed"]


def test_the_bound_of_the_whole_is_the_sum_of_its_parts(human, table, world):
    """Given the actions, the world's part does not depend on implants: that is why fitting them
    leaves it out."""
    with pyro.settings.context(module_local_params=True):
        implants = continuous_guide(human, table)

        def guide(table, world=None):
            implants(table)
            if world is not None:
                human.self_model.guide(world)

        elbo = TraceEnum_ELBO(max_plate_nesting=PLATES)
        program = config_enumerate(human.model, "parallel")
        torch.manual_seed(3)
        whole = -elbo.loss(program, guide, table, world)
        torch.manual_seed(3)
        people = -elbo.loss(program, guide, table)
        torch.manual_seed(3)
        implants(table)
        robot, _ = human.self_model.elbo(world)
    assert_close(torch.tensor(whole), people + robot, rtol=1e-4, atol=1e-2)


def test_run_forward_without_data_it_is_a_prior(human, table):
    """Only the actions are observed; every implant is drawn for every person."""
    trace = poutine.trace(human.model).get_trace(table)
    for site in ("sight_front_own", "consistency", "lapse"):
        assert trace.nodes[site]["value"].shape == (table.people, 1)
