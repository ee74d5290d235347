"""`python -m mirror_ppl.compare`: exact scores of tiny posteriors, its outputs, and refusals."""

import json
import shutil
import warnings
from itertools import permutations
from pathlib import Path

import matplotlib.colors as colours
import numpy as np
import pytest
import xarray as xr
from matplotlib.container import ErrorbarContainer
from running import command

from mirror_ppl.arviz import az
from mirror_ppl.commands import compare, fit
from mirror_ppl.data import asset_path, load_demonstrations, save_demonstrations
from mirror_ppl.errors import OptionError, PosteriorError
from mirror_ppl.evaluation.comparison import compare_fits, label_models, read_fit
from mirror_ppl.inference.results.export import save_inference_data
from mirror_ppl.plots.comparison import plot_comparison
from mirror_ppl.plots.reading import BLUE, GREY

# Of four people: three rounds, two of them shorter; one round; none; three.
LENGTHS = np.array([[4, 2, 3], [4, 0, 0], [0, 0, 0], [1, 4, 4]])
PEOPLE = ("ana", "ben", "cem", "dia")
REAL = LENGTHS > 0
ACTIONS = np.where(np.arange(4) < LENGTHS[..., None], np.arange(4) % 2, -1).astype("int8")
SOURCE = {"recorded_seed": "0", "recorded_population": "paper", "recorded_command": "simulate " * 9}


def group(attributes, **variables):
    dataset = xr.Dataset({name: (dims.split(), value) for name, (dims, value) in variables.items()})
    return dataset.assign_coords(person=list(PEOPLE)).assign_attrs(attributes)


def write(
    path,
    likelihood=None,
    right=None,
    actions=ACTIONS,
    held_out=ACTIONS,
    ego=0.0,
    chains=1,
    **changes,
):
    """A file as a fit writes it.

    Args:
        likelihood: log-likelihoods ``[S, P, B]``, or ``[P, B]`` on which all of 30 draws agree.
        right: probabilities ``[S, P, B, T]`` of what was done in held-out rounds.
        actions, held_out: what was done ``[P, B, T]``.
        ego: what there was to see.
        changes: other attributes than usual; ``None`` for none.
    """
    attributes = {"domain": "driving", "setting": "fog", "human_model": "HumanModel", **SOURCE}
    attributes |= changes
    attributes = {name: value for name, value in attributes.items() if value is not None}
    learned, out = "person round step", "person test_round step"
    shape = actions.shape
    groups = {
        "posterior": group(attributes, lapse=("chain draw person", np.zeros((1, 2, 4)))),
        "observed_data": group(attributes, action=(learned, actions)),
        "constant_data": group(
            attributes,
            ego=(learned, np.where(actions < 0, np.nan, ego)),
            truth_lapse=("person", np.full(4, len(changes))),
            action_entropy=(learned, np.full(shape, len(changes))),
        ),
    }
    if likelihood is not None:
        likelihood = np.asarray(likelihood, dtype=float)
        if likelihood.ndim == 2:
            likelihood = np.tile(likelihood, (30, 1, 1))
        dims = "chain draw person round"
        groups["log_likelihood"] = group(
            attributes, action=(dims, likelihood.reshape(chains, -1, *likelihood.shape[1:]))
        )
    if right is not None:
        # What is done at even steps is action 0, at odd ones 1; the rest is that of the other.
        flipped = np.arange(right.shape[-1]) % 2
        each = np.stack([np.where(flipped, 1 - right, right), np.where(flipped, right, 1 - right)])
        dims = f"chain draw {out} action_name"
        each = np.moveaxis(each, 0, -1)[None]
        groups["predictions"] = group(attributes, action_probability=(dims, each))
        groups["predictions_constant_data"] = group(attributes, observed_action=(out, held_out))
    path.parent.mkdir(parents=True, exist_ok=True)
    save_inference_data(az.InferenceData(**groups), path)
    return path


def compared(*paths, by="loo", labels=None):
    files = [read_fit(path, by) for path in paths]
    return compare_fits(files, labels or [path.stem for path in paths], by)


@pytest.fixture
def values(rng):
    """Log-likelihoods ``[M, P, B]`` of three models; the first is the best, the last the worst."""
    return -rng.uniform(0.1, 2.0, (3, 4, 3)) - np.array([0, 3, 6])[:, None, None]


@pytest.fixture
def paths(tmp_path, values):
    names = ("a", "b", "c")
    return [write(tmp_path / f"{n}.nc", value) for n, value in zip(names, values, strict=True)]


def standard_error(numbers):
    return np.sqrt(len(numbers)) * np.std(numbers)


# --- leave-one-out ----------------------------------------------------------------------------


def test_where_all_draws_agree_leave_one_out_is_what_they_say(paths, values):
    comparison = compared(*paths)
    assert [model.label for model in comparison.models] == ["a", "b", "c"]
    for model, value in zip(comparison.models, values, strict=True):
        total = model.total
        assert (total.rounds, total.actions, total.doubtful) == (7, 22, 0)
        assert total.log_density == pytest.approx(value[REAL].sum() / 22)
        assert total.log_density_se == pytest.approx(standard_error(value[REAL]) / 22)


def test_differences_are_paired_over_rounds(paths, values):
    comparison = compared(*paths)
    for model, value in zip(comparison.models, values, strict=True):
        behind = value - values[0]
        assert model.total.difference == pytest.approx(behind[REAL].sum() / 22)
        error = standard_error(behind[REAL]) / 22
        assert model.total.difference_se == pytest.approx(error)
        for person, score in enumerate(model.people):
            own = REAL[person]
            if not own.any():
                assert score is None
                continue
            number = LENGTHS[person].sum()
            assert (score.rounds, score.actions) == (own.sum(), number)
            assert score.log_density == pytest.approx(value[person, own].sum() / number)
            assert score.difference == pytest.approx(behind[person, own].sum() / number)
            # Of a single round nobody knows how much another would differ.
            alone = own.sum() == 1
            error = None if alone else standard_error(behind[person, own]) / number
            assert score.difference_se == (None if alone else pytest.approx(error))
    assert comparison.models[0].total.difference == comparison.models[0].total.difference_se == 0


def test_the_best_of_all_is_not_the_best_for_everybody(tmp_path):
    ana = np.arange(4)[:, None] + np.zeros(3) == 0
    first = write(tmp_path / "a.nc", np.where(ana, -6.0, -1.0))
    second = write(tmp_path / "b.nc", np.where(ana, -4.0, -7.0))
    best, behind = compared(first, second).models
    assert best.label == "a"
    # Three rounds with 9 actions, and one with 4.
    assert behind.people[0].difference == pytest.approx(2 * 3 / 9)
    assert behind.people[1].difference == pytest.approx(-6 / 4)


def test_draws_are_weighted_by_how_little_they_expected_a_round(tmp_path, rng):
    # Of eight draws no tail can be smoothed: what is left is the harmonic mean.
    likelihood = -rng.uniform(0.1, 3.0, (8, 4, 3))
    other = likelihood - 1
    comparison = compared(write(tmp_path / "a.nc", likelihood), write(tmp_path / "b.nc", other))
    expected = -np.log(np.exp(-likelihood).mean(0))
    assert comparison.models[0].total.log_density == pytest.approx(expected[REAL].sum() / 22)
    assert comparison.models[1].total.difference == pytest.approx(-7 / 22)
    assert comparison.models[0].total.doubtful == 7


def test_it_agrees_with_arviz(tmp_path, rng):
    likelihood = rng.normal(-2, 0.5, (2, 400, 4, 3)) - rng.uniform(0, 1, (2, 1, 4, 3))
    paths = [write(tmp_path / f"{model}.nc", likelihood[model]) for model in range(2)]
    comparison = compared(*paths)
    data = {
        str(model): az.from_dict(
            posterior={"lapse": np.zeros((1, 400))},
            log_likelihood={"action": likelihood[model][:, REAL][None]},
        )
        for model in range(2)
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        table = az.compare(data)
    assert [model.label for model in comparison.models] == list(table.index)
    for model in comparison.models:
        row, total = table.loc[model.label], model.total
        scores = (total.log_density, total.log_density_se, -total.difference, total.difference_se)
        expected = row[["elpd_loo", "se", "elpd_diff", "dse"]].to_numpy(float) / 22
        assert scores == pytest.approx(expected)
        assert model.weight == pytest.approx(row["weight"], abs=1e-6)
        assert model.good_k == pytest.approx(1 - 1 / np.log10(400))


def test_rounds_that_depend_on_few_draws_are_doubtful(tmp_path):
    # Draws at the quantiles of what is told, so that nothing depends on chance.
    level = (np.arange(200) + 0.5) / 200
    tail = np.log(level)  # weights of exponent k have a Pareto tail of shape k
    likelihood = np.full((200, 4, 3), -1.0)
    likelihood[:] += 0.2 * tail[:, None, None]
    likelihood[:, 0, 1] = 1.5 * tail
    likelihood[:, 3, :2] = 1.2 * tail[:, None]
    good = write(tmp_path / "good.nc", np.full((200, 4, 3), -0.9) + 0.2 * tail[:, None, None])
    one, other = compared(good, write(tmp_path / "bad.nc", likelihood)).models
    assert (one.label, one.total.doubtful) == ("good", 0)
    assert (other.label, other.total.doubtful) == ("bad", 3)
    doubtful = [None if score is None else score.doubtful for score in other.people]
    assert doubtful == [1, 0, None, 2]
    assert one.good_k == pytest.approx(1 - 1 / np.log10(200))


def test_padding_does_not_count(tmp_path, paths, values, rng):
    padded = np.where(REAL, values, np.nan)
    padded[1][~REAL] = rng.uniform(-9, 9, (~REAL).sum())
    others = [write(tmp_path / "x" / f"{path.name}", padded[m]) for m, path in enumerate(paths)]
    one, other = compared(*paths), compared(*others)
    assert [model.total for model in one.models] == [model.total for model in other.models]
    assert [model.people for model in one.models] == [model.people for model in other.models]


def test_the_order_of_the_arguments_makes_no_difference(paths):
    expected = compared(*paths)
    for some in permutations(paths):
        assert compared(*some) == expected


def test_equal_models_stand_in_the_order_of_their_names(tmp_path, values):
    same = [write(tmp_path / f"{name}.nc", values[0]) for name in "ab"]
    assert compared(*same) == compared(*reversed(same))


@pytest.mark.parametrize("by", ["loo", "heldout"])
def test_a_model_is_not_better_than_itself(tmp_path, rng, by):
    right = rng.uniform(0.2, 0.9, (20, 4, 3, 4))
    path = write(tmp_path / "a.nc", -rng.uniform(0.1, 2, (20, 4, 3)), right)
    one, other = compared(path, path, by=by, labels=["once", "again"]).models
    assert (one.label, other.label) == ("again", "once")
    assert (other.total.difference, other.total.difference_se) == (0, 0)
    assert one.total == other.total
    assert (one.weight, other.weight) == pytest.approx((0.5, 0.5))


# --- held-out rounds --------------------------------------------------------------------------


def test_held_out_actions_are_predicted_by_the_average_of_draws(tmp_path, rng):
    right = rng.uniform(0.05, 0.95, (2, 5, 4, 3, 4))
    right[1] *= 0.5
    paths = [write(tmp_path / f"{model}.nc", right=right[model]) for model in range(2)]
    comparison = compared(*paths, by="heldout")
    steps = ACTIONS >= 0
    rounds = np.where(steps, np.log(right.mean(1)), 0).sum(-1)[:, REAL]
    assert [model.label for model in comparison.models] == ["0", "1"]
    for model, value in zip(comparison.models, rounds, strict=True):
        assert model.total.log_density == pytest.approx(value.sum() / 22)
        assert model.total.difference == pytest.approx((value - rounds[0]).sum() / 22)
        error = standard_error(value - rounds[0]) / 22
        assert model.total.difference_se == pytest.approx(error)
        assert (model.total.doubtful, model.good_k) == (None, None)
    assert comparison.models[1].people[2] is None


def test_chains_are_read_one_after_the_other(tmp_path, rng):
    likelihood = -rng.uniform(0.1, 2, (30, 4, 3))
    paths = [write(tmp_path / f"{n}.nc", likelihood, chains=n) for n in (1, 3)]
    one, other = compared(*paths).models
    assert one.total == other.total


# --- weights ----------------------------------------------------------------------------------


@pytest.mark.parametrize("shift", [0.0, -2000.0])
def test_weights_are_those_of_the_best_mixture(tmp_path, shift):
    # Probabilities .9 and .1 the one way in five rounds, the other way in two; the best weight w
    # solves 5 (.9 - .8 w) = 2 (.1 + .8 w).
    mostly = np.where(np.arange(7) < 5, 0.9, 0.1)
    likelihood = np.zeros((2, 4, 3))
    likelihood[0][REAL], likelihood[1][REAL] = np.log(mostly), np.log(1 - mostly)
    # However long rounds are, and however small so their probability.
    paths = [write(tmp_path / f"{m}.nc", likelihood[m] + shift) for m in range(2)]
    one, other = compared(*paths).models
    assert one.label == "0"
    expected = (5 * 0.9 - 2 * 0.1) / (7 * 0.8)
    assert one.weight == pytest.approx(expected, abs=1e-3)
    assert one.weight + other.weight == pytest.approx(1)


def test_a_model_that_is_worse_in_every_round_has_no_weight(paths):
    weights = [model.weight for model in compared(*paths).models]
    assert weights == pytest.approx([1, 0, 0], abs=1e-6)
    assert all(0 <= weight <= 1 for weight in weights)


# --- names ------------------------------------------------------------------------------------


def labels_of(*files):
    return label_models([read_fit(path) for path in files])


def test_models_are_called_by_their_class_and_by_their_path_where_that_is_needed(tmp_path):
    def model(place, name="HumanModel"):
        return write(tmp_path / place, np.zeros((4, 3)), human_model=name)

    late = model("late/posterior.nc", "LatePerson")
    first, second = model("x/fog/posterior.nc"), model("x/clear/posterior.nc")
    third, plain = model("y/fog/posterior.nc"), model("y/some.nc")
    unknown = model("z/posterior.nc", None)
    assert labels_of(late, first) == ("LatePerson", "mirror")
    assert labels_of(first, late, second) == ("mirror fog", "LatePerson", "mirror clear")
    assert labels_of(first, third, plain) == (
        "mirror x/fog",
        "mirror y/fog",
        "mirror y/some.nc",
    )
    # A folder stands for the file in it.
    assert labels_of(first.parent, second.parent) == ("mirror fog", "mirror clear")
    assert labels_of(first, late, first) == ("mirror (1)", "LatePerson", "mirror (2)")
    assert labels_of(first, second, first)[::2] == ("mirror fog (1)", "mirror fog (2)")
    assert labels_of(late, unknown) == ("LatePerson", "unknown")


# --- what is printed and written --------------------------------------------------------------


def test_the_table_shows_the_numbers(paths, values, capsys):
    assert command(compare, paths[2], paths[0], "--labels", "slow", "fast") == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "driving, fog: leave-one-out, 7 rounds of 4 people" in out
    rows = {line.split()[1]: line.split() for line in out.splitlines() if line[1:2].isdigit()}
    behind = (values[2] - values[0])[REAL]
    assert list(rows) == ["fast", "slow"]
    log_density = [f"{value[REAL].sum() / 22:.4f}" for value in values]
    assert rows["fast"] == ["1", "fast", log_density[0], "-", "0", "of", "7", "1.00"]
    numbers = [f"{behind.sum() / 22:.4f}", f"±{standard_error(behind) / 22:.4f}"]
    assert rows["slow"] == ["2", "slow", log_density[2], *numbers, "0", "of", "7", "0.00"]


def test_the_table_of_held_out_rounds_doubts_nothing(tmp_path, rng, capsys):
    right = rng.uniform(0.2, 0.9, (2, 5, 4, 3, 4))
    paths = [write(tmp_path / f"{m}.nc", right=right[m]) for m in range(2)]
    assert command(compare, *paths, "--by", "heldout") == 0
    out = capsys.readouterr().out
    assert "driving, fog: 7 held-out rounds of 4 people" in out
    assert "doubtful" not in out


@pytest.mark.parametrize(
    "label", ["[bold]x[/]", "[/nothing]", "a model " * 30, "x" * 300, "模型$_"]
)
def test_names_of_any_kind_fit_in_80_columns(paths, capsys, label):
    assert command(compare, *paths, "--labels", label, "b", "c") == 0
    lines = capsys.readouterr().out.splitlines()
    assert all(len(line) <= 80 for line in lines)
    # However a name is broken into lines, nothing of it is lost or taken for markup.
    shown = "".join(line[3:].split("  ")[0] for line in lines[4:-4])
    assert label.replace(" ", "") in shown.replace(" ", "")


def test_results_as_data(paths, values, tmp_path):
    out = tmp_path / "new" / "a.json"
    assert command(compare, *paths, "--json", out) == 0
    results = json.loads(out.read_text(), parse_constant=pytest.fail)
    assert results["command"] == "python -m mirror_ppl.compare"
    assert (results["by"], results["unit"]) == ("loo", "nats an action")
    assert results["domain"] == "driving" and results["recorded_seed"] == "0"
    comparison = compared(*paths)
    for rank, (entry, model) in enumerate(zip(results["models"], comparison.models, strict=True)):
        assert entry["rank"] == rank + 1
        assert entry["posterior"] == str(paths[rank])
        assert (entry["human_model"], entry["label"][:6]) == ("mirror", "mirror")
        assert entry["difference"] == model.total.difference
        assert entry["doubtful"] == 0 and entry["good_k"] < 0.7
        assert [person["id"] for person in entry["people"]] == list(PEOPLE)
        assert entry["people"][2] == {"id": "cem", "rounds": 0}
        assert entry["people"][1]["difference_se"] is None
        assert entry["people"][3]["difference"] == model.people[3].difference
    assert [path.name for path in out.parent.iterdir()] == ["a.json"]


@pytest.mark.parametrize(
    ("suffix", "start"), [(".png", b"\x89PNG"), (".pdf", b"%PDF"), (".SVG", b"<?xml")]
)
def test_a_figure_is_written_in_the_format_of_its_name(paths, tmp_path, capsys, suffix, start):
    path = tmp_path / f"x{suffix}"
    assert command(compare, *paths[:2], "--figure", path) == 0
    assert path.read_bytes().startswith(start)
    out, err = capsys.readouterr()
    assert out.endswith(f"{path}: the differences\n") and err == ""


# --- the figure -------------------------------------------------------------------------------


def dots(ax):
    """Colour, marker, place and half the length of the bar of everything with an error bar."""
    found = []
    for part in ax.containers:
        assert isinstance(part, ErrorbarContainer)
        line, _, bars = part.lines
        reach = None
        if bars:
            (segment,) = bars[0].get_segments()
            assert segment[:, 0].mean() == pytest.approx(line.get_xdata()[0])
            reach = (segment[1, 0] - segment[0, 0]) / 2
        x, y = line.get_xdata()[0], line.get_ydata()[0]
        found.append((colours.to_hex(line.get_color()).upper(), line.get_marker(), y, x, reach))
    return found


def test_the_figure_shows_every_difference(paths):
    comparison = compared(*paths)
    figure = plot_comparison(comparison.table(), comparison.by)
    (ax,) = figure.axes
    names = dict(zip(ax.get_yticks(), (t.get_text() for t in ax.get_yticklabels()), strict=True))
    assert list(names.values()) == ["a", "b", "c"]
    assert list(names) == sorted(names) and ax.yaxis_inverted()  # the best is on top
    tops = list(names)
    small = [text.get_text() for text in ax.get_yticklabels(minor=True)]
    assert small == [*PEOPLE, *PEOPLE]
    rows = dict(zip(ax.get_yticks(minor=True), small, strict=True))
    shown = sorted(dots(ax), key=lambda dot: dot[2])
    for number, model in enumerate(comparison.models[1:], 1):
        own, shown = shown[:4], shown[4:]
        colour, marker, y, x, reach = own[0]
        assert (colour, marker, y) == (BLUE, "D", tops[number])
        assert x == model.total.difference
        assert reach == pytest.approx(model.total.difference_se)
        people = [pair for pair in zip(PEOPLE, model.people, strict=True) if pair[1] is not None]
        for dot, (name, score) in zip(own[1:], people, strict=True):
            assert (dot[0], dot[1], dot[3]) == (GREY.upper(), "o", score.difference)
            assert rows[dot[2]] == name
            expected = score.difference_se
            assert dot[4] == (None if expected is None else pytest.approx(expected))
            assert number == 2 or dot[2] < tops[2]  # a model's people are above the next model
    assert not shown
    (square,) = [line for line in ax.lines if line.get_marker() == "s"]
    assert (square.get_xdata()[0], square.get_ydata()[0]) == (0, tops[0])
    assert [text.get_text() for text in ax.texts] == [
        *(f"{model.total.log_density:.4f}" for model in comparison.models),
        "log density",
    ]
    low, high = ax.get_ylim()
    assert all(high < dot[2] < low for dot in dots(ax))
    assert "leave-one-out, 7 rounds of 4 people" in figure.get_suptitle()
    assert "difference to the best in nats an action" in ax.get_xlabel()


def test_any_name_can_be_drawn_and_many_people_fit(tmp_path, paths, monkeypatch):
    label = "a $very_{long name [of] \\a " * 8
    figure = plot_comparison(compared(*paths[:2], labels=[label, r"$\nothing$"]).table())
    figure.savefig(tmp_path / "x.png")
    few = figure.get_size_inches()[1]
    monkeypatch.setattr("mirror_ppl.plots.comparison.MOST", 0.2)  # as if there were many people
    crowded = plot_comparison(compared(*paths[:2]).table())
    assert crowded.get_size_inches()[1] < few
    assert not len(crowded.axes[0].get_yticks(minor=True))


# --- what is refused --------------------------------------------------------------------------


def refused(capsys, folder, *args):
    """The one line of an error; nothing else is printed, and nothing written."""
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert command(compare, "--json", folder / "a.json", "--figure", folder / "a.png", *args) == 2
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("error: ") and err.count("\n") == 1
    return err.removeprefix("error: ").strip()


@pytest.mark.parametrize("number", [0, 1])
def test_one_model_is_no_comparison(number, paths, tmp_path, capsys):
    message = refused(capsys, tmp_path, *paths[:number])
    assert message == f"give at least two posteriors to compare, not {number}"


def test_a_posterior_given_twice_is_refused(paths, tmp_path, capsys):
    again = paths[0].parent / ".." / paths[0].parent.name / paths[0].name
    assert refused(capsys, tmp_path, paths[0], again) == f"{again} is given twice"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"by": "waic"}, '--by must be loo or heldout, not "waic"'),
        ({"labels": ("a",)}, "--labels must be as many as posteriors, 2, not 1"),
        ({"labels": ("a", "a ")}, "--labels must be different from each other and not empty"),
        ({"labels": ("a", "")}, "--labels must be different from each other and not empty"),
        ({"figure": Path("x/y.txt")}, "--figure must end in .png, .pdf, .svg, not y.txt"),
        ({"figure": Path("figure")}, "--figure must end in .png, .pdf, .svg, not figure"),
    ],
)
def test_options_that_make_no_sense(options, message):
    with pytest.raises(OptionError) as error:
        compare.Options((Path("a.nc"), Path("b.nc")), **options)
    assert str(error.value) == message


def test_a_file_that_is_not_there(paths, tmp_path, capsys):
    missing = tmp_path / "none.nc"
    message = refused(capsys, tmp_path, paths[0], missing)
    assert message == f"{missing}: there is no such file; python -m mirror_ppl.fit makes one"
    # A folder without a fit.
    message = refused(capsys, tmp_path, tmp_path, paths[0])
    assert message.startswith(f"{tmp_path / 'posterior.nc'}: there is no such file")


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        ("no netCDF", "is not a netCDF file"),
        ("empty", "is not a netCDF file"),
        ("cut off", "is truncated or damaged ("),
        ("recordings", "holds no posterior"),
    ],
)
def test_a_damaged_file(paths, tmp_path, capsys, damage, told):
    content = {
        "no netCDF": b"this is text\nof two lines",
        "empty": b"",
        "cut off": paths[1].read_bytes()[:2000],
        "recordings": Path(asset_path("driving_fog_paper.nc")).read_bytes(),
    }[damage]
    broken = tmp_path / "broken.nc"
    broken.write_bytes(content)
    message = refused(capsys, tmp_path, paths[0], broken)
    assert message.startswith(f"{broken}: {told}")


@pytest.mark.parametrize("by", ["loo", "heldout"])
def test_a_file_whose_parts_do_not_belong_together(tmp_path, by):
    right = np.full((5, 4, 3, 4), 0.5)
    path = write(tmp_path / "x.nc", np.zeros((5, 4, 2)), right, held_out=ACTIONS[:, :, :3])
    with pytest.raises(PosteriorError, match="cannot be read as a posterior"):
        read_fit(path, by)


def test_a_file_without_what_is_measured(paths, tmp_path, capsys):
    right = np.full((5, 4, 3, 4), 0.5)
    without = write(tmp_path / "x.nc", right=right)
    assert refused(capsys, tmp_path, paths[0], without) == (
        f"{without}: has no log-likelihoods of the rounds that were learned from "
        "(group log_likelihood)"
    )
    message = f"{paths[0]}: has no held-out rounds; leave some out of the fit (--train-rounds)"
    assert refused(capsys, tmp_path, without, paths[0], "--by", "heldout") == message
    # Nor if all that was held out is padding.
    padding = write(tmp_path / "y.nc", right=right, held_out=np.full_like(ACTIONS, -1))
    with pytest.raises(PosteriorError, match="y.nc: has no held-out rounds"):
        read_fit(padding, "heldout")


def test_no_round_is_left_out_where_decisions_count_less_than_once(tmp_path, values):
    path = write(tmp_path / "x.nc", values, np.full((2, 4, 3, 4), 0.5), likelihood_power=0.25)
    with pytest.raises(PosteriorError, match=r"x\.nc: each decision counts 0\.25 times in it"):
        read_fit(path)
    assert len(read_fit(path, "heldout").draws) == 2


@pytest.mark.parametrize("number", [0, 1])
def test_too_few_draws(tmp_path, number):
    right = np.full((number, 4, 3, 4), 0.5)
    path = write(tmp_path / "x.nc", np.zeros((number, 4, 3)), right)
    with pytest.raises(PosteriorError) as error:
        read_fit(path)
    assert str(error.value) == f"{path}: holds {number} draws, expected 2 or more"
    if number:
        assert len(read_fit(path, "heldout").draws) == 1
    else:
        with pytest.raises(PosteriorError, match="holds 0 draws, expected 1 or more"):
            read_fit(path, "heldout")


SHORTER = ACTIONS[:, :2]
OTHERWISE = np.where((ACTIONS >= 0) & (np.arange(4) == 0), 1, ACTIONS).astype("int8")


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"recorded_seed": "7"}, "recorded_seed is 7, expected 0"),
        ({"recorded_seed": None}, "recorded_seed is None, expected 0"),
        ({"recorded_by": "me"}, "recorded_by is me, expected None"),
        # What says it in a word is told before the command that says it in many.
        (
            {"recorded_command": "x", "recorded_population": "diverse"},
            "recorded_population is diverse, expected paper",
        ),
        ({"setting": "clear"}, "setting is clear, expected fog"),
        ({"domain": "kitchen"}, "domain is kitchen, expected driving"),
        ({"actions": OTHERWISE}, "observed_data action differs"),
        ({"ego": 1.0}, "constant_data ego differs"),
        (
            {"actions": SHORTER, "likelihood": np.zeros((4, 2))},
            "observed_data action has shape (4, 2, 4), expected (4, 3, 4); fit them with the same "
            "--train-rounds",
        ),
    ],
)
def test_other_recordings(paths, tmp_path, capsys, changes, told):
    other = write(tmp_path / "other.nc", **{"likelihood": np.zeros((4, 3))} | changes)
    message = refused(capsys, tmp_path, paths[0], paths[1], other)
    assert message == f"{other}: is of other recordings than {paths[0]}: {told}"


def test_other_people(paths, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(f"{__name__}.PEOPLE", ("ana", "ben", "dia", "cem"))
    other = write(tmp_path / "other.nc", np.zeros((4, 3)))
    assert refused(capsys, tmp_path, paths[0], other) == (
        f"{other}: is of other recordings than {paths[0]}: people are ana, ben, dia, cem, "
        "expected ana, ben, cem, dia"
    )


def test_other_held_out_rounds(tmp_path):
    right = np.full((5, 4, 3, 4), 0.5)
    one = write(tmp_path / "a.nc", np.zeros((4, 3)), right)
    other = write(tmp_path / "b.nc", np.zeros((4, 3)), right, held_out=OTHERWISE)
    with pytest.raises(PosteriorError, match="predictions_constant_data observed_action differs"):
        compared(one, other, by="heldout")
    # Which does not matter to those who do not use them.
    assert compared(one, other).models[1].total.difference == 0


def test_the_same_recordings_may_hold_more_about_simulated_people(paths, tmp_path):
    # `truth_` and the entropy differ with the number of other attributes.
    other = write(tmp_path / "other.nc", np.zeros((4, 3)), version="2", self_model="another")
    assert len(compared(paths[0], other).models) == 2


@pytest.mark.parametrize("value", [-np.inf, np.nan])
def test_what_was_done_has_to_have_a_probability(paths, tmp_path, capsys, value):
    likelihood = np.full((20, 4, 3), -1.0)
    likelihood[4, 3, 1] = value
    other = write(tmp_path / "other.nc", likelihood)
    message = f"{other}: has no finite log-probability of what dia did in round 1, counted from 0"
    assert refused(capsys, tmp_path, paths[0], other) == message
    right = np.full((20, 4, 3, 4), 0.5)
    one = write(tmp_path / "one.nc", right=right)
    right[0, 3, 1, 2] = 0
    compared(one, write(tmp_path / "two.nc", right=right), by="heldout")  # some draws expected it
    right[:, 3, 1, 2] = 0 if value < 0 else value
    with pytest.raises(PosteriorError, match="what dia did in round 1, counted from 0"):
        compared(one, write(tmp_path / "three.nc", right=right), by="heldout")


def test_an_input_is_not_overwritten(paths, tmp_path, capsys):
    folder = tmp_path / "fit"
    folder.mkdir()
    shutil.copy(paths[0], folder / "posterior.nc")
    link = tmp_path / "link.png"
    link.symlink_to(folder / "posterior.nc")
    for option, path in (("--json", folder / "posterior.nc"), ("--figure", link)):
        message = refused(capsys, tmp_path, folder, paths[1], option, path)
        assert message == f"cannot write {path}: it is what a posterior names"


def test_outputs_that_cannot_be_written(paths, tmp_path, capsys):
    both = tmp_path / "x.png"
    message = refused(capsys, tmp_path, *paths, "--json", both, "--figure", both)
    assert message == f"cannot write {both}: it is what --json names"
    # Where the picture cannot be written, the data is not written either.
    folder = tmp_path / "folder.png"
    folder.mkdir()
    message = refused(capsys, tmp_path, *paths, "--figure", folder)
    assert message == f"cannot write {folder}: it is not a regular file"
    below = paths[2] / "x.png"
    message = refused(capsys, tmp_path, *paths, "--json", tmp_path / "x.json", "--figure", below)
    assert message.startswith(f"cannot create the folder {paths[2]}: ")


# --- real fits --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fits(tmp_path_factory):
    """Two small fits of the same recordings, with different seeds."""
    folder = tmp_path_factory.mktemp("fits")
    every = load_demonstrations(asset_path("driving_fog_paper.nc"))
    some = every.select_people([0, 1]).select_rounds(range(4))
    save_demonstrations(folder / "some.nc", some)
    for seed in (0, 1):
        options = fit.Options(folder / "some.nc", out=folder / f"{seed}", draws=12, explore=0)
        fit.main(fit.Options(**{**vars(options), "seed": seed}))
    return folder


@pytest.mark.parametrize("by", ["loo", "heldout"])
def test_folders_of_fits_are_compared(fits, tmp_path, capsys, by):
    capsys.readouterr()
    outputs = ("--json", tmp_path / "a.json", "--figure", tmp_path / "a.png")
    assert command(compare, fits / "0", fits / "1", "--by", by, *outputs) == 0
    out, err = capsys.readouterr()
    assert err == "" and all(len(line) <= 80 for line in out.splitlines() if "a." not in line)
    assert "mirror 0" in out and "mirror 1" in out
    results = json.loads((tmp_path / "a.json").read_text())
    models = {entry["label"]: entry for entry in results["models"]}
    assert len(models) == 2
    if by == "loo":
        return
    for seed in (0, 1):
        summary = json.loads((fits / f"{seed}" / "summary.json").read_text())
        expected = [-person["test"]["nll"] for person in summary["people"]]
        people = models[f"mirror {seed}"]["people"]
        assert [person["log_density"] for person in people] == pytest.approx(expected, abs=1e-5)
