"""Tables of how probably people notice things."""

import arviz as az
import numpy as np
import pytest
import xarray as xr

from mirror_ppl.plots.sight import sight_pictures

SITES = [f"notices_terminal {number}" for number in range(1, 7)]


def made_up(people, domain="bomb_defusal", truth=True):
    """Draws that are 0.01 times their number, of every terminal."""
    draws = np.arange(1, 10)[None, :, None] / 100 + np.zeros((1, 9, people))
    names = {"person": [f"person-{number}" for number in range(people)]}
    posterior = xr.Dataset(
        {site: (("chain", "draw", "person"), draws) for site in SITES},
        names,
        {"domain": domain, "setting": "unlabelled"},
    )
    known = {f"truth_{site}": ("person", np.full(people, 0.05)) for site in SITES}
    constants = xr.Dataset(known if truth else {"length": ("person", np.ones(people))}, names)
    return az.InferenceData(posterior=posterior, constant_data=constants)


def texts(ax):
    return [text.get_text() for text in ax.texts]


@pytest.mark.parametrize("truth", [True, False])
def test_each_person_has_samples_beneath_the_truth(truth, tmp_path):
    data = made_up(2, truth=truth)
    picture = sight_pictures(data)["notices.png"]
    figure = picture.draw(data)
    assert picture.shows == "how probably each person notices what is there"
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["person-0", "person-1"]
    rows = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert rows == ["truth"] * truth + [f"sample {number}" for number in range(1, 6)]
    # Draws 1, 3, 5, 7 and 9 of nine.
    expected = [".050"] * 6 * truth + [f".0{number}0" for number in (1, 3, 5, 7, 9) for _ in SITES]
    assert texts(figure.axes[0]) == expected
    figure.save(tmp_path / "notices.png")
    assert (tmp_path / "notices.png").read_bytes().startswith(b"\x89PNG")


def test_only_so_many_people_fit():
    figure = sight_pictures(made_up(14))["notices.png"].draw(made_up(14))
    assert len(figure.axes) == 12
    assert "the first 12 of 14 people" in figure.get_suptitle()
    # Three beside each other; items are named above the first ones alone.
    named = [bool(ax.get_xticklabels()[0].get_text()) for ax in figure.axes]
    assert named == [True] * 3 + [False] * 9


def test_driving_has_the_table_where_cars_are_noticed_one_by_one():
    assert "notices.png" in sight_pictures(made_up(1, "driving"))
    assert sight_pictures(made_up(1, "search_rescue")) == {}
