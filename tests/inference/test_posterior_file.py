"""Posterior files read back: draws as they were, and every file that cannot be used refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from example_person import DOMAIN, SIGHTS, human, self_model, varied_draws

from mirror_ppl.arviz import az
from mirror_ppl.communication import Person
from mirror_ppl.data import asset_path
from mirror_ppl.errors import HumanModelError, PosteriorError, UnknownNameError
from mirror_ppl.inference.results.export import in_units, save_inference_data
from mirror_ppl.inference.results.posterior_file import load_posterior
from mirror_ppl.models import HumanModel
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.weights import fingerprint

PEOPLE = ("ana", "ben", "cem")


def attributes(**changes):
    given = {
        "domain": "driving",
        "domain_version": DOMAIN.version,
        "human_model": "HumanModel",
        "self_model": fingerprint(self_model()),
    }
    return {name: value for name, value in (given | changes).items() if value is not None}


def people_draws(number, generator):
    """Draws ``[S, P, 1, ...]`` of three people, different for each."""
    each = [varied_draws(number, generator) for _ in PEOPLE]
    return {name: torch.cat([draws[name] for draws in each], 1) for name in each[0]}


def write(path, draws, chains=1, **changes):
    """A file with these draws, as a fit writes it."""
    values = {}
    for name, value in in_units(DOMAIN, draws).items():
        value = value.numpy()
        values[name] = value.reshape(chains, -1, *value.shape[1:])
    data = az.from_dict(
        posterior=values,
        coords={"person": list(PEOPLE)},
        dims={name: ["person"] for name in values},
    )
    data["posterior"].attrs.update(attributes(**changes))
    save_inference_data(data, path)
    return path


@pytest.fixture
def draws(generator):
    return people_draws(9, generator)


@pytest.fixture
def path(draws, tmp_path):
    return write(tmp_path / "posterior.nc", draws)


def equal(one, other):
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


# --- what is read -----------------------------------------------------------------------------


def test_draws_come_back_as_the_model_samples_them(path, draws):
    back = load_posterior(path, "driving").draws(human())
    assert back.keys() == draws.keys()
    for name, value in draws.items():
        assert back[name].shape == (9, 3, 1, *value.shape[3:]), name
        assert back[name].dtype == value.dtype, name
        assert torch.equal(back[name], value), name


def test_a_file_says_what_it_is_of(path):
    file = load_posterior(path)
    assert file.path == path
    assert file.people == PEOPLE
    assert {name: file.attributes[name] for name in attributes()} == attributes()
    for name in SIGHTS:  # in cells, as the file says
        assert set(np.unique(file.values[name])) <= set(DOMAIN.reach_bins)
        assert file.values[name].shape == (9, 3)


def test_one_person_can_be_planned_for(path, draws):
    back = load_posterior(path).draws(human(), 4)
    person = Person(human(), {name: value[:, 1:2] for name, value in back.items()})
    assert person.number == 4
    own = torch.stack([draws[name][[0, 3, 5, 8], 1, 0] for name in SIGHTS], -1)
    seen = torch.stack([person.percepts[name][person.percept] for name in SIGHTS], -1)
    assert torch.equal(seen, own)


def test_chains_are_read_one_after_the_other(tmp_path, generator):
    draws = people_draws(6, generator)
    path = write(tmp_path / "chains.nc", draws, chains=2)
    assert equal(load_posterior(path).draws(human()), draws)


def test_distances_are_read_as_the_nearest_threshold(path, draws):
    file = load_posterior(path)
    for name in SIGHTS:
        file.values[name][...] += 0.2  # as if rounded on the way
    assert equal(file.draws(human()), draws)


# --- which draws are taken --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "taken"),
    [
        (1, [0]),
        (2, [0, 8]),
        (3, [0, 4, 8]),
        (5, [0, 2, 4, 6, 8]),
        (9, list(range(9))),
        (None, list(range(9))),
    ],
)
def test_draws_are_spread_evenly_from_the_first_to_the_last(path, draws, number, taken):
    expected = {name: value[taken] for name, value in draws.items()}
    assert equal(load_posterior(path).draws(human(), number), expected)


@pytest.mark.parametrize("number", range(2, 10))
def test_no_draw_is_taken_twice_and_gaps_differ_by_one_at_most(path, draws, number):
    back = load_posterior(path).draws(human(), number)
    place = {value: index for index, value in enumerate(draws["lapse"][:, 0, 0].tolist())}
    gaps = np.diff([place[value] for value in back["lapse"][:, 0, 0].tolist()])
    assert gaps.min() >= 1
    assert gaps.max() - gaps.min() <= 1


def test_draws_are_the_same_each_time_and_leave_global_randomness_alone(path):
    file = load_posterior(path)
    before = torch.get_rng_state()
    first = file.draws(human(), 5)
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(1)
    assert equal(file.draws(human(), 5), first)
    # They are copies: what is done to them does not reach the file's.
    first["lapse"][:] = 0.5
    assert not equal(file.draws(human(), 5), first)


def test_more_draws_than_there_are_are_refused(path):
    with pytest.raises(PosteriorError) as error:
        load_posterior(path).draws(human(), 10)
    assert str(error.value) == f"{path}: holds 9 draws, not 10: ask for 9 or fewer"


def test_no_draws_at_all_are_no_person(path):
    none = load_posterior(path).draws(human(), 0)
    assert none["lapse"].shape == (0, 3, 1)
    with pytest.raises(HumanModelError, match="planning needs at least one posterior draw"):
        Person(human(), {name: value[:, :1] for name, value in none.items()})


# --- files that cannot be used ----------------------------------------------------------------


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(PosteriorError) as error:
        load_posterior(tmp_path / "none.nc")
    assert str(error.value) == (
        f"{tmp_path / 'none.nc'}: there is no such file; python -m mirror_ppl.fit makes one"
    )
    with pytest.raises(PosteriorError, match="posterior.nc: there is no such file"):
        load_posterior(tmp_path)  # a folder
    (tmp_path / "posterior.nc").mkdir()
    with pytest.raises(PosteriorError, match="is not a regular file"):
        load_posterior(tmp_path)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ("no netCDF", "is not a netCDF file"),
        ("empty", "is not a netCDF file"),
        ("cut off", "is truncated or damaged ("),
    ],
)
def test_a_damaged_file(path, damage, message):
    content = {
        "no netCDF": b"this is text",
        "empty": b"",
        "cut off": path.read_bytes()[:2000],
    }[damage]
    path.write_bytes(content)
    with pytest.raises(PosteriorError) as error:
        load_posterior(path)
    assert str(error.value).startswith(f"{path}: {message}")


def test_a_netcdf_file_that_is_no_posterior():
    recordings = asset_path("driving_fog_paper.nc")
    with pytest.raises(
        PosteriorError,
        match=r"driving_fog_paper.nc: holds no posterior; python -m mirror_ppl.fit makes one",
    ):
        load_posterior(recordings)


def test_a_posterior_without_people(tmp_path):
    data = az.from_dict(posterior={"lapse": np.zeros((1, 5))})
    data["posterior"].attrs.update(attributes())
    save_inference_data(data, tmp_path / "x.nc")
    with pytest.raises(PosteriorError, match="cannot be read as a posterior"):
        load_posterior(tmp_path / "x.nc")


def test_a_file_without_draws(path):
    data = az.from_netcdf(str(path)).isel(draw=slice(0))
    none = path.with_name("none.nc")
    save_inference_data(data, none)
    with pytest.raises(PosteriorError) as error:
        load_posterior(none)
    assert str(error.value) == f"{none}: holds no draws"


def test_another_domain_than_the_one_asked_for(path, tmp_path, draws):
    with pytest.raises(PosteriorError) as error:
        load_posterior(path, "kitchen")
    assert str(error.value) == f'{path}: is for the domain "driving", not "kitchen"'
    other = write(tmp_path / "other.nc", draws, domain="kitchen")
    with pytest.raises(PosteriorError, match='is for the domain "kitchen", not "driving"'):
        load_posterior(other, "driving")
    # Any domain will do if none is asked for, but it has to be one that is known.
    with pytest.raises(UnknownNameError, match='unknown domain "kitchen"; known: bomb_'):
        load_posterior(other)


def test_the_folder_of_a_fit_stands_for_its_posterior(tmp_path, draws):
    path = write(tmp_path / "posterior.nc", draws)
    assert load_posterior(tmp_path).people == load_posterior(path).people


def test_a_file_that_does_not_say_of_which_domain_it_is(tmp_path, draws):
    path = write(tmp_path / "x.nc", draws, domain=None)
    with pytest.raises(PosteriorError, match='is for the domain "unknown", not "driving"'):
        load_posterior(path, "driving")


@pytest.mark.parametrize(
    ("name", "other", "told"),
    [
        ("domain_version", "0", "is of domain version 0, not 1"),
        ("domain_version", None, "is of domain version None, not 1"),
        ("human_model", "Forgetful", "is of human model Forgetful, not mirror"),
        ("self_model", "0123", "is of self model 0123, not "),
        ("value_error", "0.15", "is of value error 0.15, not 0"),
    ],
)
def test_draws_of_another_version_or_model(tmp_path, draws, name, other, told):
    path = write(tmp_path / "x.nc", draws, **{name: other})
    file = load_posterior(path, "driving")
    with pytest.raises(PosteriorError) as error:
        file.draws(human())
    assert str(error.value).startswith(f"{path}: {told}")
    hint = ", or give what it was fitted with" if name != "value_error" else ""
    hint += " (--human-model; in Python human=)" if name == "human_model" else ""
    assert str(error.value).endswith(f"; fit again{hint}")


def test_draws_for_another_domain_than_theirs(tmp_path, draws):
    """Before anything else, as models are called alike in all domains."""
    path = write(tmp_path / "x.nc", draws, domain="search_rescue", human_model="BombDefusalHuman")
    with pytest.raises(PosteriorError, match="is of domain search_rescue, not driving; fit again"):
        load_posterior(path).draws(human())


def test_draws_for_another_model_than_theirs(path):
    class Forgetful(HumanModel):
        pass

    with pytest.raises(PosteriorError, match="is of human model mirror, not Forgetful"):
        load_posterior(path).draws(Forgetful(self_model()))
    with pytest.raises(PosteriorError, match="is of self model"):
        load_posterior(path).draws(HumanModel(SelfModel(DOMAIN)))


def test_a_site_that_is_not_in_the_file(tmp_path, draws):
    del draws["consistency"]
    path = write(tmp_path / "x.nc", draws)
    with pytest.raises(PosteriorError) as error:
        load_posterior(path).draws(human())
    assert str(error.value) == f'{path}: has no draws of the site "consistency"'


def test_a_site_of_another_shape(tmp_path, draws):
    draws["residual_in"] = draws["residual_in"][..., :-1]
    path = write(tmp_path / "x.nc", draws)
    with pytest.raises(PosteriorError) as error:
        load_posterior(path).draws(human(), 5)
    assert str(error.value) == (
        f'{path}: "residual_in" has shape (5, 3, 49, 7), expected (5, 3, 49, 8)'
    )


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("consistency", -3.0, '"consistency" has values that the human model rules out'),
        ("consistency", float("nan"), '"consistency" has values that the human model rules out'),
        ("lapse", 1.5, '"lapse" has values that the human model rules out'),
        ("sight_front_own", 77.0, '"sight_front_own" has values that are no bins'),
        ("sight_front_own", float("nan"), '"sight_front_own" has values that are no bins'),
    ],
)
def test_values_that_cannot_be_are_refused(path, name, value, message):
    file = load_posterior(path)
    file.values[name][1] = value
    with pytest.raises(PosteriorError, match=message):
        file.draws(human())


def test_values_of_another_kind_are_refused(path):
    file = load_posterior(path)
    name = "sight_front_own"
    file = replace(file, values={**file.values, name: file.values[name].astype(str)})
    with pytest.raises(PosteriorError, match='"sight_front_own" holds no numbers'):
        file.draws(human())
