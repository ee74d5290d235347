"""Predictions of people in groups: those of all at once, whoever else was recorded."""

from dataclasses import fields

import pytest
import torch
from example_views import ragged

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.inference.results import posterior_predictive
from mirror_ppl.inference.results.posterior_predictive import (
    chosen_log_probability,
    groups,
    predict_rounds,
)
from mirror_ppl.inference.results.predictions import _drawn, predict_people
from mirror_ppl.inference.results.summary import score
from mirror_ppl.models import HumanModel
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.variants import PerItem
from mirror_ppl.models.weights import load_self_model, shipped_weights

PEOPLE, AT_ONCE = 10, 8
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
    """Four rounds of 15 steps: those of eight people fill blocks of 32 numbers."""
    return ragged(recordings, LENGTHS)


@pytest.fixture(scope="module")
def test(recordings):
    return recordings.select_rounds([5, 6])


@pytest.fixture(scope="module")
def draws(human):
    return draw_prior(human, PEOPLE, 6, 1), draw_prior(human, PEOPLE, 4, 2)


@pytest.fixture(scope="module")
def learned(human, train, draws):
    """Log-probabilities of all people's actions at once."""
    return predict_rounds(human, train, draws[0])


@pytest.fixture(scope="module")
def whole(human, train, test, draws):
    """Predictions of all people at once."""
    return predict_people(human, (train, test), draws, 3)


@pytest.mark.parametrize(
    ("people", "ends"), [(1, [1]), (2, [2]), (3, [3]), (4, [4]), (5, [3, 5]), (7, [3, 7])]
)
def test_a_person_who_is_left_over_joins_the_last_group(monkeypatch, people, ends):
    monkeypatch.setattr(posterior_predictive, "PEOPLE_AT_ONCE", 3)
    found = groups(people)
    assert [number for some in found for number in some] == list(range(people))
    assert [some.stop for some in found] == ends


def test_groups_predict_as_all_people_at_once(monkeypatch, human, train, draws, learned):
    """Bit for bit, in the padding too, and with the views of no more people in memory."""
    assert learned.shape == (6, PEOPLE, 4, 15, 2)
    built, build = [], posterior_predictive.build_view_table

    def spy(human, rounds, *args, **kwargs):
        built.append(rounds.num_people)
        return build(human, rounds, *args, **kwargs)

    monkeypatch.setattr(posterior_predictive, "build_view_table", spy)
    monkeypatch.setattr(posterior_predictive, "PEOPLE_AT_ONCE", AT_ONCE)
    assert torch.equal(predict_rounds(human, train, draws[0]), learned)
    assert built == [8, 2]


def test_groups_predict_as_all_people_at_once_where_attention_differs(
    monkeypatch, self_model, train
):
    """Views of a group are padded to its own largest number, so the last digits may differ."""
    human = PerItem(self_model)
    some = train.select_people(range(4))
    own = draw_prior(human, 4, 3, 1)
    whole = predict_rounds(human, some, own)
    monkeypatch.setattr(posterior_predictive, "PEOPLE_AT_ONCE", 2)
    found = predict_rounds(human, some, own)
    mask = some.mask.expand(3, *some.mask.shape)
    torch.testing.assert_close(found[mask], whole[mask], rtol=1e-5, atol=1e-5)


def test_results_are_of_these_predictions(human, train, test, draws, learned, whole):
    held_out = predict_rounds(human, test, draws[0])
    assert torch.equal(whole.log_likelihood, chosen_log_probability(learned, train).sum(-1))
    assert torch.equal(whole.held_out, held_out.exp())
    assert whole.scores == score(held_out, test)
    assert whole.posterior.shape == (6, PEOPLE, 4, 15) and whole.prior.shape == (4, PEOPLE, 4, 15)


def test_results_of_groups_are_those_of_all_people(monkeypatch, human, train, test, draws, whole):
    reports = []
    monkeypatch.setattr(posterior_predictive, "PEOPLE_AT_ONCE", AT_ONCE)
    found = predict_people(human, (train, test), draws, 3, lambda *told: reports.append(told))
    for field in fields(found):
        one, other = getattr(found, field.name), getattr(whole, field.name)
        exact = field.name in ("scores", "checks")
        assert one == other if exact else torch.equal(one, other)
    assert reports == [("predict", done, PEOPLE, "people") for done in (0, 8, 10)]


def test_predictive_draws_do_not_depend_on_other_people(human, train, draws, whole):
    alone = train.select_people([0, 1])
    some = tuple({name: value[:, :2] for name, value in own.items()} for own in draws)
    found = predict_people(human, (alone, None), some, 3)
    assert found.held_out is None and found.scores is None
    assert torch.equal(found.posterior, whole.posterior[:, :2])
    assert torch.equal(found.prior, whole.prior[:, :2])
    again = predict_people(human, (alone, None), some, 4)
    assert not torch.equal(again.posterior, found.posterior)


def test_predictive_draws_follow_the_probabilities():
    exact = torch.tensor([[0.1, 0.2, 0.7], [0.5, 0.5, 0.0]])  # of two people
    log_probabilities = exact.log()[None, :, None, None].expand(500, 2, 4, 5, 3)
    generators = [torch.Generator().manual_seed(number) for number in range(2)]
    drawn = _drawn(log_probabilities, generators)
    assert drawn.shape == (500, 2, 4, 5) and drawn.dtype == torch.int8
    for person, expected in enumerate(exact):
        often = torch.bincount(drawn[:, person].flatten().long(), minlength=3) / 10_000
        torch.testing.assert_close(often, expected, atol=0.02, rtol=0)
    assert not torch.equal(drawn[:, 0], drawn[:, 1])
