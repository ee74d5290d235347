"""`python -m mirror_ppl.compare`: posteriors, options and outputs that are refused."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from example_posteriors import ACTIONS, compared, three_values, write, write_three
from running import command

from mirror_ppl.commands import compare
from mirror_ppl.data import asset_path
from mirror_ppl.errors import OptionError, PosteriorError
from mirror_ppl.evaluation.compared_files import read_fit
from mirror_ppl.models.dependencies import ADDS_TO_ROUNDS


@pytest.fixture
def values(rng):
    return three_values(rng)


@pytest.fixture
def paths(tmp_path, values):
    return write_three(tmp_path, values)


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
        ({"by": "waic"}, '--by must be loo, heldout or evidence, not "waic"'),
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


def test_no_round_is_left_out_of_models_with_terms_besides_actions(tmp_path, values):
    path = write(tmp_path / "x.nc", values, np.full((2, 4, 3, 4), 0.5), **{ADDS_TO_ROUNDS: 1})
    with pytest.raises(PosteriorError, match="has factors, observed sites, scales or masks, so"):
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
        ({"recorded_seed": "7", "ego": 1.0}, "seed is 7, expected 0"),
        ({"recorded_seed": None, "ego": 1.0}, "seed is none, expected 0"),
        ({"recorded_by": "me", "ego": 1.0}, "by is me, expected none"),
        # The short name comes before the long command.
        (
            {"recorded_command": "x", "recorded_population": "diverse", "ego": 1.0},
            "population is diverse, expected paper",
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


def test_the_same_rounds_may_have_other_notes(paths, tmp_path):
    notes = {"recorded_by": "me", "recorded_seed": None}
    other = write(tmp_path / "other.nc", likelihood=np.zeros((4, 3)), **notes)
    assert command(compare, paths[0], other) == 0


def test_other_people(paths, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("example_posteriors.PEOPLE", ("ana", "ben", "dia", "cem"))
    other = write(tmp_path / "other.nc", np.zeros((4, 3)))
    assert refused(capsys, tmp_path, paths[0], other) == (
        f"{other}: is of other recordings than {paths[0]}: people are ana, ben, dia, cem, "
        "expected ana, ben, cem, dia; fit the same people with --people"
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
