"""Figures of studies: curves by rounds, their levels, and bars of messages."""

import numpy as np
import pytest

from mirror_ppl.evaluation.assistance import REFERENCES
from mirror_ppl.evaluation.learners import LEARNERS
from mirror_ppl.evaluation.study_report import REPORTS
from mirror_ppl.evaluation.study_summary import (
    Interval,
    ModelResult,
    Place,
    Share,
    means_table,
    shares_table,
)
from mirror_ppl.plots.reading import BLACK
from mirror_ppl.plots.study import STYLES, plot_curves, plot_relevance


def test_every_model_has_a_look_of_its_own():
    models = {*LEARNERS, "mirror-kl", *REFERENCES}
    assert models == set(STYLES)
    assert len({STYLES[name] for name in LEARNERS}) == len(LEARNERS)


def result(model, rounds, mean, place=Place("driving", "fog", "paper")):  # noqa: B008
    return ModelResult(place, model, rounds, Interval(mean, mean - 0.1, mean + 0.1), 3, None)


def test_relevance_has_a_panel_for_each_place(monkeypatch):
    """Two settings of one domain: two tables, and two panels."""
    rows = [
        {"domain": "driving", "setting": setting, "population": "paper", "seed": 0}
        | {"person": "a", "model": "bc", "rounds": 20, "items_visual": 2, "items_verbal": 0}
        | {f"{n}_{m}": 1 for n in ("collision_course", "closing") for m in ("visual", "verbal")}
        for setting in ("clear", "fog")
    ]
    picture = REPORTS["relevance"](rows).picture
    assert [ax.get_title() for ax in picture.axes] == [
        "driving, clear, paper",
        "driving, fog, paper",
    ]
    assert [len(ax.patches) for ax in picture.axes] == [2, 2]


def test_five_places_are_in_two_rows_and_each_row_names_the_measure():
    places = [Place("driving", "fog", name) for name in "abcde"]
    results = [result("mirror", 1, 0.2, place) for place in places]
    axes = plot_curves(means_table(results), "NLL").axes
    assert [ax.get_title()[-1] for ax in axes] == list("abcde")
    rows = [ax.get_subplotspec().rowspan.start for ax in axes]
    assert rows == [0, 0, 0, 1, 1]
    assert [ax.get_ylabel() for ax in axes] == ["NLL", "", "", "NLL", ""]


def test_curves_by_ratio_are_numbered_as_they_are_read():
    results = [result("mirror", 1, 0.2), result("mirror", 20, 0.18), result("bc", 1, 1.1)]
    picture = plot_curves(means_table(results), "NLL", by_ratio=True)
    (ax,) = picture.axes
    assert ax.get_yscale() == "log"
    low, high = ax.get_ylim()
    shown = [tick for tick in ax.get_yticks() if low <= tick <= high]
    assert [round(tick, 2) for tick in shown if tick > 0.19] == [0.2, 0.3, 0.4, 0.6, 0.8, 1.0]
    picture.canvas.draw()
    assert {"0.2", "0.3", "1"} <= {label.get_text() for label in ax.get_yticklabels()}


def test_curves_have_a_panel_for_each_place_and_level_lines():
    clear = Place("driving", "clear", "paper")
    results = [result("mirror", 20, 0.1), result("mirror", 1, 0.3), result("none", 0, 0.5)]
    picture = plot_curves(
        means_table([*results, result("bc", 1, 0.4, clear)]), "NLL", {clear: 0.05}
    )
    fog, other = picture.axes
    curve, level = fog.lines
    assert list(curve.get_xdata()) == [1, 20] and list(curve.get_ydata()) == [0.3, 0.1]
    assert set(level.get_ydata()) == {0.5}
    assert [fog.get_title(), other.get_title()] == ["driving, fog, paper", "driving, clear, paper"]
    assert {line.get_label() for line in other.lines} == {"bc", "people's own entropy"}
    (legend,) = picture.legends
    assert [text.get_text() for text in legend.get_texts()] == [
        "mirror",
        "bc",
        "none",
        "people's own entropy",
    ]


def test_models_of_ones_own_are_called_by_file_and_class_unless_two_are_called_so():
    names = ["mirror", "a/mine.py:Mine", "b/mine.py:Mine", "b/other.py:Mine"]
    (ax,) = plot_curves(means_table([result(name, 1, 0.1) for name in names]), "NLL").axes
    labels = ["mirror", "a/mine.py:Mine", "b/mine.py:Mine", "other.py:Mine"]
    assert [line.get_label() for line in ax.lines] == labels
    assert len({line.get_linestyle() for line in ax.lines[1:]}) == len(names) - 1


def test_levels_that_would_flatten_the_curves_are_given_in_words():
    """Curves from .1 to .5 with their intervals: a level at 1.9 is drawn, one at -90 is not."""
    results = [result("mirror", 20, 0.2), result("bc", 1, 0.4)]
    results += [result("none", 0, 1.9), result("all", 0, -90.0)]
    (ax,) = plot_curves(means_table(results), "net return").axes
    assert {line.get_label() for line in ax.lines} == {"mirror", "bc", "none"}
    assert [text.get_text() for text in ax.texts] == ["all: -90.0, off the scale"]
    assert ax.get_ylim()[0] > -1


def test_bars_are_of_the_most_rounds_and_silence_is_named():
    place = Place("driving", "fog", "paper")
    shares = [
        Share(place, "mirror", 0, "all", 5, Interval(0.8, 0.7, 0.9)),
        Share(place, "mirror", 1, "all", 5, Interval(0.9, 0.8, 1.0)),
        Share(place, "mirror", 20, "all", 5, Interval(0.6, 0.5, 0.7)),
        Share(place, "none", 0, "all", 0, None),
    ]
    (ax,) = plot_relevance(shares_table(shares)).axes
    (bar,) = ax.patches
    assert bar.get_height() == pytest.approx(60)  # pyright: ignore[reportAttributeAccessIssue]
    assert [text.get_text() for text in ax.texts] == ["none: no messages"]


def note(figure):
    """What stands below all panels."""
    return " ".join(figure.get_supxlabel().split())


def test_bands_are_named_where_there_are_any():
    results = [result("mirror", 1, 0.2), result("mirror", 5, 0.3), result("none", 0, 0.1)]
    figure = plot_curves(means_table(results), "NLL")
    assert note(figure).startswith("Bands: 90% intervals of means over people.")
    # A band of a single number of rounds could not be seen, and is a line.
    single = [result("bc", 5, 0.4), result("sqil", 5, 0.4)]
    figure = plot_curves(means_table([*results, *single]), "NLL")
    assert note(figure).startswith("Bands and lines: 90% intervals of means over people.")
    _, first, second = figure.axes[0].collections
    np.testing.assert_allclose(first.get_segments(), [[[5, 0.3], [5, 0.5]]])
    (((place, _), _),) = second.get_segments()  # beside it
    assert 5 < place < 6
    nothing = Interval(0.2, float("nan"), float("nan"))  # of one person
    one = ModelResult(Place("driving", "fog", "paper"), "mirror", 1, nothing, 1, None)
    for results in ([one], [result("none", 0, 0.1)]):
        assert not note(plot_curves(means_table(results), "NLL"))


def test_models_that_learned_from_fewer_rounds_are_named():
    place, share = Place("driving", "fog", "paper"), Interval(0.6, 0.5, 0.7)
    shares = [
        Share(place, "mirror", 20, "all", 5, share),
        Share(place, "bc", 1, "all", 5, share),
        Share(place, "bc", 5, "all", 5, share),
    ]
    figure = plot_relevance(shares_table(shares))
    assert note(figure) == (
        "Lines: 90% intervals over people. Not drawn, as they learned from fewer rounds: bc (5)."
    )
    assert len(figure.axes[0].patches) == 1
    there = [*shares[1:], Share(Place("driving", "clear", "paper"), "mirror", 20, "all", 5, share)]
    figure = plot_relevance(shares_table([*there, shares[0]]))
    assert note(figure).endswith("fewer rounds: bc (5) in driving, fog, paper.")
    assert note(plot_relevance(shares_table(shares[:1]))) == "Lines: 90% intervals over people."


def test_intervals_are_seen_on_black_bars_and_modalities_are_no_models():
    place = Place("driving", "fog", "paper")
    shares = [
        Share(place, model, 0, name, 5, Interval(0.6, 0.5, 0.7))
        for model in ("oracle", "all")
        for name in ("all", "visual")
    ]
    (ax,) = plot_relevance(shares_table(shares)).axes
    assert [label.get_text() for label in ax.get_xticklabels()] == ["all modalities", "visual"]
    assert len(ax.lines) == 4
    for line in ax.lines:
        assert line.get_color() == BLACK
        (below, _) = line.get_path_effects()
        assert below._gc["foreground"] == "white" and below._gc["linewidth"] > line.get_linewidth()


def test_a_note_is_not_below_a_long_legend():
    results = [result(name, 1, 0.2) for name in [*LEARNERS][:17]]
    figure = plot_curves(means_table(results), "NLL")
    figure.canvas.draw()
    text, (legend,) = figure._supxlabel, figure.legends
    assert text.get_window_extent().x1 < legend.get_window_extent().x0
