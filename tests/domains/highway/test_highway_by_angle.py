"""The human model with a reach in each sector: prior, sight, inference, picture."""

import math

import numpy as np
import pytest
import torch
from highway_fits import quick_fit

from mirror_ppl.communication import Person
from mirror_ppl.domains import get_domain
from mirror_ppl.domains.highway.human_variants import (
    LEVEL,
    LOG_REACH,
    MEDIAN,
    SHAPE,
    WIDTH,
    ByAngle,
    reach_in_bins,
)
from mirror_ppl.domains.highway.sight import has_sight, sight_picture, sight_probability
from mirror_ppl.domains.highway.world import DIRECTION_OF, KNOTS
from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.models import HumanModel
from mirror_ppl.models.implants import sight_sites
from mirror_ppl.models.loading import load_human_model, model_name, model_names
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.sizes import Sizes

SECTORS = 36


@pytest.fixture(scope="module")
def small():
    """A robot with untrained networks that are quick."""
    torch.manual_seed(0)
    return SelfModel(get_domain("highway"), Sizes(latent=8, encoder=16, q_network=16))


@pytest.fixture(scope="module")
def human(small):
    return ByAngle(small)


def test_similar_directions_have_similar_reaches(human):
    """Moments of the prior: variance LEVEL² + SHAPE², falling with the angle, around the circle."""
    drawn = draw_prior(human, 1, 20_000, 0)[LOG_REACH][:, 0, 0].double()
    total = LEVEL**2 + SHAPE**2
    # The standard error of a variance of n numbers is its size times the root of 2 / n.
    assert drawn.var(0).sub(total).abs().max() < 5 * total * (2 / 20_000) ** 0.5
    assert drawn.mean(0).exp().sub(MEDIAN).abs().max() < 5 * MEDIAN * (total / 20_000) ** 0.5
    correlation = torch.corrcoef(drawn.T)
    assert correlation[0, 1] > 0.95 and correlation[0, 35] > 0.95
    opposite = (LEVEL**2 + SHAPE**2 * math.exp(-2 / WIDTH**2)) / total
    assert correlation[0, 18] == pytest.approx(opposite, abs=0.02)
    assert (correlation[0, :19].diff() < 0.01).all()


def test_reaches_are_those_of_the_bins():
    metres = torch.tensor([0.5, 4.99, 5.0, 14.9, 15.1, 44.0, 59.0, 60.0, 500.0])
    expected = torch.tensor([0.0, 0, 5, 10, 15, 30, 45, 60, 60])
    # A hair further, as logarithms of 5 and 60 may be rounded down.
    assert torch.equal(reach_in_bins((metres * 1.0001).log()), expected)


def test_whose_reaches_are_equal_sees_as_with_thresholds(human, small):
    world = human.domain
    observed = world.observe(world.initial(200, torch.Generator().manual_seed(0)))
    thresholds = {site: torch.full((200,), place) for place, site in enumerate(sight_sites(world))}
    metres = torch.tensor(KNOTS)[: len(thresholds)][list(DIRECTION_OF)]
    by_angle = {LOG_REACH: (metres + 0.5).log().expand(200, SECTORS)}
    found = human.sees(by_angle, observed, 0)
    expected = HumanModel(small).sees(thresholds, observed, 0)
    assert torch.equal(found["visual"], expected["visual"]) and found["visual"].any()


def test_it_is_a_model_of_the_highway_only(human):
    assert "by-angle" in model_names() and model_name("ByAngle") == "by-angle"
    assert isinstance(load_human_model("by-angle", human.self_model), ByAngle)
    driving = SelfModel(get_domain("driving"), Sizes(latent=4, encoder=8, q_network=8))
    with pytest.raises(HumanModelError, match="driving has no such human model, only highway"):
        load_human_model("by-angle", driving)


@pytest.fixture(scope="module")
def fit(human):
    return quick_fit(human, 8)


def test_it_is_checked_and_fitted(human, fit):
    check_contract(human, shipped=True)
    assert fit.data["posterior"][LOG_REACH].shape == (1, 16, 1, SECTORS)
    assert "identifiability" not in fit.data.groups()
    assert Person(human, draw_prior(human, 1, 4, 0)).percepts[LOG_REACH].shape == (4, SECTORS)


def test_the_picture_shows_the_reach_of_each_sector(fit):
    data = fit.data.copy()
    reach = np.full((1, 16, 1, SECTORS), np.log(12.0))  # between the rings of 10 and 15 m
    reach[0, :8, 0, 5] = np.log(100.0)
    data["posterior"][LOG_REACH].values[:] = reach
    assert has_sight(data)
    found = sight_probability(data, "person-01")
    assert found.shape == (SECTORS, len(KNOTS) - 1)
    assert found[0].tolist() == [1.0, 1.0, 0, 0, 0, 0, 0]
    assert found[5].tolist() == [1.0, 1.0, 0.5, 0.5, 0.5, 0.5, 0.5]
    (wedges,) = sight_picture(data).axes
    assert len(wedges.collections) == 1 and len(wedges.lines) == 1  # with the true reach
