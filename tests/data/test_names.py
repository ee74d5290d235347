"""Ids of people, whatever is in them: fitted and shown as they are, or refused at load."""

from dataclasses import replace

import numpy as np
import pytest
from example_rounds import first_steps
from matplotlib.text import Text
from running import command

from mirror_ppl.commands import compare, fit
from mirror_ppl.data import asset_path, load_demonstrations, save_demonstrations, to_dataset
from mirror_ppl.errors import DemonstrationsError, UnknownNameError
from mirror_ppl.plots.picture import Picture, displayable, label_of

STRANGE = (
    r"$\foo$",
    "$x^$",
    "[/] :smile: [red]",
    "\N{HEBREW LETTER ALEF}\U0001f600\u5c71\u7530",
    "n" * 100,
)
REFUSED = ("two\nlines", "tab\t", "n" * 101, "", " ", "ana ", "\ud800")


@pytest.fixture(scope="module")
def some():
    """As many people, with two short rounds each."""
    every = load_demonstrations(asset_path("driving_fog_paper.nc"))
    every = every.select_people(range(len(STRANGE))).select_rounds(range(2))
    return replace(first_steps(every, 3), people=STRANGE)


def test_strange_ids_are_fitted_and_shown(some, tmp_path, capsys):
    save_demonstrations(tmp_path / "some.nc", some)
    assert load_demonstrations(tmp_path / "some.nc").people == STRANGE
    args = ("--demos", tmp_path / "some.nc", "--train-rounds", 1, "--draws", 5, "--explore", 0)
    fits = tmp_path / "a", tmp_path / "b"
    for out, model in zip(fits, ("mirror", "no-implants"), strict=True):
        assert command(fit, *args, "--out", out, "--human-model", model) == 0
    shown = capsys.readouterr().out
    for name in STRANGE[:-1]:
        assert f"│ {name} " in shown
    assert {path.name for path in fits[0].iterdir()} >= {
        "sight.png",
        "samples.png",
        "identifiability.png",
    }
    figure = tmp_path / "x.svg"
    assert command(compare, *fits, "--by", "heldout", "--figure", figure) == 0
    assert figure.read_text().startswith("<?xml")


@pytest.mark.parametrize("name", REFUSED)
def test_other_ids_are_refused_at_load(some, tmp_path, capsys, name):
    ids = [name, *STRANGE[1:]]
    dataset = to_dataset(some).assign_coords(person=("person", ids))
    try:
        dataset.to_netcdf(tmp_path / "some.nc", engine="h5netcdf")
    except (ValueError, UnicodeEncodeError):
        return  # such a name cannot get into a file
    assert command(fit, "--demos", tmp_path / "some.nc", "--out", tmp_path / "out") == 2
    line = capsys.readouterr().err
    assert line.startswith(f"error: {tmp_path / 'some.nc'}: ") and line.count("\n") == 1
    assert len(line) < 300 + len(str(tmp_path))
    assert not (tmp_path / "out").exists()


def test_ids_that_are_no_text_are_refused(some, tmp_path):
    for what, ids in {
        "the dtype float64": np.arange(5.0),
        "times": np.arange(5).astype("datetime64[ns]"),
    }.items():
        dataset = to_dataset(some).assign_coords(person=("person", ids))
        dataset.to_netcdf(tmp_path / "some.nc", engine="scipy")
        with pytest.raises(DemonstrationsError, match=f"person has ids of {what}, expected text"):
            load_demonstrations(tmp_path / "some.nc")


def test_pictures_show_text_as_it_is():
    figure = Picture()
    ax = figure.subplots()
    ax.set_title("$\\foo$ and \u5c71")
    ax.set_yticks([0, 1], [label_of(r"$x^$"), label_of("\u5c71")])
    ax.set_xticks([0], ["\u5c71"])  # not even by what makes labels
    figure.content()
    assert ax.get_title() == "$\\foo$ and [U+5C71]"
    assert [text.get_text() for text in ax.get_yticklabels()] == ["$x^$", "[U+5C71]"]
    assert not any(text.get_parse_math() for text in figure.findobj(Text))


def test_characters_without_a_glyph_are_shown_by_their_number():
    assert displayable("a\u05d0\n\u5c71") == "a\u05d0\n[U+5C71]"
    assert displayable("plain") == "plain"
    assert label_of("n" * 100) == "n" * 39 + "\N{HORIZONTAL ELLIPSIS}"


def test_names_that_differ_in_their_numbers_are_not_suggested():
    people = ["person-01", "person-02", "person-10"]
    assert "perhaps" not in str(UnknownNameError.of("person", "person-1", people))
    assert str(UnknownNameError.of("person", "persn-01", people)).endswith('meant "person-01"')
