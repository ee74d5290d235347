"""The prior of how far people see: uniform, or alike in the directions of a group."""

import math
from dataclasses import replace

import pyro
import pytest
import torch
from pyro import poutine

from mirror_ppl.domains.driving import Driving
from mirror_ppl.domains.highway import Highway
from mirror_ppl.domains.record import Record
from mirror_ppl.errors import InputError
from mirror_ppl.models.implants import alike, perceptual_implants, sight_sites


def world(groups, scale):
    class OneMore(Driving):
        direction_groups = groups
        record = replace(Driving.record, sight_scale=scale)

    return OneMore()


def log_probabilities(domain, people=64):
    """Values ``[P]`` of sites of sight, and their log prior."""
    with torch.random.fork_rng(), poutine.trace() as recorded, pyro.plate("person", people, dim=-2):
        torch.manual_seed(0)
        perceptual_implants(domain, torch.zeros(()))
    recorded.trace.compute_log_prob()
    return {
        site: (
            recorded.trace.nodes[site]["value"].expand(people, 1)[:, 0],
            recorded.trace.nodes[site]["log_prob"].expand(people, 1)[:, 0],
        )
        for site in sight_sites(domain)
    }


def test_probability_falls_with_bins_apart():
    prior = alike(8, 2.0)
    torch.testing.assert_close(prior.sum(-1), torch.ones(8))
    for near, reach in ((0, 1), (3, 7), (7, 0)):
        expected = math.exp(-abs(reach - near) / 2)
        assert prior[near, reach] / prior[near, near] == pytest.approx(expected)


def test_directions_depend_on_the_first_of_their_group():
    domain = world(((2, 0), (3,)), 0.5)
    found, number = log_probabilities(domain), len(domain.reach_bins)
    sites = sight_sites(domain)
    uniform = torch.full((64,), -math.log(number))
    for place in (1, 2, 3):  # 1 is in no group
        torch.testing.assert_close(found[sites[place]][1], uniform)
    value, own = found[sites[0]]
    torch.testing.assert_close(own, alike(number, 0.5)[found[sites[2]][0], value].log())


@pytest.mark.parametrize("groups", [((0, 1), (2, 3)), ((0,),)])
def test_without_a_scale_all_are_uniform(groups):
    for _, own in log_probabilities(world(groups, None)).values():
        torch.testing.assert_close(own, torch.full((64,), -math.log(7)))


def test_highway_drivers_see_alike_to_the_sides():
    assert Highway.record.sight_scale == 1.0
    found = log_probabilities(Highway())
    for side, straight in (("ahead_aside", "ahead"), ("behind", "behind_aside")):
        value, own = found["sight_" + side]
        torch.testing.assert_close(own, alike(8, 1.0)[found["sight_" + straight][0], value].log())


@pytest.mark.parametrize("value", [0, -1, "1", float("nan")])
def test_a_scale_is_a_positive_number(value):
    with pytest.raises(InputError, match="sight_scale must be"):
        Record(sight_scale=value)
