"""Priors at odds with most people: found from draws, reported by a fit."""

import math
from dataclasses import replace

import pytest
import torch

import mirror_ppl
from mirror_ppl.errors import PriorConflict
from mirror_ppl.inference.results.prior_conflict import conflict_line, prior_conflicts
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.weights import load_self_model, shipped_weights

PRIOR = {"consistency": torch.linspace(0, 100, 101).view(101, 1, 1)}
"""Its 99% interval is from 0.5 to 99.5."""


def draws_of(*medians):
    """Three draws for each person, ``[3, P, 1]``."""
    middle = torch.tensor(medians)[None, :, None]
    return {"consistency": torch.cat([middle - 1000, middle, middle + 1000])}


@pytest.mark.parametrize(
    ("medians", "people"),
    [
        ((100.0, 99.6, 50.0, 50.0), 2),
        ((0.4, 99.6, 50.0), 2),
        ((99.4, 0.6), 0),
        ((100.0, 50.0, 50.0), 0),
        ((100.0,), 1),
    ],
)
def test_half_of_the_people_beyond_the_interval_are_a_conflict(medians, people):
    found = prior_conflicts(draws_of(*medians), PRIOR)
    assert [each["people"] for each in found.values()] == [people] * (people > 0)


def test_a_conflict_has_people_their_median_and_the_interval():
    (conflict,) = prior_conflicts(draws_of(120.0, 130.0, 140.0, 50.0), PRIOR).values()
    assert conflict == {"people": 3, "median": 130.0, "prior": pytest.approx([0.5, 99.5])}
    assert conflict_line("consistency", conflict, 4) == (
        "The prior of consistency is at odds with 3 of 4 people (99% interval 0.5 to 99.5, their "
        "median 130)"
    )


def test_only_continuous_numbers_of_all_people_are_compared():
    far = draws_of(200.0)["consistency"]
    for value in (far.long(), far[..., None], torch.full_like(far, math.nan)):
        assert prior_conflicts({"consistency": value}, PRIOR) == {}
    assert prior_conflicts({"other": far}, PRIOR) == {}
    assert prior_conflicts({"consistency": far}, {"consistency": PRIOR["consistency"] / 0}) == {}


def test_a_fit_warns(monkeypatch):
    self_model, _ = load_self_model(shipped_weights("driving"), "driving")
    record = replace(self_model.domain.record, consistency=0.01)
    monkeypatch.setattr(self_model.domain, "record", record, raising=False)
    human = load_human_model("no-implants", self_model)
    some = mirror_ppl.load_recordings().select_people([0, 1])
    how = {"human": human, "train_rounds": 20, "explore": 0, "draws": 50}
    with pytest.warns(PriorConflict, match="prior of consistency is at odds with 2 of 2 people"):
        fit = mirror_ppl.infer(some, **how)
    assert fit.summary["prior_conflicts"]["consistency"]["people"] == 2
    monkeypatch.undo()
    assert mirror_ppl.infer(some, **how).summary["prior_conflicts"] == {}
    pooled = mirror_ppl.infer(some, **how, pooling="partial")
    assert pooled.summary["prior_conflicts"] == {}
