"""What differs from round to round: sampled by the program, and values that stand for all."""

import itertools
import math

import pyro
import pytest
import torch
from example_attention import NOTICED, NOTICES, STEPS, drawn, geometric
from example_course import perceived

from mirror_ppl import limits
from mirror_ppl.errors import OptionError
from mirror_ppl.inference.calibration.study import prior_people
from mirror_ppl.likelihood.attention import choose_values, site_probabilities
from mirror_ppl.likelihood.densities import log_weighted_latents
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.implants import first_success
from mirror_ppl.models.simulation import play_rounds

# --- the program


def test_the_first_success_is_geometric():
    for probability in (0.05, 0.5, 0.9):
        found = first_success(torch.tensor(probability), STEPS).probs
        torch.testing.assert_close(found, geometric(probability), rtol=1e-4, atol=1e-7)
    for sure, when in ((1.0, 0), (0.0, STEPS)):
        assert first_success(torch.tensor(sure), STEPS).probs[when] > 0.9999


def test_the_probability_of_attention_is_that_of_the_program(per_item):
    implants = {site: torch.rand(3, 1) for site in NOTICES}
    values = {site: torch.randint(STEPS + 1, (3, 2, 7)) for site in NOTICED}
    weights = torch.randn(3, 2, 7)
    with pyro.plate("person", 3, dim=-2):
        found = log_weighted_latents(per_item, implants, values, weights)
    expected = weights.clone()
    for person, number, value in itertools.product(range(3), range(2), range(7)):
        for notices, noticed in zip(NOTICES, NOTICED, strict=True):
            probabilities = geometric(float(implants[notices][person, 0]))
            expected[person, number, value] += probabilities[
                values[noticed][person, number, value]
            ].log()
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3)
    assert pyro.get_param_store().keys() == {}.keys()


def test_an_item_is_seen_from_when_it_is_noticed(per_item, recordings):
    observation, told, _, _ = vars(rounds_of(recordings, 0).at(0, 1)).values()
    nothing = {name: torch.zeros_like(mask) for name, mask in told.items()}
    when = dict(zip(NOTICED, torch.tensor([[0], [4], [14], [15]]), strict=True))
    open_ = {"assumes_clear": torch.tensor([0]), "assumes_closing": torch.tensor([0])}
    seen = perceived(per_item, when | open_, observation, nothing).visible["visual"][0]
    steps = torch.arange(STEPS)
    for place, first in enumerate((0, 4, 14, 15)):
        assert torch.equal(seen[:, place], steps >= first)


def test_views_that_do_not_fit_into_memory_are_refused(per_item, recordings, monkeypatch):
    monkeypatch.setattr(limits, "free_memory", lambda: 2**20)
    builder = ViewTableBuilder(per_item, Screening())
    # 4 combinations of assumptions and 512 values, 15 steps; 4 items with 2 and 4 with 3 numbers
    # and a mask each, 16 bytes.
    needed = 4 * 512 * 15 * (4 * 3 + 4 * 4) * 16 / 2**30
    with pytest.raises(OptionError) as error:
        builder.add(rounds_of(recordings, 0))
    assert str(error.value) == (
        "views of 4 combinations of discrete sites with 512 values of round_latents each (fewer "
        f"sites take less) would need about {needed:.1f} GB of memory, 0.0 GB are free"
    )


def test_attention_differs_between_rounds_and_people_and_follows_its_seed(per_item):
    def play(seed):
        generator = torch.Generator().manual_seed(seed)
        people = prior_people(per_item, 2, torch.Generator().manual_seed(0))
        people |= {site: torch.full((2, 1), 0.3) for site in NOTICES}
        return play_rounds(per_item, people, 3, "fog", generator).actions

    torch.manual_seed(5)
    first = play(1)
    torch.manual_seed(6)
    state = torch.random.get_rng_state()
    assert torch.equal(play(1), first)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert not torch.equal(play(2), first)


def test_attention_of_two_people_is_drawn_with_their_own_probabilities(per_item):
    implants = {site: torch.tensor([[0.9], [0.05]]) for site in NOTICES}
    torch.manual_seed(0)
    with pyro.plate("person", 2, dim=-2), pyro.plate("round", 1000, dim=-1):
        drawn = per_item.round_latents(implants)
    for site in NOTICED:
        assert drawn[site].shape == (2, 1000)
        for person, probability in enumerate((0.9, 0.05)):
            at_once = (drawn[site][person] == 0).double().mean()
            error = math.sqrt(probability * (1 - probability) / 1000)
            assert abs(at_once - probability) < 5 * error


# --- values that stand for all


SUPPORTS = {"a": torch.arange(4), "b": torch.tensor([1, 3]), "c": torch.arange(5)}
CHANCES = {
    "a": torch.tensor([0.7, 0.2, 0.05, 0.05]),
    "b": torch.tensor([0.9, 0.1]),
    "c": torch.tensor([0.5, 0.3, 0.1, 0.05, 0.05]),
}


def chosen(number, seed=0):
    return choose_values(SUPPORTS, CHANCES, number, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("number", [40, 100])
def test_few_combinations_are_all_there(number):
    found = chosen(number)
    assert len(found) == 40
    rows = set(zip(*(found.values[site].tolist() for site in SUPPORTS), strict=True))
    assert rows == set(itertools.product(*(support.tolist() for support in SUPPORTS.values())))
    assert (found.log_weights == 0).all()


@pytest.mark.parametrize("number", [1, 3, 12, 39])
def test_of_many_there_are_as_many_as_asked_for_without_repetition(number):
    for seed in range(20):
        found = chosen(number, seed)
        assert abs(len(found) - number) <= 1
        rows = list(zip(*(found.values[site].tolist() for site in SUPPORTS), strict=True))
        assert len(set(rows)) == len(rows)
        assert (found.log_weights >= 0).all()
        if number >= 12:  # the most probable one, of .315, is there for certain
            place = rows.index((0, 1, 0))
            assert found.log_weights[place] == 0


@pytest.mark.parametrize("number", [6, 20])
def test_weighted_sums_are_right_on_average(number):
    """Whatever is summed; the standard error comes from the repetitions themselves."""
    axes = torch.meshgrid(*(support.double() for support in SUPPORTS.values()), indexing="ij")
    functions = [
        lambda a, b, c: torch.ones_like(a),
        lambda a, b, c: (a == 3).double() * (c == 4).double() * 100,
        lambda a, b, c: a * b - c,
    ]
    exact = torch.stack([function(*axes).sum() for function in functions])
    drawn = [chosen(number, seed) for seed in range(3000)]
    rows = [torch.cat([one.values[site] for one in drawn]).double() for site in SUPPORTS]
    weights = torch.cat([one.log_weights for one in drawn]).double().exp()
    which = torch.arange(len(drawn)).repeat_interleave(torch.tensor([len(one) for one in drawn]))
    parts = torch.stack([weights * function(*rows) for function in functions], -1)
    found = torch.zeros(len(drawn), len(functions)).double().index_add_(0, which, parts)
    error = found.std(0) / math.sqrt(len(found))
    assert ((found.mean(0) - exact).abs() < 5 * error).all()


def test_what_is_kept_stands_for_what_is_not():
    found = chosen(30)
    useful = torch.softmax(torch.arange(30.0) / 4, 0)
    something = torch.arange(30.0).double()
    totals = []
    for seed in range(2000):
        kept = found.thinned(useful, 8, seed)
        assert abs(len(kept.kept) - 8) <= 1
        totals.append((something[kept.kept] / kept.log_kept.double().exp()).sum())
    totals = torch.stack(totals)
    error = totals.std() / math.sqrt(len(totals))
    assert abs(totals.mean() - something.sum()) < 5 * error


def test_sites_are_proposed_by_probable_people(per_item):
    ways = drawn(per_item, 2)
    ways |= {site: torch.tensor([0.2, 0.8]).view(2, 1, 1) for site in NOTICES}
    found = site_probabilities(per_item, ways)
    for site in NOTICED:
        expected = (geometric(0.2) + geometric(0.8)) / 2
        torch.testing.assert_close(found[site], expected, rtol=1e-4, atol=1e-6)
    found = site_probabilities(per_item, ways, torch.tensor([0.0, 1.0]))
    torch.testing.assert_close(found[NOTICED[0]], geometric(0.8), rtol=1e-4, atol=1e-6)
