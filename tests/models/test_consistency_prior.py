"""The prior of consistency: its median is the world's, of people inferred and simulated."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mirror_ppl.domains import DOMAINS, get_domain
from mirror_ppl.domains.driving import Driving
from mirror_ppl.domains.record import Record
from mirror_ppl.errors import InputError
from mirror_ppl.models.implants import CONSISTENCY_SPREAD
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import sample_sites
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people.robot_like import simulated_robot_like

ROOT = Path(__file__).parents[2]


@pytest.fixture
def self_model():
    return load_self_model(shipped_weights("driving"), "driving")[0]


def with_median(self_model, monkeypatch, median):
    record = replace(Driving.record, consistency=median)
    monkeypatch.setattr(self_model.domain, "record", record, raising=False)


@pytest.mark.parametrize("median", [0.5, 3.0, 20.0])
@pytest.mark.parametrize("name", ["mirror", "no-implants", "policy-only", "preferring"])
def test_the_prior_median_is_the_worlds(self_model, monkeypatch, name, median):
    with_median(self_model, monkeypatch, median)
    human = load_human_model(name, self_model)
    with torch.random.fork_rng():
        prior = sample_sites(human, 1)["consistency"]["fn"]
    while not hasattr(prior, "loc"):
        prior = prior.base_dist
    assert prior.loc.exp().unique().item() == pytest.approx(median)
    assert prior.scale.unique().item() == pytest.approx(CONSISTENCY_SPREAD)


def test_people_like_the_robot_come_from_it(self_model, monkeypatch):
    people, median = 400, 20.0
    usual = simulated_robot_like(self_model, "fog", "paper", people, 0)
    with_median(self_model, monkeypatch, median)
    own = simulated_robot_like(self_model, "fog", "paper", people, 0)
    torch.testing.assert_close(own.consistency, usual.consistency * median / 3)
    # Four standard errors of the mean of a logarithm.
    error = 4 * CONSISTENCY_SPREAD / people**0.5
    assert abs(own.consistency.log().mean() - math.log(median)) < error


def test_medians_of_the_worlds_that_ship():
    assert Record().consistency == 3.0
    medians = {name: get_domain(name).record.consistency for name in DOMAINS}
    assert medians.pop("search_rescue") == 13.0 and medians.pop("highway") == 1.0
    assert set(medians.values()) == {3.0}
    page = (ROOT / "docs/human_model.md").read_text()
    factor = math.exp(1.645 * CONSISTENCY_SPREAD)
    rescue = "in search and rescue [13](decisions.md#the-human-model) "
    assert f"{rescue}({13 / factor:.1f} to {13 * factor:.1f})" in page
    assert f"on the highway 1 ({1 / factor:.1f} to {factor:.1f})" in page
    assert f"3 per unit of reward (90% between {3 / factor:.1f} and {3 * factor:.1f})" in page


@pytest.mark.parametrize("value", [0, -1, "1", float("nan"), float("inf")])
def test_a_median_is_a_positive_number(value):
    with pytest.raises(InputError, match="consistency must be"):
        Record(consistency=value)
