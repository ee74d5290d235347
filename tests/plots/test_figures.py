"""What all figures have in common: how they are saved, refused and imported."""

import sys
from pathlib import Path

import pytest
from example_drivers import made_up
from paths import ROOT

from mirror_ppl.domains.driving.road import plot_sight, sight_picture, sight_probability
from mirror_ppl.domains.driving.rounds import plot_round, switching
from mirror_ppl.errors import OutputError, UnknownNameError
from mirror_ppl.plots.implants import plot_implants


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
