"""The house as firefighters see it."""

import arviz as az
import numpy as np
import pytest
import xarray as xr

from mirror_ppl.domains.search_rescue.pictures import PLACE, sight_probability
from mirror_ppl.plots.sight import sight_pictures


def made_up(radii, truth=1.5, domain="search_rescue"):
    """A posterior of two people with these draws of their radius."""
    draws = np.array([radii, radii[::-1]]).T[None]
    people = {"person": ["a", "b"]}
    posterior = xr.Dataset(
        {"sight_radius": (("chain", "draw", "person"), draws)},
        people,
        {"domain": domain, "setting": "smoke"},
    )
    known = xr.Dataset({"truth_sight_radius": ("person", [truth, np.nan])}, people)
    return az.InferenceData(posterior=posterior, constant_data=known)


def test_probabilities_are_shares_of_draws_that_see_a_portion():
    """From the hall its own portion is 1.4 cells away, the corridor's 2.2, the far corner's 7.1."""
    seen = sight_probability(made_up([1.0, 1.5, 2.3, 10.0]), "a")
    assert seen.shape == (9, 9)
    assert seen[PLACE] == 0.75
    assert seen[4, 1] == pytest.approx(0.5)
    assert seen[0, 8] == pytest.approx(0.25)
    assert (seen[3:6, :3] == seen[4, 1]).all()


def test_pictures_show_truth_probability_and_samples(tmp_path):
    data = made_up([1.5, 1.5, 2.0, 10.0])
    made = sight_pictures(data)
    assert set(made) == {"sight.png"}
    figure = made["sight.png"].draw(data)
    assert made["sight.png"].shows == "the house as each person sees it"
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    samples = [f"sample {n}" for n in range(1, 5)]
    assert titles[:7] == ["all there is", "what they see", "probability", *samples]
    # Of the second person the truth is not known.
    assert [bool(ax.images) for ax in figure.axes] == [True] * 8 + [False] + [True] * 5
    everything, truth, near = (figure.axes[n].images[0].get_array() for n in (0, 1, 3))
    np.testing.assert_array_equal(truth, near)
    assert everything[4, 1].sum() > 0
    assert [figure.axes[n].get_xlabel() for n in (3, 5)] == ["1.5 cells", "2 cells"]
    assert truth[7, 1].sum() > 0 and truth[4, 1].sum() == 0
    assert "from black, 0, to white, 1" in figure.get_supxlabel()
    figure.save(tmp_path / "sight.png")
    assert (tmp_path / "sight.png").read_bytes().startswith(b"\x89PNG")


def test_other_posteriors_have_no_such_picture():
    other = made_up([1.5, 2.0])["posterior"].rename(sight_radius="consistency")
    assert sight_pictures(az.InferenceData(posterior=other)) == {}
    assert sight_pictures(made_up([1.5, 2.0], domain="elsewhere")) == {}
