"""What all figures have in common: how they are saved, refused and imported."""

import sys
from pathlib import Path

import arviz as az
import numpy as np
import pytest
import xarray as xr
from example_drivers import made_up
from paths import ROOT

from mirror_ppl.domains.driving.road import plot_sight, sight_picture, sight_probability
from mirror_ppl.domains.driving.rounds import plot_round, switching
from mirror_ppl.errors import OutputError, UnknownNameError
from mirror_ppl.inference.results.checks import CHECKS
from mirror_ppl.plots.identifiability import plot_identifiability
from mirror_ppl.plots.implants import plot_implants
from mirror_ppl.plots.model_check import plot_model_check


@pytest.fixture
def data(rng):
    return made_up(rng)


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


def checked(verdicts):
    """A model check of people p0, p1, ... with these verdicts."""
    nll = np.linspace(0.1, 0.6, len(verdicts))
    variables = {
        "verdict": ("person", np.array(verdicts)),
        "p_value": (("person", "check"), np.full((len(verdicts), len(CHECKS)), 0.5)),
        **{f"nll{end}": ("person", nll) for end in ("", "_base_rate", "_no_implants")},
    }
    people = [f"p{number}" for number in range(len(verdicts))]
    return az.InferenceData(
        model_check=xr.Dataset(variables, {"person": people, "check": list(CHECKS)})
    )


def test_people_beyond_the_first_60_are_those_whom_the_model_explains():
    verdicts = ["ok"] * 70
    verdicts[1] = verdicts[65] = "suspect"
    verdicts[2] = verdicts[69] = "unexplained"
    figure = plot_model_check(checked(verdicts))
    assert figure.get_suptitle() == "60 of 70 people: unexplained, then suspect ones first"
    names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    first = ["p2 (unexplained)", "p69 (unexplained)", "p1 (suspect)", "p65 (suspect)", "p0", "p3"]
    assert names[:6] == first and len(names) == 60
    # Where all are drawn they keep their order, and nothing needs to be said.
    figure = plot_model_check(checked(verdicts[:60]))
    names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert names[:3] == ["p0", "p1 (suspect)", "p2 (unexplained)"] and not figure.get_suptitle()


@pytest.mark.parametrize("people", [60, 70])
def test_the_picture_of_entropies_says_that_people_are_left_out(people):
    shape = ("person", "site")
    group = xr.Dataset(
        {
            "entropy": (shape, np.full((people, 1), 0.5)),
            "shared_with_policy": (shape, np.full((people, 1), 0.1)),
            "information": (("person", "scenario"), np.full((people, 1), 0.2)),
        },
        {
            "person": [f"p{number}" for number in range(people)],
            "site": ["sight_radius"],
            "scenario": ["left"],
        },
    )
    figure = plot_identifiability(az.InferenceData(identifiability=group))
    assert figure.get_suptitle() == ("The first 60 of 70 people" if people > 60 else "")
