"""Figures of rounds of driving and of predictive checks, checked in numbers."""

import numpy as np
import pytest
from example_drivers import B, T, draw, made_up

from mirror_ppl.domains.driving.road import sight_probability
from mirror_ppl.domains.driving.rounds import (
    calibration,
    lane_changes,
    plot_predictive_check,
    plot_round,
    switching,
)
from mirror_ppl.errors import DemonstrationsError


@pytest.fixture
def data(rng):
    return made_up(rng)


def test_round_shows_the_lanes_the_predictions_and_the_actions(data):
    figure = plot_round(data, "anna", 0)
    left, right, below = figure.axes[:3]
    seen = sight_probability(data, "anna").values
    # Actions stay, switch, switch, stay: left lane at times 0, 1, 3 and 4, right lane at 2.
    rows = [0, 0, 1, 0, 0]
    assert np.array_equal(left.images[0].get_array(), seen[rows].T)
    assert np.array_equal(right.images[0].get_array(), seen[[1 - row for row in rows]].T)

    def marks(ax, label):
        lines = [line for line in ax.lines if line.get_label() == label]
        return [np.transpose(line.get_data()).tolist() for line in lines]

    assert marks(left, "the person") == [[[0, 0], [1, 0], [3, 0], [4, 0]]]
    assert marks(right, "the person") == [[[2, 0]]]
    front, rear = marks(left, "other cars")
    assert front == [[0, 3], [1, 2], [2, 1], [3, 0], [4, -1]]
    assert rear == [[0, -2], [1, -1], [2, 0], [3, 1], [4, 2]]
    front, rear = marks(right, "other cars")
    assert front[0] == [0, 11]
    assert np.isnan(np.array(front)[1:, 1]).all()  # beyond the visible road
    assert np.isnan(np.array(rear)[:, 1]).all()
    expected = (data.posterior_predictive["action"].values[0, :, 0, 0] == 1).mean(0)
    assert [bar.get_height() for bar in below.containers[0]] == expected.tolist()
    assert below.lines[-1].get_ydata().tolist() == [0, 1, 1, 0]
    draw(figure)


def test_short_and_held_out_rounds(data):
    figure = plot_round(data, "anna", 1, held_out=True)
    assert "held-out" in figure.get_suptitle()
    below = figure.axes[2]
    predicted = data.predictions["action_probability"].values[0, :, 0, 1, :2, 1].mean(0)
    assert [bar.get_height() for bar in below.containers[0]] == pytest.approx(predicted.tolist())
    draw(figure)


def test_rounds_that_do_not_exist(rng, data):
    for number in (-1, 2):
        with pytest.raises(DemonstrationsError, match=rf"no round {number} of anna.* one of 2,"):
            plot_round(data, "anna", number)
    with pytest.raises(DemonstrationsError, match="held-out"):
        plot_round(made_up(rng, with_test=False), "anna", 0, held_out=True)


def test_lane_changes_leave_padding_out(data):
    observed = lane_changes(data, "observed_data").values
    assert np.array_equal(observed, [[2, 1, np.nan], [0, 4, 1]], equal_nan=True)
    predicted = lane_changes(data, "posterior_predictive")
    action = data.posterior_predictive["action"].values
    assert np.array_equal(predicted.sel(person="anna")[..., 1], action[:, :, 0, 1, :2].sum(-1))
    assert np.isnan(predicted.sel(person="anna")[..., 2]).all()


def test_calibration_counts_real_steps_by_predicted_probability(data):
    # All draws say: a switch at the first two steps of each round and at no other.
    values = np.zeros((1, 4, 2, B, T), int)
    values[..., :2] = 1
    data.posterior_predictive["action"].values[:] = values
    rates = calibration(data, "posterior_predictive")
    assert rates["steps"].tolist() == [8, 10]
    assert rates["predicted"].tolist() == [0, 1]
    assert rates["observed"].tolist() == [3 / 8, 5 / 10]
    assert (rates["low"] < rates["observed"]).all()
    assert (rates["observed"] < rates["high"]).all()


def test_predictive_check_draws(data):
    figure = plot_predictive_check(data)
    left = figure.axes[0]
    observed = [line for line in left.lines if line.get_label() == "observed"][0]
    assert observed.get_xdata().tolist() == [1.5, 5 / 3]
    assert switching(data, "ben").shape == (B, T)
    said = figure.get_supxlabel()
    assert "bars are 90% intervals" in said and "ticks their medians" in said
    assert "vertical lines their 90% intervals" in " ".join(said.split())
    draw(figure)
