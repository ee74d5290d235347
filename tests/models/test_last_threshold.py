"""The last threshold of sight is everything, also where distances exceed it."""

from dataclasses import replace

import pytest
import torch
from example_recordings import shipped
from few_reaches import FewReaches, robot_of_few_reaches

from mirror_ppl.domains import get_domain
from mirror_ppl.models import HumanModel
from mirror_ppl.models.implants import sight_limits, sight_sites
from mirror_ppl.people.robot_like import simulated_robot_like
from mirror_ppl.training.views import draw_views

WORLD = FewReaches()
LAST = len(WORLD.reach_bins) - 1


@pytest.fixture(scope="module")
def human():
    return HumanModel(robot_of_few_reaches())


@pytest.fixture(scope="module")
def observation():
    every = shipped("driving", "fog", 3, 4).observation()
    assert float(WORLD.distance(every)[1].max()) > WORLD.reach_bins[-1]
    return every


def test_people_with_the_last_threshold_see_everything(human, observation):
    distance = WORLD.distance(observation)[1]
    for index, edge in enumerate(WORLD.reach_bins):
        implants = {site: torch.full((1,), index) for site in sight_sites(WORLD)}
        seen = human.sees(implants, observation, 0)["visual"]
        assert torch.equal(seen, (distance <= edge) | (index == LAST))


def test_simulated_people_and_the_robot_in_training_do_so_too(human, observation):
    people = simulated_robot_like(human.self_model, "clear", "diverse", 3, 0)
    for edge in WORLD.reach_bins:
        own = replace(people, reach=torch.full((3, 4), edge))
        expected = (WORLD.distance(observation)[1] <= edge) | (edge == WORLD.reach_bins[-1])
        assert torch.equal(own.sees(observation)["visual"], expected)
    now = {name: value[0, :, :5] for name, value in observation.items()}
    views = draw_views(WORLD, 4, 4, torch.Generator().manual_seed(0), kinds=(1.0, 0.0, 0.0))
    assert views.sees(WORLD, now)["visual"].all()


@pytest.mark.parametrize(
    ("name", "setting"), [("driving", "clear"), ("search_rescue", "clear"), ("highway", "clear")]
)
def test_it_changes_nothing_where_the_last_bin_is_the_whole_world(name, setting):
    domain = get_domain(name)
    observation = shipped(name, setting, 2, 4).observation()
    assert float(domain.distance(observation)[1].max()) <= domain.reach_bins[-1]
    implants = {site: torch.arange(len(domain.reach_bins)) for site in sight_sites(domain)}
    limits = sight_limits(domain, implants)
    assert limits[:-1, 0].tolist() == pytest.approx(domain.reach_bins[:-1])
    assert limits[-1].isinf().all()
