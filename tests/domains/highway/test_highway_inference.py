"""Drivers are inferred, drawn and spoken to by the same code as people elsewhere.

The self-model is untrained, so that nothing is said of how right the results are.
"""

import numpy as np
import pytest
import torch
from highway_fits import quick_fit

from mirror_ppl.communication import Person, RoundSoFar
from mirror_ppl.communication.objectives import ExpectedValue
from mirror_ppl.communication.planners import PlannerOptions, planner_of
from mirror_ppl.domains.highway import Highway
from mirror_ppl.domains.highway.sight import KNOTS, SITES, sight_probability
from mirror_ppl.models import HumanModel, SelfModel
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.sizes import Sizes


@pytest.fixture(scope="module")
def human():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return HumanModel(SelfModel(Highway(), Sizes(latent=8, encoder=16, q_network=16)))


@pytest.fixture(scope="module")
def fit(human):
    return quick_fit(human, 12)


def test_reach_and_assumption_of_a_driver_are_inferred(fit):
    own = fit.summary["people"][0]["implants"]
    assert {*SITES, "assumes_clear", "consistency"} <= set(own)
    assert set(np.unique(fit.data["posterior"]["sight_ahead"])) <= set(KNOTS)


def test_the_picture_shows_where_cars_are_seen(fit):
    seen = sight_probability(fit.data, "person-01")
    ahead = fit.data["posterior"]["sight_ahead"].values.flatten()
    assert seen.shape == (36, len(KNOTS) - 1)
    for place, far in enumerate(KNOTS[1:]):
        assert seen[0, place] == pytest.approx((ahead >= far).mean())
    assert (np.diff(seen, axis=1) <= 0).all()
    assert (seen[1] == seen[-1]).all() and (seen[6] == seen[-6]).all()  # left as right
    (axes,) = fit.plot.sight().axes
    assert axes.name == "polar" and axes.get_title().startswith("person-01")


@torch.no_grad()
def test_messages_are_planned_by_values(human):
    world = Highway()
    person = Person(human, draw_prior(human, 1, 8, 0))
    planner = planner_of("mirror", person, PlannerOptions.of("highway"), 0)
    assert isinstance(planner.objective, ExpectedValue)
    now = world.observe(world.initial(1, torch.Generator().manual_seed(0)))
    decision = planner.plan(RoundSoFar.begin(world, {n: part[0] for n, part in now.items()}))
    assert decision.flags.shape == (12,) and decision.flags.sum() <= 2
