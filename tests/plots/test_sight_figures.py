"""Figures of what drivers see, checked in numbers."""

import arviz as az
import numpy as np
import pytest
import xarray as xr
from example_drivers import PEOPLE, SITES, draw, made_up
from matplotlib.patches import FancyBboxPatch
from matplotlib.text import Text

from mirror_ppl.domains.driving import road
from mirror_ppl.domains.driving.road import (
    has_sight,
    outline,
    plot_sight,
    seen_of_draws,
    sight_picture,
    sight_probability,
    true_sight,
)
from mirror_ppl.domains.driving.samples import CARS, samples_picture
from mirror_ppl.plots.picture import Picture


@pytest.fixture
def data(rng):
    return made_up(rng)


def test_sight_probability_is_the_share_of_draws_that_reach_there(data):
    seen = sight_probability(data, "anna")
    assert seen.dims == ("lane", "distance")
    assert seen["lane"].values.tolist() == ["own", "other"]
    assert seen["distance"].values.tolist() == list(range(-12, 13))
    expected = np.zeros((2, 25))
    expected[0, 12:15] = 1  # abreast, and one and two cells ahead
    expected[0, 15:17] = 0.25
    expected[1, 12] = 1
    expected[1, 13] = 0.75
    expected[1, 14:] = 0.25
    expected[1, 9:12] = [0.25, 0.5, 0.75]
    assert np.array_equal(seen.values, expected)
    assert (sight_probability(data, "ben") == 1).all()


def test_chains_are_taken_together(data):
    split = data.posterior.isel(draw=[0, 1]).assign_coords(draw=[0, 1])
    rest = data.posterior.isel(draw=[2, 3]).assign_coords(draw=[0, 1], chain=[1])
    both = az.InferenceData(posterior=xr.concat([split, rest], "chain"))
    assert np.array_equal(sight_probability(both, "anna"), sight_probability(data, "anna"))


def test_truth_is_known_of_anna_alone(data):
    real = true_sight(data, "anna")
    ahead = [[1] * 3 + [0] * 10, [1] * 2 + [0] * 11]
    behind = [[0] * 12, [0] * 9 + [1] * 3]
    assert real.values.tolist() == [behind[lane] + ahead[lane] for lane in (0, 1)]
    assert true_sight(data, "ben") is None


def test_outline_runs_around_what_is_seen(data):
    edges = {frozenset(edge) for edge in outline(true_sight(data, "anna"))}
    expected = set()
    for start, end, y in ((0, 2, 0), (-3, 1, 2)):  # lower edge of the own lane, upper of the other
        expected |= {frozenset({(x - 0.5, y), (x + 0.5, y)}) for x in range(start, end + 1)}
    for x in (-3, -2, -1, 2):  # between the lanes, where one is seen and the other is not
        expected.add(frozenset({(x - 0.5, 1), (x + 0.5, 1)}))
    for x, y in ((-0.5, 0), (2.5, 0), (-3.5, 1), (1.5, 1)):
        expected.add(frozenset({(x, y), (x, y + 1)}))
    assert edges == expected


def test_outline_of_a_road_that_is_seen_whole_is_its_border(data):
    edges = outline(sight_probability(data, "ben"))
    assert len(edges) == len(set(edges)) == 2 * 25 + 2 * 2
    assert {x for edge in edges for x, _ in edge} == {n - 0.5 for n in range(-12, 14)}
    assert {y for edge in edges for _, y in edge} == {0, 1, 2}


def test_picture_has_the_road_of_each_person(data):
    figure = sight_picture(data)
    roads = [ax for ax in figure.axes if ax.images]
    assert [ax.get_title(loc="left") for ax in roads] == PEOPLE
    for ax, person in zip(roads, PEOPLE, strict=True):
        image = ax.images[0]
        assert np.array_equal(image.get_array(), sight_probability(data, person))
        # Own lane below, the first cell 12 behind; light is what is seen.
        assert (image.origin, image.get_extent()) == ("lower", [-12.5, 12.5, 0, 2])
        assert image.cmap(1.0)[:3] > image.cmap(0.0)[:3]
    assert "driving in fog" in figure.get_suptitle()
    draw(figure)


def test_samples_are_drawn_beside_what_is_really_seen(data):
    """Black are the cells that are not seen: of 50 all but those, in each panel."""
    figure = samples_picture(data)
    titles = [ax.get_title(loc="left") for ax in figure.axes if ax.get_title(loc="left")]
    assert titles == ["what they see", *(f"sample {number}" for number in range(1, 5))]
    black = [
        sum(
            len(cells.get_paths())
            for cells in ax.collections
            if tuple(cells.get_facecolor()[0][:3]) == (0, 0, 0)
        )
        for ax in figure.axes
    ]
    own = [int(50 - one.sum()) for one in seen_of_draws(data, "anna").values]
    # Of the four draws in order; ben sees everything, and of him the truth is not known.
    assert black == [int(50 - true_sight(data, "anna").sum()), *own] + [0] * 5
    assert len(set(own)) > 1
    assert not figure.axes[5].axison
    # Red bodies of the cars in sight, nothing of others.
    for ax, one in zip(figure.axes[1:5], seen_of_draws(data, "anna").values, strict=True):
        assert len(ax.findobj(FancyBboxPatch)) == 1 + sum(
            one[lane, distance + 12] for distance, lane in CARS
        )
    draw(figure)


def test_outlines_are_drawn_where_the_truth_is_known(data):
    known, unknown = (len(plot_sight(data, name).collections) for name in ("anna", "ben"))
    assert known - unknown == 2  # a line and its dark edge


def test_explanation_mentions_the_truth_only_where_there_is_one(rng):
    for known in (True, False):
        data = made_up(rng, with_truth=known)
        texts = [text.get_text() for text in sight_picture(data).legends[0].get_texts()]
        assert any("really see" in text for text in texts) == known
        draw(plot_sight(data, "anna").figure)


def test_sight_is_drawn_on_axes_that_are_given(data):
    figure = Picture()
    ax = figure.subplots()
    assert plot_sight(data, "anna", ax) is ax
    assert figure.axes == [ax]


@pytest.mark.parametrize("number", [1, 3, 5, 9])
def test_any_number_of_people(rng, number, monkeypatch):
    monkeypatch.setattr(road, "MOST_PEOPLE", 6)
    # Ids are text, not formulas.
    data = made_up(rng, [f"${n}$_^" for n in range(number)])
    figure = sight_picture(data)
    shown = min(number, 6)
    assert sum(bool(ax.images) for ax in figure.axes) == shown
    assert ("first 6 of 9" in figure.get_suptitle()) == (number == 9)
    if number < 9:
        draw(figure)


def test_human_models_without_thresholds_have_no_road(data):
    assert has_sight(data)
    assert not has_sight(az.InferenceData(posterior=data.posterior.drop_vars(SITES[1])))


def test_people_whom_the_model_does_not_explain_are_marked(data):
    assert [ax.get_title("left") for ax in sight_picture(data).axes[:2]] == ["anna", "ben"]
    verdicts = xr.Dataset({"verdict": ("person", ["suspect", "ok"])}, {"person": list(PEOPLE)})
    data.add_groups({"model_check": verdicts})
    titles = [ax.get_title("left") for ax in sight_picture(data).axes[:2]]
    assert titles == ["anna (suspect)", "ben"]
    labels = {text.get_text() for text in samples_picture(data).findobj(Text)}
    assert {"anna\n(suspect)", "ben"} <= labels
