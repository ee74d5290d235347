"""Figures of implants beside their prior, checked in numbers."""

import numpy as np
import pytest
from example_drivers import SITES, draw, made_up

from mirror_ppl.plots.implants import kernel_density, plot_implants, scalar_implants


@pytest.fixture
def data(rng):
    return made_up(rng)


def test_scalar_implants_are_those_with_one_number_a_person(data):
    assumes = {"assumes_clear", "assumes_closing"}
    assert set(scalar_implants(data)) == {*SITES, *assumes, "consistency", "lapse"}


def test_implants_are_drawn_beside_the_prior_with_the_truth_marked(data):
    figure = plot_implants(data, "anna")
    axes = {ax.get_title(): ax for ax in figure.axes}
    ax = axes["sight ahead, own lane"]
    # Posterior bars: 2 with three of four draws, 4 with one.
    shares = {
        label.get_text(): bar.get_height()
        for label, bar in zip(ax.get_xticklabels(), ax.containers[1], strict=True)
    }
    assert shares == {"0": 0, "1": 0, "2": 0.75, "3": 0, "4": 0.25, "6": 0, "all": 0}
    assert sum(bar.get_height() for bar in ax.containers[0]) == pytest.approx(1)
    # The truth, 2 cells, is the third of the possible values.
    assert ax.lines[-1].get_label() == "truth"
    assert ax.lines[-1].get_xdata() == [2]
    for what in ("assumes unseen cars absent", "assumes cars seen once come closer"):
        ax = axes[what]
        assert [label.get_text() for label in ax.get_xticklabels()] == ["no", "yes"]
    assert [bar.get_height() for bar in ax.containers[1]] == [0.25, 0.75]
    assert ax.lines[-1].get_xdata() == [1]  # the truth: yes
    ax = axes["consistency of choices"]
    assert ax.lines[-1].get_xdata() == [3]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "prior",
        "posterior",
        "truth",
    ]
    draw(figure)


def test_a_truth_beyond_all_draws_has_a_place_of_its_own(data):
    for group in ("posterior", "prior"):
        data[group]["sight_front_own"] = data[group]["sight_front_own"].clip(max=3)
    data["constant_data"]["truth_sight_front_own"][:] = 12
    figure = plot_implants(data, "anna")
    (ax,) = (ax for ax in figure.axes if ax.get_title() == "sight ahead, own lane")
    assert [label.get_text() for label in ax.get_xticklabels()] == ["0", "1", "2", "3", "all"]
    assert ax.lines[-1].get_xdata() == [4]
    assert [bar.get_height() for bar in ax.containers[1]] == [0, 0, 0.75, 0.25, 0]


def test_implants_of_other_models_are_drawn_too(data):
    for group in ("posterior", "prior"):
        shape = data[group]["lapse"].shape
        data[group]["delay"] = (data[group]["lapse"].dims, np.full(shape, 0.5))
        data[group]["count"] = (data[group]["lapse"].dims, np.arange(np.prod(shape)).reshape(shape))
    figure = plot_implants(data, "ben")
    assert {"delay", "count"} <= {ax.get_title() for ax in figure.axes}
    draw(figure)


def test_kernel_density_is_a_density_and_respects_bounds(rng):
    grid = np.linspace(0, 1, 2001)
    density = kernel_density(rng.beta(1, 30, 2000), grid, [0, 1])
    assert np.trapezoid(density, grid) == pytest.approx(1, abs=1e-3)
    # Beta(1, 30) has density 30 at 0; smoothing takes some off its steep fall.
    assert 20 < density[0] < 32
    grid = np.linspace(-6, 6, 2001)
    density = kernel_density(rng.normal(size=4000), grid, [])
    assert np.trapezoid(density, grid) == pytest.approx(1, abs=1e-3)
    assert density[1000] == pytest.approx(1 / np.sqrt(2 * np.pi), abs=0.03)
