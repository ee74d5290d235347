"""What was measured of people beside their rounds is observed by the program."""

import math
from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_person import self_model
from few_reaches import robot_of_few_reaches
from test_one_program import recordings

import mirror_ppl
from benchmarks.one_program import exact_mean, toy
from mirror_ppl.data import Demonstrations, concatenate, load_demonstrations, save_demonstrations
from mirror_ppl.errors import DemonstrationsError, InputError
from mirror_ppl.inference.adaptive_importance import ImportanceOptions
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.online import OnlinePosterior
from mirror_ppl.inference.svi import SVIOptions
from mirror_ppl.models import HumanModel
from mirror_ppl.models.measured import alike_measured
from mirror_ppl.models.toy import ToyHuman
from mirror_ppl.people import simulate

__all__ = ["recordings"]


class Answering(ToyHuman):
    """As the toy whose answer is observed in its prior, but the answer comes with the rounds."""

    def prior(self):
        implants = super().prior()
        pyro.sample("answer", dist.Normal(implants["in_sight"], 0.05))
        return implants


class Asked(HumanModel):
    def prior(self):
        implants = super().prior()
        pyro.sample("questionnaire", dist.Normal(implants["consistency"], 0.01))
        return implants


def measured(rounds, **values):
    return replace(rounds, measurements={name: torch.tensor(v) for name, v in values.items()})


# --- in inference -----------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ["importance", "svi"])
def test_a_measured_site_is_an_observed_site(engine, recordings):
    human = Answering(self_model())
    options = InferenceOptions(engine, 2000)
    if engine == "svi":
        options = InferenceOptions(engine, 100, SVIOptions(steps=150))
    draws = infer(human, measured(recordings, answer=[0.7]), options, 0).draws
    found = draws["in_sight"].flatten()
    error = 4 * float(found.std()) / math.sqrt(400) if engine == "importance" else 0.03
    assert abs(found.mean() - exact_mean("observed", recordings, self_model())) < error
    assert (draws["answer"] == 0.7).all()
    assert list(draws) == ["reach", "in_sight", "otherwise", "answer"]


def test_unmeasured_it_is_a_site_like_others(recordings):
    human, options = Answering(self_model()), InferenceOptions(draws=500)
    for some in (recordings, measured(recordings, answer=[math.nan])):
        draws = infer(human, some, options, 0).draws
        found = draws["in_sight"].flatten()
        error = 4 * float(found.std()) / math.sqrt(400)
        assert abs(found.mean() - exact_mean("none", recordings, self_model())) < error
        assert (draws["answer"].flatten() - found).std() == pytest.approx(0.05, rel=0.2)


@pytest.mark.parametrize("engine", ["importance", "svi"])
def test_each_person_has_their_own(engine):
    rounds = simulate("driving", "fog", "paper", 3, 1, 100)
    answers = [1.0, 5.0, math.nan]
    if engine == "svi":
        options = InferenceOptions(engine, 30, SVIOptions(steps=40, learning_rate=0.1))
    else:
        options = InferenceOptions(engine, 100, ImportanceOptions(128, 50.0))
    some = measured(rounds, questionnaire=answers)
    draws = infer(Asked(robot_of_few_reaches()), some, options, 0).draws
    medians = draws["consistency"].median(0).values.flatten().tolist()
    # The mean-field guide has not quite arrived after so few steps.
    for answer, median in zip(answers, medians, strict=True):
        if not math.isnan(answer):
            assert median == pytest.approx(answer, abs=0.02 if engine == "importance" else 0.5)
    assert (draws["questionnaire"][:, 1] == 5.0).all()
    if engine == "importance":  # of two sites that hang together, a mean-field guide is too sure
        assert draws["questionnaire"][:, 2].std() > 0.1


def test_batches_are_of_people_of_whom_the_same_is_known():
    rounds = simulate("driving", "fog", "paper", 4, 1, 100)
    some = measured(rounds, one=[1.0, 2.0, math.nan, 1.0])
    assert alike_measured(some) == [range(2), range(2, 3), range(3, 4)]
    assert alike_measured(rounds) == [range(4)]


def test_a_fit_holds_what_was_measured(tmp_path):
    rounds = measured(simulate("driving", "fog", "paper", 2, 1, 100), questionnaire=[2.0, 4.0])
    save_demonstrations(tmp_path / "asked.nc", rounds)
    human = Asked(robot_of_few_reaches())
    few = {"settings": {"proposals": 128, "enough": 20.0}, "draws": 20, "explore": 0}
    fit = mirror_ppl.infer(tmp_path / "asked.nc", human=human, engine="importance", **few)
    assert fit.person("person-02").implants.loc["questionnaire", "median"] == 4.0
    assert fit.person("person-02").implants.loc["consistency", "median"] == pytest.approx(
        4, abs=0.1
    )
    assert mirror_ppl.Communicator(fit, "person-01").person.number == 20


WRONG = {
    "no site": ({"mood": [1.0]}, InputError, '"mood" was measured, but is no site of Answering'),
    "support": ({"in_sight": [1.5]}, InputError, '"in_sight" of person-01 is 1.5, which its site'),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_cannot_have_been_measured_is_refused(wrong, recordings):
    values, kind, message = WRONG[wrong]
    with pytest.raises(kind, match=message):
        infer(Answering(self_model()), measured(recordings, **values), InferenceOptions(), 0)


@pytest.mark.parametrize("engine", ["importance", "svi"])
def test_what_people_see_is_not_measured(engine, recordings):
    some = measured(recordings, reach=[1])
    with pytest.raises(InputError, match=r'"reach" was measured, but perceive\(\) reads it'):
        infer(Answering(self_model()), some, InferenceOptions(engine), 0)


def test_what_cannot_take_it_into_account_refuses_it(recordings):
    human, some = Answering(self_model()), measured(recordings, answer=[0.7])
    for options in (InferenceOptions("amortized"), InferenceOptions(pooling="partial")):
        with pytest.raises(InputError, match="answer of people was measured, which the engine"):
            infer(human, some, options, 0)
    with pytest.raises(InputError, match="answer was measured, which infer"):
        OnlinePosterior(toy("none", self_model())).add(some)


# --- in recordings ----------------------------------------------------------------------------


def test_measurements_are_kept(tmp_path):
    rounds = measured(simulate("driving", "fog", "paper", 3, 2, 0), answer=[1.0, math.nan, 3.0])
    save_demonstrations(tmp_path / "some.nc", rounds)
    back = load_demonstrations(tmp_path / "some.nc")
    assert back.equals(rounds)
    assert rounds.select_people([2, 0]).measurements["answer"].tolist() == [3.0, 1.0]
    assert rounds.select_rounds([1]).measurements.keys() == {"answer"}
    other = replace(simulate("driving", "fog", "paper", 1, 2, 1), people=("else",))
    found = concatenate([rounds, other]).measurements["answer"]
    assert found[[0, 2]].tolist() == [1.0, 3.0] and found[[1, 3]].isnan().all()
    assert not Demonstrations.equals(rounds, measured(rounds, answer=[1.0, 2.0, 3.0]))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"answer": torch.ones(3)}, r"measured_answer has shape \(3,\), expected \(2,\)"),
        ({"answer": torch.tensor([1.0, math.inf])}, "measured_answer is inf, expected a finite"),
        ({"a/b": torch.ones(2)}, "measurements has 'a/b', expected printable text"),
        ([1, 2], "measurements must be a dict of values by name"),
    ],
)
def test_measurements_that_cannot_be_are_refused(values, message):
    rounds = simulate("driving", "fog", "paper", 2, 1, 0)
    with pytest.raises(DemonstrationsError, match=message):
        replace(rounds, measurements=values)
