"""`python -m mirror_ppl.compare`: what it prints, writes and draws, also of real fits."""

import json

import matplotlib.colors as colours
import pytest
from example_posteriors import (
    PEOPLE,
    REAL,
    compared,
    standard_error,
    three_values,
    write,
    write_three,
)
from matplotlib.container import ErrorbarContainer
from running import command

from mirror_ppl.commands import compare, fit
from mirror_ppl.data import asset_path, load_demonstrations, save_demonstrations
from mirror_ppl.plots.comparison import plot_comparison
from mirror_ppl.plots.reading import BLUE, GREY


@pytest.fixture
def values(rng):
    return three_values(rng)


@pytest.fixture
def paths(tmp_path, values):
    return write_three(tmp_path, values)


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


# --- real fits --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fits(tmp_path_factory):
    """Two small fits of the same recordings, with different seeds."""
    folder = tmp_path_factory.mktemp("fits")
    every = load_demonstrations(asset_path("driving_fog_paper.nc"))
    some = every.select_people([0, 1]).select_rounds(range(4))
    save_demonstrations(folder / "some.nc", some)
    for seed in (0, 1):
        options = fit.Options(
            folder / "some.nc",
            out=folder / f"{seed}",
            human_model="one-radius",  # which is quick
            draws=12,
            explore=0,
        )
        fit.main(fit.Options(**{**vars(options), "seed": seed}))
    return folder


@pytest.mark.parametrize("by", ["loo", "heldout"])
def test_folders_of_fits_are_compared(fits, tmp_path, capsys, by):
    capsys.readouterr()
    outputs = ("--json", tmp_path / "a.json", "--figure", tmp_path / "a.png")
    assert command(compare, fits / "0", fits / "1", "--by", by, *outputs) == 0
    out, err = capsys.readouterr()
    assert err == "" and all(len(line) <= 80 for line in out.splitlines() if "a." not in line)
    assert "one-radius 0" in out and "one-radius 1" in out
    results = json.loads((tmp_path / "a.json").read_text())
    models = {entry["label"]: entry for entry in results["models"]}
    assert len(models) == 2
    if by == "loo":
        return
    for seed in (0, 1):
        summary = json.loads((fits / f"{seed}" / "summary.json").read_text())
        expected = [-person["test"]["nll"] for person in summary["people"]]
        people = models[f"one-radius {seed}"]["people"]
        assert [person["log_density"] for person in people] == pytest.approx(expected, abs=1e-5)
