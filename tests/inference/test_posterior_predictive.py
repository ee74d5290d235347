"""Predictions of people one by one: the same whoever else was recorded."""

from dataclasses import replace

import pytest
import torch
from example_views import ragged

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.inference.results import posterior_predictive
from mirror_ppl.inference.results.posterior_predictive import (
    chosen_log_probability,
    predict_rounds,
)
from mirror_ppl.inference.results.predictions import _drawn, predict_person
from mirror_ppl.inference.results.summary import score
from mirror_ppl.models import HumanModel
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.variants import PerItem
from mirror_ppl.models.weights import load_self_model, shipped_weights

PEOPLE = 10
LENGTHS = [[15, 15, 15, 15], [15], [], [7, 15, 2, 1], [15, 15], [1, 1, 1, 1], *[[15, 9, 15]] * 4]


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


@pytest.fixture(scope="module")
def human(self_model):
    return HumanModel(self_model)


@pytest.fixture(scope="module")
def recordings():
    return load_demonstrations(asset_path("driving_fog_paper.nc"))


@pytest.fixture(scope="module")
def train(recordings):
    """Up to four rounds of up to 15 steps."""
    return ragged(recordings, LENGTHS)


@pytest.fixture(scope="module")
def test(recordings):
    return recordings.select_rounds([5, 6])


@pytest.mark.parametrize("kind", [HumanModel, PerItem])
def test_a_persons_predictions_do_not_depend_on_the_others(self_model, train, kind):
    """Bit for bit, in the padding too."""
    human = kind(self_model)
    some = [3, 0, 2]
    own = draw_prior(human, PEOPLE, 3, 1)
    found = predict_rounds(human, train, own)
    assert found.shape == (3, PEOPLE, 4, 15, 2)
    alone = {name: value[:, some] for name, value in own.items()}
    again = predict_rounds(human, train.select_people(some), alone)
    _, _, rounds, steps, _ = again.shape
    assert torch.equal(again, found[:, some, :rounds, :steps])


@pytest.mark.parametrize("kind", [HumanModel, PerItem])
@pytest.mark.parametrize("person", [0, 3])
def test_results_are_of_these_predictions(self_model, train, test, kind, person, monkeypatch):
    """Views are listed once for posterior and prior, but where attention is proposed from draws."""
    human, own = kind(self_model), train.select_people([person])
    held_out = test.select_people([person])
    draws = draw_prior(human, 1, 6, 1), draw_prior(human, 1, 4, 2)
    learned, expected = (predict_rounds(human, own, some) for some in draws)
    later = predict_rounds(human, held_out, draws[0])
    listed, build = [], posterior_predictive.build_view_table

    def spy(human, *given, **named):
        listed.append(type(human).__name__)
        return build(human, *given, **named)

    monkeypatch.setattr(posterior_predictive, "build_view_table", spy)
    found = predict_person(human, (own, held_out), draws, 3)
    assert listed.count(kind.__name__) == (2 if kind is HumanModel else 3)
    close = {"rtol": 1e-5, "atol": 1e-4}
    torch.testing.assert_close(
        found.log_likelihood, chosen_log_probability(learned, own).sum(-1), **close
    )
    torch.testing.assert_close(found.held_out, later.exp(), **close)
    (scores,), (expected_scores,) = found.scores, score(later, held_out)
    assert scores == pytest.approx(expected_scores, rel=1e-4)
    assert found.posterior.shape == learned.shape[:-1] and found.prior.shape == expected.shape[:-1]


def test_few_prior_and_posterior_draws_are_drawn_from_their_own_predictions(human, recordings):
    """People who hardly err, and people who act at random, whichever are the prior."""
    one = recordings.select_people([0]).select_rounds([0])
    random = draw_prior(human, 1, 40, 1)
    random |= {"consistency": torch.full_like(random["consistency"], 1e-6)}
    random |= {"residual_out": torch.zeros_like(random["residual_out"])}
    sure = random | {"consistency": torch.full_like(random["consistency"], 1e4)}
    sure |= {"lapse": torch.zeros_like(random["lapse"])}
    for draws in ((sure, random), (random, sure)):
        found = predict_person(human, (one, None), draws, 0)
        for drawn, own in zip((found.posterior, found.prior), draws, strict=True):
            expected = predict_rounds(human, one, own).exp().mean(0)[..., 1]
            shares = drawn.double().mean(0)
            # Four standard errors of 40 draws.
            spread = (expected * (1 - expected) / 40).sqrt() * 4 + 1e-3
            assert bool(((shares - expected).abs() <= spread).all())


@pytest.mark.parametrize("probabilities", [[0.1, 0.2, 0.7], [0.5, 0.5, 0.0]])
def test_predictive_draws_follow_the_probabilities(probabilities):
    exact = torch.tensor(probabilities)
    generator = torch.Generator().manual_seed(0)
    drawn = _drawn(exact.log()[None, None, None, None].expand(500, 1, 4, 5, 3), generator)
    assert drawn.shape == (500, 1, 4, 5) and drawn.dtype == torch.int8
    often = torch.bincount(drawn.flatten().long(), minlength=3) / 10_000
    torch.testing.assert_close(often, exact, atol=0.02, rtol=0)
    assert len({tuple(one.flatten().tolist()) for one in drawn}) == 500


def test_predictive_draws_hang_on_the_person_and_the_seed(human, recordings):
    """Those of a twin with another id differ, too."""
    one = recordings.select_people([0]).select_rounds([0])
    twin = replace(one, people=("ann",))
    draws = draw_prior(human, 1, 40, 1)
    first, again, other, seeded = (
        predict_person(human, (own, None), (draws, draws), seed)
        for own, seed in ((one, 0), (one, 0), (twin, 0), (one, 1))
    )
    assert first.held_out is None and first.scores is None
    assert torch.equal(first.prior, again.prior)
    assert not torch.equal(first.prior, other.prior)
    assert not torch.equal(first.prior, seeded.prior)
    assert not torch.equal(first.prior, first.posterior)
