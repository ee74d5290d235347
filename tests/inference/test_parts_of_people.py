"""People worked on one by one: whoever does it, and whoever else there is, nothing changes."""

from dataclasses import replace

import numpy as np
import pytest

import mirror_ppl
from mirror_ppl.errors import InputError
from mirror_ppl.inference.workers import PEOPLE_OF_A_PROCESS, PersonAt, Workers
from mirror_ppl.randomness import person_seed
from mirror_ppl.timing import clocked, stage

PEOPLE = 3
SMALL = {"draws": 20, "train_rounds": 1, "explore": 1}
RADIUS = SMALL | {"human": "one-radius"}
"""A model with few combinations of perceptual implants, which is quick."""


@pytest.fixture(scope="module")
def recordings():
    """A round to learn from, and one to predict."""
    everybody = mirror_ppl.load_recordings(population="diverse")
    return everybody.part(range(PEOPLE)).select_rounds(range(2))


@pytest.fixture(scope="module")
def fit(recordings):
    return mirror_ppl.infer(recordings, **SMALL)


@pytest.fixture(scope="module")
def quick(recordings):
    return mirror_ppl.infer(recordings, **RADIUS)


def assert_same(data, other, tolerance=0.0):
    assert data.groups() == other.groups()
    for group in data.groups():
        assert set(data[group].data_vars) == set(other[group].data_vars)
        for name, values in data[group].data_vars.items():
            one, own = values.values, other[group][name].values
            if one.dtype.kind == "U":
                assert (one == own).all()
            else:
                np.testing.assert_allclose(one, own, rtol=0, atol=tolerance, equal_nan=True)


def test_processes_make_no_difference(fit, recordings):
    shared = mirror_ppl.infer(recordings, **SMALL, jobs=2)
    assert_same(shared.data, fit.data)
    assert shared.summary == fit.summary
    assert set(shared.seconds) == {"compile", "infer", "predict", "identify"}


def test_what_is_kept_makes_no_difference(quick, recordings, tmp_path):
    told = []

    def stop(name, done, total, message):
        told.append((name, done, total))
        if (name, done) == ("infer", 2):
            raise KeyboardInterrupt

    options = RADIUS | {"checkpoint": tmp_path / "c"}
    with pytest.raises(KeyboardInterrupt):
        mirror_ppl.infer(recordings, report=stop, **options)
    assert told == [("infer", done, PEOPLE) for done in (0, 1, 2)]
    told.clear()
    again = mirror_ppl.infer(recordings, report=lambda *one: told.append(one[:3]), **options)
    assert told[0] == ("infer", 2, PEOPLE)
    assert_same(again.data, quick.data)
    # A damaged part counts as missing.
    folder = tmp_path / "c.parts"
    for path in folder.iterdir():
        path.write_bytes(path.read_bytes()[:-100])
    assert_same(mirror_ppl.infer(recordings, **options).data, quick.data)
    Workers(folder=folder).clean()
    assert not folder.exists()


def test_no_person_depends_on_the_other_people(fit, recordings):
    """A fit of some of them, in another order, equals their part of the fit of all."""
    chosen = [2, 0]
    some = mirror_ppl.infer(recordings.select_people(chosen), **SMALL)
    for name, values in some.data.posterior.data_vars.items():
        own = fit.data.posterior[name].isel(person=chosen)
        np.testing.assert_array_equal(values, own)
    for group in ("predictions", "posterior_predictive", "prior", "identifiability"):
        for name, values in some.data[group].data_vars.items():
            if "person" in values.dims:
                own = fit.data[group][name].isel(person=chosen)
                np.testing.assert_array_equal(values, own)


def test_people_of_other_names_have_draws_of_their_own(quick, recordings):
    renamed = replace(recordings, people=("ann", "person-02", "bob"))
    found = mirror_ppl.infer(renamed, **RADIUS).data.posterior["consistency"]
    same = (found.values == quick.data.posterior["consistency"].values).all(1).all(0)
    assert same.tolist() == [False, True, False]


def test_weights_have_eight_bits(fit):
    bits = fit.data.posterior["residual_in"].values.view(np.uint32)
    assert not (bits & 0xFFFF).any()
    assert (fit.data.posterior["consistency"].values.view(np.uint32) & 0xFFFF).any()


def test_all_draws_are_kept_if_asked_for(quick, recordings):
    every = mirror_ppl.infer(recordings, **RADIUS, keep="draws")
    probability = every.data.predictions["action_probability"]
    assert probability.sizes["draw"] == 20
    mean = quick.data.predictions["action_probability"]
    assert mean.sizes["draw"] == 1
    np.testing.assert_allclose(probability.mean("draw"), mean.isel(draw=0), atol=1e-6)
    assert "residual_in" in every.data.prior and "residual_in" not in quick.data.prior


@pytest.mark.parametrize("what", ["", "all", 3])
def test_what_is_kept_has_a_name(what, recordings):
    with pytest.raises(mirror_ppl.errors.MirrorError, match="keep"):
        mirror_ppl.infer(recordings, keep=what)


def test_processes_are_as_many_as_pay(monkeypatch):
    monkeypatch.setattr("joblib.cpu_count", lambda: 4)
    found = [
        Workers(None).processes(people)
        for people in (1, PEOPLE_OF_A_PROCESS, PEOPLE_OF_A_PROCESS + 1, 1000)
    ]
    assert found == [1, 1, 2, 4]
    assert Workers(7).processes(1) == 7
    with pytest.raises(InputError, match="jobs must be at least 1, or -1"):
        Workers(0)


def test_people_come_in_order_with_what_they_need():
    told = []
    workers = Workers(report=lambda *one: told.append(one))
    found = workers.run("count", 3, lambda given: {"is": given}, lambda person: person.range)
    assert found == [{"is": range(0, 1)}, {"is": range(1, 2)}, {"is": range(2, 3)}]
    assert [one[1] for one in told] == [0, 1, 2, 3]
    assert PersonAt(4).label == "person 5"


def test_stages_within_others_count_once():
    with clocked() as seconds:
        with stage("outer"):
            with stage("inner"):
                pass
            with stage("inner"):
                pass
        assert set(seconds) == {"outer", "inner"}
    before = dict(seconds)
    with stage("nobody measures"):
        pass
    assert seconds == before


def test_seeds_of_people_are_those_of_their_ids():
    assert [person_seed(0, f"person-{n:02d}") for n in (1, 2, 99, 100, 1000)] == [0, 1, 98, 99, 999]
    others = [
        "person-0",
        "person-00",
        "person-1",
        "person-001",
        "person-\u0663",
        "ann",
        "person-01",
    ]
    assert len({person_seed(0, name) for name in others}) == len(others)
