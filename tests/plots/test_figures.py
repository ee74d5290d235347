"""Figures: what they show is checked in numbers, and that each draws, on a made-up posterior."""

import sys
from pathlib import Path

import arviz as az
import numpy as np
import pytest
import xarray as xr
from paths import ROOT

from mirror_ppl.domains.driving.road import (
    has_sight,
    outline,
    plot_sight,
    seen_of_draws,
    sight_picture,
    sight_probability,
    true_sight,
)
from mirror_ppl.domains.driving.rounds import (
    calibration,
    lane_changes,
    plot_predictive_check,
    plot_round,
    switching,
)
from mirror_ppl.domains.driving.samples import samples_picture
from mirror_ppl.errors import DemonstrationsError, OutputError, UnknownNameError
from mirror_ppl.plots.implants import kernel_density, plot_implants, scalar_implants
from mirror_ppl.plots.picture import Picture

PEOPLE = ["anna", "ben"]
SITES = ("sight_front_own", "sight_front_other", "sight_back_own", "sight_back_other")
# Four draws of each reach, of anna; ben sees everything.
REACH = {
    "sight_front_own": [2, 2, 2, 4],
    "sight_front_other": [0, 1, 1, 12],
    "sight_back_own": [0, 0, 0, 0],
    "sight_back_other": [0, 1, 2, 3],
}
TRUTH = {
    "sight_front_own": 2.0,
    "sight_front_other": 1.0,
    "sight_back_own": 0.0,
    "sight_back_other": 3.0,
}
B, T = 3, 4
# Two rounds of anna, the second of two steps; three of ben. 1 switches lanes, -1 is padding.
ACTION = np.array(
    [
        [[0, 1, 1, 0], [1, 0, -1, -1], [-1, -1, -1, -1]],
        [[0, 0, 0, 0], [1, 1, 1, 1], [0, 1, 0, 0]],
    ]
)


@pytest.fixture
def data(rng):
    return made_up(rng)


def made_up(rng, people=PEOPLE, with_truth=True, with_test=True):
    """The groups that figures read: 4 draws of each person, 3 rounds of 4 steps."""
    P = len(people)

    def implants(number):
        drawn = {
            "assumes_clear": rng.integers(0, 2, (1, number, P)),
            "assumes_closing": rng.integers(0, 2, (1, number, P)),
            "consistency": rng.lognormal(1, 0.5, (1, number, P)),
            "lapse": rng.beta(1, 30, (1, number, P)),
            "residual_in": rng.normal(size=(1, number, P, 2, 3)),
        }
        for site in SITES:
            drawn[site] = rng.choice([0.0, 1, 2, 3, 4, 6, 12], (1, number, P))
        return drawn

    posterior = implants(4)
    posterior["assumes_closing"][0, :, 0] = [0, 1, 1, 1]
    for site in SITES:
        posterior[site][0, :, 0] = REACH[site]
        posterior[site][0, :, 1:] = 12
    action = np.concatenate([ACTION, np.repeat(ACTION[1:], P - 2, 0)]) if P > 1 else ACTION[:1]
    lane = np.concatenate([np.zeros((P, B, 1)), np.maximum(action, 0).cumsum(-1) % 2], -1)
    start = np.array([3, 11, -2, -12])
    visual = np.zeros((P, B, T + 1, 4, 2))
    visual[..., 0] = np.clip(start + np.arange(T + 1)[:, None] * [-1, 1, 1, 0], -12, 12)
    visual[..., 1] = np.array([0, 1, 0, 1]) - lane[..., None]
    after_end = np.concatenate([np.zeros((P, B, 1), bool), action < 0], -1)
    lane[after_end] = np.nan
    visual[after_end] = np.nan
    constants = {"observed_action": action, "ego": lane[..., None], "visual": visual}
    if with_truth:
        for site in SITES:
            constants["truth_" + site] = np.array([TRUTH[site], *[np.nan] * (P - 1)])
        constants["truth_assumes_closing"] = np.ones(P)
        constants["truth_consistency"] = np.full(P, 3.0)
    rounds = ["person", "round", "step"]
    dims = {name: ["person"] for name in [*posterior, *constants]}
    dims |= {
        "residual_in": ["person", "input", "unit"],
        "action": rounds,
        "observed_action": rounds,
        "ego": ["person", "round", "time", "ego_feature"],
        "visual": ["person", "round", "time", "visual_item", "visual_feature"],
        "action_probability": ["person", "test_round", "step", "action_name"],
    }
    groups = {}
    if with_test:
        probability = rng.beta(1, 5, (1, 4, P, B, T))
        probability = np.stack([1 - probability, probability], -1)
        groups["predictions"] = {"action_probability": probability}
        groups["predictions_constant_data"] = dict(constants)
    result = az.from_dict(
        posterior=posterior,
        prior=implants(50),
        posterior_predictive={"action": rng.integers(0, 2, (1, 4, P, B, T))},
        prior_predictive={"action": rng.integers(0, 2, (1, 50, P, B, T))},
        observed_data={"action": action},
        constant_data=constants,
        coords={
            "person": list(people),
            "action_name": ["stay", "switch"],
            "visual_feature": ["distance_ahead", "lane_offset"],
        },
        dims=dims,
        **groups,
    )
    result.posterior.attrs |= {"domain": "driving", "setting": "fog"}
    if with_test:
        result.rename({"round": "test_round"}, groups="predictions_constant_data", inplace=True)
    return result


def draw(figure):
    """Bytes of the figure as PNG; warnings while drawing are errors."""
    content = figure._repr_png_()
    assert content.startswith(b"\x89PNG")
    return content


# --- what people see --------------------------------------------------------------------------


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


@pytest.mark.parametrize("number", [1, 3, 5, 45])
def test_any_number_of_people(rng, number):
    # Ids are text, not formulas.
    data = made_up(rng, [f"${n}$_^" for n in range(number)])
    figure = sight_picture(data)
    shown = min(number, 40)
    assert sum(bool(ax.images) for ax in figure.axes) == shown
    assert ("first 40 of 45" in figure.get_suptitle()) == (number == 45)
    if number < 45:
        draw(figure)


def test_saved_picture_is_a_png_and_leaves_nothing_behind(data, tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "matplotlib.pyplot", raising=False)
    path = tmp_path / "new" / "sight.png"
    sight_picture(data).save(path)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert [file.name for file in path.parent.iterdir()] == ["sight.png"]
    assert "matplotlib.pyplot" not in sys.modules
    Path(tmp_path / "file").touch()
    with pytest.raises(OutputError):
        sight_picture(data).save(tmp_path / "file" / "sight.png")


def test_human_models_without_thresholds_have_no_road(data):
    assert has_sight(data)
    assert not has_sight(az.InferenceData(posterior=data.posterior.drop_vars(SITES[1])))


# --- implants ---------------------------------------------------------------------------------


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
    for what in ("takes the unseen to be absent", "takes what they cannot judge to come closer"):
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


# --- rounds -----------------------------------------------------------------------------------


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
    draw(figure)


@pytest.mark.parametrize(
    "call",
    [
        sight_probability,
        plot_sight,
        plot_implants,
        switching,
        lambda data, person: plot_round(data, person, 0),
    ],
)
def test_unknown_person(data, call):
    with pytest.raises(UnknownNameError, match='unknown person "anne"; known: anna, ben; .*"anna"'):
        call(data, "anne")


def test_figures_import_nothing_of_what_calls_them():
    """They are functions of data: evaluation and commands call them."""
    for path in (ROOT / "mirror_ppl" / "plots").glob("*.py"):
        assert "from mirror_ppl.evaluation" not in path.read_text(), path
