"""Figures of recorded rounds of driving beside posterior predictions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from scipy.stats import beta

from mirror_ppl.domains.driving.cars import CAR_LANES
from mirror_ppl.domains.driving.knowledge import ROAD_END
from mirror_ppl.domains.driving.road import DARK_TO_LIGHT, DISTANCES, sight_probability
from mirror_ppl.domains.driving.world import SWITCH
from mirror_ppl.errors import DemonstrationsError
from mirror_ppl.plots.picture import Picture, label_of
from mirror_ppl.plots.reading import (
    BLUE,
    OBSERVED,
    POSTERIOR,
    PRIOR,
    PURPLE,
    SAMPLE,
    of_person,
    people,
    round_of,
)

if TYPE_CHECKING:
    import arviz as az

RANGES = (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0)
"""Bin edges of predicted probabilities."""
LANE_NAMES = ("left lane", "right lane")
LEVELS = (0.05, 0.5, 0.95)
"""Quantiles of drawn intervals: the median and the ends of 90%."""
EXPLANATION = (
    "Left: bars are 90% intervals of predictions, and ticks their medians. Right: points are the "
    "observed shares at steps of similar predicted probability,\nand vertical lines their 90% "
    "intervals; points of calibrated predictions lie near the dotted line."
)
"""What the marks of a predictive check mean."""


def plot_round(
    data: az.InferenceData, person: str, round: int, *, held_out: bool = False
) -> Picture:
    """Draw one round over time: the cars, what the person sees of them, and their actions.

    Each lane is drawn with distances upwards and time to the right, shaded as the road in
    :func:`mirror_ppl.domains.driving.road.plot_sight`. Below are the posterior predictive
    probability of switching lanes and the person's actions.

    Args:
        data: with the groups of :mod:`mirror_ppl.inference.results.export`.
        person: id of the person.
        round: number of the round, counted from 0.
        held_out: use the held-out rounds, not those of the fit.

    Raises:
        UnknownNameError: no person has that id.
        DemonstrationsError: the person has no such round.
    """
    if held_out and "predictions" not in data.groups():
        raise DemonstrationsError("there are no held-out rounds")
    group = "predictions_constant_data" if held_out else "constant_data"
    dimension = "test_round" if held_out else "round"
    recorded = round_of(of_person(data, group, person), dimension, round)
    action = recorded["observed_action"].values
    steps = int((action >= 0).sum())
    probability = switching(data, person, held_out=held_out).values[round, :steps]

    figure = Picture(figsize=(10, 8), layout="constrained")
    *lanes, below = figure.subplots(3, 1, sharex=True, height_ratios=(3, 3, 2))
    sight = sight_probability(data, person)
    for lane, ax in enumerate(lanes):
        _draw_lane(ax, lane, recorded, sight, steps)
    bar = figure.colorbar(ScalarMappable(Normalize(0, 1), DARK_TO_LIGHT), ax=lanes, aspect=30)
    bar.set_label("posterior probability that the person sees a car there")
    bar.set_ticks([0, 0.5, 1], labels=["0: unseen", ".5", "1: seen"])
    _draw_actions(below, action[:steps], probability)
    # Cars of both lanes look alike, so one label of each kind is enough.
    entries = {}
    for ax in (*lanes, below):
        entries |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    figure.legend(entries.values(), entries, loc="outside lower center", ncols=4, frameon=False)
    kind = "held-out round" if held_out else "round"
    figure.suptitle(f"{label_of(person)}, {kind} {round}", fontsize=13, fontweight="bold")
    return figure


def switching(data: az.InferenceData, person: str, *, held_out: bool = False) -> xr.DataArray:
    """Return the posterior predictive probability of switching lanes, ``[B, T]``.

    Args:
        data: with ``posterior_predictive``, or ``predictions``.
        person: id of the person.
        held_out: use the held-out rounds, not those of the fit.

    Raises:
        UnknownNameError: no person has that id.
    """
    if held_out:
        predicted = of_person(data, "predictions", person)["action_probability"]
        return predicted.isel(action_name=SWITCH).mean(SAMPLE)
    return (of_person(data, "posterior_predictive", person)["action"] == SWITCH).mean(SAMPLE)


def lane_changes(data: az.InferenceData, group: str) -> xr.DataArray:
    """Count lane changes in each recorded round; NaN in padding.

    Args:
        data: with that group and ``observed_data``.
        group: ``"observed_data"``, ``"posterior_predictive"`` or ``"prior_predictive"``.

    Returns:
        Dimensions ``person`` and ``round``, and ``chain`` and ``draw`` of predictions.
    """
    real = data["observed_data"]["action"] >= 0
    changes = ((data[group]["action"] == SWITCH) & real).sum("step")
    return changes.where(real.any("step"))


def calibration(data: az.InferenceData, group: str) -> pd.DataFrame:
    """Compare frequencies of lane switches with predicted probabilities, by bin.

    Args:
        data: with that group and ``observed_data``.
        group: ``"posterior_predictive"`` or ``"prior_predictive"``.

    Returns:
        One row for each bin of ``RANGES`` that occurs: ``steps``, the number of steps;
        ``predicted``, their mean probability; ``observed``, the share of switches; ``low`` and
        ``high``, its 90% interval (Jeffreys).
    """
    action = data["observed_data"]["action"].values
    predicted = (data[group]["action"] == SWITCH).mean(SAMPLE).values[action >= 0]
    did = action[action >= 0] == SWITCH
    rows = []
    which = np.digitize(predicted, RANGES[1:-1])
    for index in np.unique(which):
        inside = which == index
        steps, switches = int(inside.sum()), int(did[inside].sum())
        low, high = beta(switches + 0.5, steps - switches + 0.5).ppf([LEVELS[0], LEVELS[-1]])
        rows.append((steps, predicted[inside].mean(), switches / steps, low, high))
    return pd.DataFrame(rows, columns=["steps", "predicted", "observed", "low", "high"])


def plot_predictive_check(data: az.InferenceData) -> Picture:
    """Draw observed and predicted lane changes.

    Left, for each person: lane changes per round, averaged over the rounds of the fit; medians and
    90% intervals of prior and posterior predictions. Right: share of steps with a switch, by
    predicted probability.

    Each action is predicted from the recorded history before it. So averages and probabilities can
    be compared with observed actions, but not the number of changes within a round: a person who
    has changed lanes once rarely does so again, while predictions start anew at each step.

    Args:
        data: with ``observed_data``, ``posterior_predictive`` and ``prior_predictive``.
    """
    everybody = people(data)
    figure = Picture(figsize=(11, max(4, 0.3 * len(everybody) + 2)), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    place = np.arange(len(everybody))
    for label, group, colour, shift in (
        ("prior predictive", "prior_predictive", PRIOR, -0.18),
        ("posterior predictive", "posterior_predictive", POSTERIOR, 0.18),
    ):
        averages = lane_changes(data, group).mean("round")
        low, median, high = averages.quantile(LEVELS, SAMPLE).values
        left.hlines(place + shift, low, high, color=colour, lw=5, alpha=0.55, label=label)
        left.plot(median, place + shift, "|", color=colour, ms=9, mew=2.5)
        rates = calibration(data, group)
        right.vlines(rates["predicted"], rates["low"], rates["high"], color=colour, lw=2)
        right.plot(rates["predicted"], rates["observed"], "o-", color=colour, ms=6, lw=0.8)
    observed = lane_changes(data, "observed_data").mean("round")
    left.plot(observed, place, "o", color=OBSERVED, ms=6, label="observed")
    left.set_yticks(place, [label_of(person) for person in everybody])
    left.invert_yaxis()
    left.set_xlabel("lane changes a round, averaged over a person's rounds")
    right.plot([0, 1], [0, 1], color=OBSERVED, lw=1, ls=":", zorder=0)
    right.set_aspect("equal")
    right.set_xlabel("predicted probability of switching")
    right.set_ylabel("share of steps with a switch")
    for ax in (left, right):
        ax.spines[["top", "right"]].set_visible(False)
    figure.legend(
        *left.get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False
    )
    figure.supxlabel(EXPLANATION, x=0.01, ha="left", fontsize=9)
    return figure


def _draw_lane(ax: Axes, lane: int, recorded: xr.Dataset, sight: xr.DataArray, steps: int) -> None:
    """Draw one lane over time: what is seen of it, the cars, and the person while in it."""
    own = recorded["ego"].values[: steps + 1, 0].astype(int) == lane
    shade = np.where(own[:, None], sight.sel(lane="own").values, sight.sel(lane="other").values)
    end = ROAD_END + 0.5
    ax.imshow(
        shade.T,
        cmap=DARK_TO_LIGHT,
        vmin=0,
        vmax=1,
        origin="lower",
        extent=(-0.5, steps + 0.5, DISTANCES[0] - 0.5, DISTANCES[-1] + 0.5),
        aspect="auto",
    )
    times = np.arange(steps + 1)
    ahead = recorded["visual"].sel(visual_feature="distance_ahead").values[: steps + 1]
    for car, car_lane in enumerate(CAR_LANES):
        if car_lane != lane:
            continue
        where = np.where(np.abs(ahead[:, car]) < ROAD_END, ahead[:, car], np.nan)
        ax.plot(times, where, color=PURPLE, lw=1, alpha=0.8)
        ax.plot(times, where, "s", color=PURPLE, ms=8, mec="white", label="other cars")
    ax.plot(
        times[own], np.zeros(own.sum()), "s", color=BLUE, ms=11, mec="white", label="the person"
    )
    ax.set_ylim(-end, end)
    ax.set_yticks(range(-ROAD_END, ROAD_END + 1, 4))
    ax.set_ylabel(f"{LANE_NAMES[lane]}\ncells ahead")


def _draw_actions(ax: Axes, action: np.ndarray, probability: np.ndarray) -> None:
    """Draw the probability of switching at each step, and the person's actions."""
    times = np.arange(len(action))
    ax.bar(
        times,
        probability,
        0.8,
        color=POSTERIOR,
        alpha=0.6,
        label="posterior predictive probability",
    )
    did = action == SWITCH
    ax.plot(times, did.astype(float), "o", color=OBSERVED, ms=7, label="what they did")
    ax.set_ylim(-0.12, 1.12)
    ax.set_yticks([0, 0.5, 1], ["0: stay", ".5", "1: switch"])
    ax.set_ylabel("probability\nof switching")
    ax.set_xlabel("step")
    ax.set_xticks(np.arange(len(action) + 1))
    ax.spines[["top", "right"]].set_visible(False)
