"""Fitting from Python: what is no human model, recording, draw or number is refused in a line."""

import inspect
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from example_person import DOMAIN, human, implants
from example_recordings import RAGGED, fields
from few_reaches import robot_of_few_reaches
from refused import refused

from mirror_ppl.data import Demonstrations
from mirror_ppl.errors import DemonstrationsError
from mirror_ppl.inference.adaptive_importance import ImportanceOptions
from mirror_ppl.inference.amortized import AmortizedOptions
from mirror_ppl.inference.automatic import AutomaticOptions
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.online import OnlinePosterior
from mirror_ppl.inference.population.pooling import Pooling
from mirror_ppl.inference.results.fitting import fit_people, split_rounds
from mirror_ppl.inference.results.population_file import load_population
from mirror_ppl.inference.results.posterior_file import PosteriorFile, load_posterior
from mirror_ppl.inference.results.posterior_predictive import predict_rounds
from mirror_ppl.inference.svi import SVIOptions
from mirror_ppl.models import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.weights import fingerprint, load_self_model, shipped_weights
from mirror_ppl.people import simulate, simulated_people
from mirror_ppl.training.guide_file import load_guide, shipped_guide

FEW = InferenceOptions(draws=3)
LATE = "docs/examples/late_reactions.py:LatePerson"


@pytest.fixture(scope="module")
def two():
    return simulate("driving", "fog", people=2, rounds=3)


@pytest.fixture(scope="module")
def one(two):
    return two.select_people([0])


@pytest.fixture(scope="module")
def elsewhere():
    return simulate("bomb_defusal", people=1, rounds=1)


@pytest.fixture(scope="module")
def impossible():
    """Numbers that are finite, and no road."""
    return Demonstrations(**fields(RAGGED)).select_people(["a"])


# --- recordings that do not go with a human model ----------------------------------------------

DOORS = {
    "infer": lambda model, rounds: infer(model, rounds, FEW, 0),
    "fit_people": lambda model, rounds: fit_people(model, rounds, FEW),
    "predict_rounds": lambda model, rounds: predict_rounds(model, rounds, implants(2)),
    "add": lambda model, rounds: OnlinePosterior(model).add(rounds),
}


@pytest.mark.parametrize("door", DOORS.values(), ids=DOORS.keys())
def test_rounds_and_models_have_to_be_such_and_of_one_world(door, one, elsewhere, impossible):
    refused(lambda: door("mirror", one), "human must be of the class HumanModel, not 'mirror'")
    refused(lambda: door(human(), "a.nc"), "must be of the class Demonstrations, not 'a.nc'")
    refused(lambda: door(human(), elsewhere), "the rounds are of bomb_defusal, not of driving")
    refused(lambda: door(human(), impossible), "person 'a', round 0, time 0: ego lane has to be 0")


def test_rounds_of_several_people_are_not_added(two):
    online = OnlinePosterior(human())
    refused(lambda: online.add(two), "the rounds are of 2 people, not one")
    assert online.rounds == 0


# --- arguments of fits -------------------------------------------------------------------------

WRONG = {
    "options": ({"options": "exact"}, "options must be of the class InferenceOptions, not 'exact'"),
    "seed": ({"seed": 1.5}, "seed must be a whole number, not 1.5"),
    "network": ({"network": "guide"}, "network must be of the class AmortizedGuide, not 'guide'"),
    "no network": ({"options": InferenceOptions("amortized")}, "needs its network, not None"),
    "population": ({"population": 3}, "population must be of the class Population, not 3"),
}


@pytest.mark.parametrize(("change", "message"), WRONG.values(), ids=WRONG.keys())
def test_wrong_arguments_are_refused(one, change, message):
    given = {"options": FEW, "seed": 0} | change
    refused(lambda: infer(human(), one, **given), message)
    refused(lambda: fit_people(human(), one, **given), message)


def test_a_checkpoint_is_a_file(one, tmp_path):
    refused(lambda: infer(human(), one, FEW, 0, checkpoint=(3, "run")), "path of a file, not 3")
    refused(lambda: fit_people(human(), one, FEW, checkpoint=3), "path of a file, not 3")
    svi = InferenceOptions("svi", draws=2, settings=SVIOptions(steps=2, checkpoint_every=1))
    infer(human(), one, svi, 0, checkpoint=(str(tmp_path / "checkpoint.pt"), "run"))
    assert (tmp_path / "checkpoint.pt").is_file()


def test_numbers_of_numpy_make_the_same_fit(two):
    person = HumanModel(robot_of_few_reaches())
    few = ImportanceOptions(64, 4.0)
    options = InferenceOptions("importance", draws=3, settings=few)
    own = fit_people(person, two, options, seed=1, train_rounds=2)
    options = InferenceOptions("importance", draws=np.int64(3), settings=few)
    other = fit_people(person, two, options, seed=np.int64(1), train_rounds=np.int64(2))
    assert json.dumps(own.summary) == json.dumps(other.summary)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: InferenceOptions(draws=2.5), "draws must be a whole number, not 2.5"),
        (lambda: InferenceOptions(draws=True), "draws must be a whole number, not True"),
        (lambda: InferenceOptions(refine=-1), "refine must be at least 0, not -1"),
        (
            lambda: InferenceOptions(engine=3),
            "unknown engine 3; known: amortized, auto, importance, nuts, svi",
        ),
        (lambda: ImportanceOptions(proposals=1), "proposals must be at least 2, not 1"),
        (lambda: ImportanceOptions(proposals=2.5), "proposals must be a whole number, not 2.5"),
        (lambda: ImportanceOptions(wider=-1), "wider must be at least 0, not -1"),
        (lambda: ImportanceOptions(enough="a"), "enough must be a number, not 'a'"),
        (lambda: AmortizedOptions(proposals=1), "proposals must be at least 2, not 1"),
        (lambda: AmortizedOptions(refine=-1), "refine must be at least 0, not -1"),
        (lambda: AutomaticOptions(enough=-1), "enough must be at least 0, not -1"),
    ],
)
def test_wrong_options_are_refused(make, message):
    refused(make, message)


@pytest.mark.parametrize(
    ("train_rounds", "message"),
    [
        (1.5, "train_rounds must be a whole number, not 1.5"),
        (True, "train_rounds must be a whole number, not True"),
        ("2", "train_rounds must be a whole number, not '2'"),
        (4, "cannot train on 4 of 3 rounds"),
        (-1, "cannot train on -1 of 3 rounds"),
    ],
)
def test_wrong_numbers_of_rounds_are_refused(two, train_rounds, message):
    refused(lambda: split_rounds(two, train_rounds), message)


def test_recordings_without_rounds_give_the_prior_if_asked_to(two):
    nothing = two.select_rounds([])
    with pytest.raises(DemonstrationsError, match="the recordings hold no rounds, so that"):
        split_rounds(nothing)
    assert split_rounds(nothing, 0)[0].round_counts.tolist() == [0, 0]


def test_rounds_that_are_split_are_recordings(two):
    refused(lambda: split_rounds([1, 2]), "must be of the class Demonstrations, not [1, 2]")
    own, other = split_rounds(two, 2), split_rounds(two, np.int64(2))
    assert all(mine.equals(theirs) for mine, theirs in zip(own, other, strict=True))


# --- draws -------------------------------------------------------------------------------------


def test_predictions_take_draws_of_any_kind(one):
    draws = implants(2, sight=2)
    expected = predict_rounds(human(), one, draws)
    for kind in (torch.Tensor.numpy, torch.Tensor.double, torch.Tensor.tolist):
        own = {name: kind(value) for name, value in draws.items()}
        assert torch.equal(predict_rounds(human(), one, own), expected)


def test_predictions_need_draws_of_these_people(one, two):
    draws = implants(2)
    less = {name: value for name, value in draws.items() if name != "lapse"}
    refused(lambda: predict_rounds(human(), two, draws), "are of 1 people, expected 2")
    refused(lambda: predict_rounds(human(), one, less), "there are no draws of the site lapse")
    refused(lambda: predict_rounds(human(), one, [1]), "must be a dict of arrays by site, not [1]")
    beyond = draws | {"consistency": draws["consistency"] - 4}
    refused(lambda: predict_rounds(human(), one, beyond), '"consistency" have -1, expected only')


def test_the_limit_of_what_can_be_sampled_will_do(one):
    """A person of consistency 0, which no draw of the prior is, acts at random."""
    draws = implants(1, consistency=0.0, lapse=1.0)
    found = predict_rounds(human(), one, draws)
    torch.testing.assert_close(found.exp(), torch.full_like(found, 0.5))


PRIORS = {
    "nobody": ((0, 3, 0), "people must be at least 1, not 0"),
    "no draws": ((1, 0, 0), "number must be at least 1, not 0"),
    "half a draw": ((1, 2.5, 0), "number must be a whole number, not 2.5"),
    "half a seed": ((1, 2, 0.5), "seed must be a whole number, not 0.5"),
}


@pytest.mark.parametrize(("given", "message"), PRIORS.values(), ids=PRIORS.keys())
def test_wrong_draws_of_the_prior_are_refused(given, message):
    refused(lambda: draw_prior(human(), *given), message)
    refused(lambda: draw_prior("mirror", 1, 2, 0), "must be of the class HumanModel, not 'mirror'")


def test_draws_of_the_prior_take_numbers_of_numpy():
    own, other = draw_prior(human(), 1, 2, 3), draw_prior(human(), *map(np.int64, (1, 2, 3)))
    assert all(torch.equal(own[name], other[name]) for name in own)


ONLINE = {
    "model": (lambda: OnlinePosterior("mirror"), "human must be of the class HumanModel, not 'mir"),
    "network": (lambda: OnlinePosterior(human(), "x"), "the class AmortizedGuide, not 'x'"),
    "seed": (lambda: OnlinePosterior(human(), seed=0.5), "seed must be a whole number, not 0.5"),
    "half a draw": (lambda: OnlinePosterior(human()).draws(2.5), "must be a whole number, not 2.5"),
    "no draws": (lambda: OnlinePosterior(human()).draws(0), "number must be from 1 to 100000"),
    "endless draws": (lambda: OnlinePosterior(human()).draws(10**12), "must be from 1 to 100000"),
    "no rounds": (lambda: OnlinePosterior(human()).draws(), "no round yet"),
}


@pytest.mark.parametrize(("make", "message"), ONLINE.values(), ids=ONLINE.keys())
def test_wrong_online_posteriors_are_refused(make, message):
    refused(make, message)


def test_a_posterior_file_gives_whole_numbers_of_draws():
    names = {"domain": "driving", "domain_version": DOMAIN.version, "human_model": "HumanModel"}
    names["self_model"] = fingerprint(human().self_model)
    file = PosteriorFile(Path("a.nc"), names, ("a",), {"lapse": np.zeros((5, 1))})
    refused(lambda: file.draws(human(), 1.5), "number must be a whole number, not 1.5")
    refused(lambda: file.draws(human(), -1), "number must be at least 0, not -1")
    refused(lambda: file.draws(human(), 6), "a.nc: holds 5 draws, not 6: ask for 5 or fewer")
    refused(lambda: file.draws("mirror", 2), "human must be of the class HumanModel, not 'mirror'")


# --- simulated people --------------------------------------------------------------------------

SIMULATED = {
    "nobody": ({"people": 0}, "people must be at least 1, not 0"),
    "half a person": ({"people": 1.5}, "people must be a whole number, not 1.5"),
    "text": ({"rounds": "3"}, "rounds must be a whole number, not '3'"),
    "half a seed": ({"seed": 1.5}, "seed must be a whole number, not 1.5"),
    "told too much": ({"told": 2}, "told must be from 0 to 1, not 2"),
    "told nan": ({"told": float("nan")}, "told must be from 0 to 1, not nan"),
    "told text": ({"told": "often"}, "told must be a number, not 'often'"),
    "domain": ({"domain": DOMAIN}, "unknown domain Driving; known: bomb_defusal"),
    "setting": ({"setting": 3}, "unknown setting 3 in driving; known: clear, fog"),
    "population": ({"population": None}, "unknown population None in driving; known: "),
    "device": ({"device": "gpu9"}, 'unknown device "gpu9"; known: cpu'),
}


@pytest.mark.parametrize(("change", "message"), SIMULATED.values(), ids=SIMULATED.keys())
def test_wrong_simulations_are_refused(change, message):
    refused(lambda: simulate(**({"people": 1, "rounds": 1} | change)), message)


def test_simulations_take_numbers_of_numpy():
    own = simulate(people=1, rounds=1, seed=3, told=0.5)
    given = {"people": np.int64(1), "rounds": np.int64(1), "seed": np.int64(3)}
    assert simulate(**given, told=np.float64(0.5)).equals(own)
    refused(
        lambda: simulated_people("driving", "fog", "paper", 0, 0), "people must be at least 1, no"
    )


# --- files -------------------------------------------------------------------------------------


def test_files_of_one_name_are_two_modules(tmp_path):
    kinds = []
    for folder, method in (("a", "sees"), ("b", "act")):
        (tmp_path / folder).mkdir()
        file = tmp_path / folder / "model.py"
        file.write_text(
            "from mirror_ppl.models import HumanModel\n\n\nclass Own(HumanModel):\n"
            f"    def {method}(self, *given):\n        return super().{method}(*given)\n"
        )
        kinds.append(type(load_human_model(f"{file}:Own", human().self_model)))
    assert ["def sees" in inspect.getsource(kind) for kind in kinds] == [True, False]


def test_files_of_models_are_named_by_text_or_path(tmp_path):
    weights = shipped_weights("driving")
    assert fingerprint(load_self_model(str(weights))[0]) == fingerprint(human().self_model)
    assert load_guide(str(shipped_guide("driving")), human())[1]
    assert type(load_human_model(Path(LATE), human().self_model)).__name__ == "LatePerson"
    missing = str(tmp_path / "a.nc")
    refused(lambda: load_posterior(missing), "there is no such file")
    refused(lambda: load_population(missing, Pooling(human())), "there is no such file")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: load_self_model(3), "path must be the path of a file, not 3"),
        (lambda: load_guide(3, human()), "path must be the path of a file, not 3"),
        (lambda: load_posterior(3), "path must be the path of a file, not 3"),
        (lambda: load_population(3, Pooling(human())), "path must be the path of a file, not 3"),
        (lambda: load_human_model(3, human().self_model), "must be of the class str, not 3"),
        (lambda: load_human_model("mirror", 3), "self_model must be of the class SelfModel, not 3"),
        (
            lambda: HumanModel(3),
            "self_model must be a self-model, with the method action_values, not 3",
        ),
    ],
)
def test_what_is_no_file_or_network_is_refused(call, message):
    refused(call, message)
