"""Whether the model explains a person: verdicts, references, and what a fit tells of them."""

import math

import numpy as np
import pyro
import pytest
import scipy.stats
import torch
from example_programs import InRounds
from few_reaches import robot_of_few_reaches
from paths import ROOT

import mirror_ppl
from mirror_ppl.arviz import az
from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.inference.importance import has_evidence
from mirror_ppl.inference.results import criticism
from mirror_ppl.inference.results.criticism import Comparison, base_rate, no_implants, verdict
from mirror_ppl.inference.results.left_out import _without, left_out
from mirror_ppl.inference.results.posterior_predictive import predict_rounds
from mirror_ppl.inference.results.summary import predictive
from mirror_ppl.models.dependencies import ADDS_TO_ROUNDS
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.plots.model_check import plot_model_check


def test_a_p_value_near_0_or_1_makes_suspect():
    """With five checks a person is suspect if a p-value is below .005 or above .995."""
    fine = {"delayed": 0.3, "switches": 0.01, "reward": 0.9, "surprise": 0.5, "share of stay": 0.99}
    assert verdict(fine) == criticism.Verdict("ok")
    found = verdict(fine | {"switches": 0.004, "reward": 0.9999})
    assert found.word == "suspect"
    assert found.reasons == (
        "earns less than the model says (p < 0.001)",
        "changes what they do more often than the model says (p = 0.008)",
    )
    (reason,) = verdict(fine | {"share of stay": 1.0}).reasons
    assert reason == 'does "stay" less often than the model says (p < 0.001)'


def test_worse_than_how_often_each_was_chosen_is_unexplained():
    fine, late = {"delayed": 0.5}, {"delayed": 0.0}

    def of(*nats, actions=38):
        return Comparison(torch.tensor(nats), actions)

    surely, perhaps = of(-2.0, -3.0, -2.5, -2.0), of(-9.0, 8.0, -7.0, 6.0)
    better = of(2.0, 3.0, 2.5, 2.0)
    assert verdict(fine, [better]).word == verdict(fine, [perhaps]).word == "ok"
    assert verdict(late, [better]).word == "suspect"
    assert verdict(fine, [surely]).word == verdict(late, [perhaps]).word == "unexplained"
    # One comparison suffices, that of held-out rounds or of all.
    assert verdict(fine, [better, surely]).word == verdict(fine, [surely, better]).word
    assert verdict(fine, [better, surely]).reasons == (
        "from other rounds, actions are predicted 0.250 nats worse than by how often each was "
        "chosen there",
    )
    # Few rounds say little of how much rounds differ, one says nothing, unless it cannot be at all.
    assert not of(-2.0, -3.0).sure and of(-2.0, -3.0, -2.0).sure
    assert verdict(fine, [of(-2.0)]).word == "ok"
    assert verdict({}, [surely]).word == verdict({}).word == "unchecked"
    assert verdict(fine, [of(1.0, -math.inf)]).word == "unexplained"


@pytest.fixture(scope="module")
def recordings():
    return load_demonstrations(asset_path("driving_fog_paper.nc")).select_people([0])


def test_the_base_rate_is_of_the_rounds_before(recordings):
    train, test = recordings.select_rounds(range(4)), recordings.select_rounds([4])
    switched = int(train.actions.sum())
    chance = (switched + 0.5) / (train.actions.numel() + 1)
    often = base_rate(train, test, 2)
    probabilities = torch.tensor([1 - chance, chance])
    torch.testing.assert_close(often, -probabilities.log()[test.actions.flatten()])


def test_without_rounds_before_the_robot_is_as_its_prior(recordings):
    self_model = load_self_model(shipped_weights("driving"))[0]
    robot = load_human_model("no-implants", self_model)
    test = recordings.select_rounds([4, 5])
    found = no_implants(self_model, recordings.select_rounds([]), test, 7)
    prior = draw_prior(robot, 1, criticism.DRAWS, 7)
    mixed = predictive(predict_rounds(robot, test, prior))
    chosen = mixed.gather(-1, test.actions[..., None])[test.mask]
    torch.testing.assert_close(found, -chosen.flatten())
    # With rounds the robot's consistency is known, which cannot be worse by much.
    learned = no_implants(self_model, recordings.select_rounds(range(4)), test, 7)
    assert float(learned.mean()) < float(found.mean()) + 0.1


@pytest.mark.parametrize("power", [1.0, 0.25])
def test_a_round_is_predicted_from_the_others(power):
    """Exact for a coin of unknown bias with a uniform prior, tossed twice in each round."""
    rounds = torch.tensor([[1.0, 1.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [0.0, 1.0]])
    heads, tosses, number = rounds.sum(), rounds.numel(), 4000
    posterior = scipy.stats.beta(1 + power * heads, 1 + power * (tosses - heads))
    bias = torch.from_numpy(posterior.ppf((np.arange(number) + 0.5) / number))
    for own in rounds:
        log_probability = torch.where(own > 0, bias[:, None], 1 - bias[:, None]).log()
        found, _ = _without(log_probability, power)
        chance = (1 + power * (heads - own.sum())) / (2 + power * (tosses - 2))
        expected = torch.where(own > 0, chance, 1 - chance).log().sum()
        torch.testing.assert_close(found, expected.double(), atol=2e-3, rtol=0)


def test_impossible_draws_do_not_predict_rounds():
    possible = torch.tensor([[-1.0, -2.0], [-1.0, -2.0]]).double()
    impossible = torch.tensor([[-math.inf, -2.0]]).double()
    found, _ = _without(torch.cat([possible, impossible]), 1.0)
    assert float(found) == pytest.approx(-3.0)
    assert _without(impossible, 1.0) == (-math.inf, math.inf)


def test_training_rounds_are_compared_with_how_often_each_was_chosen_in_others(recordings):
    train = recordings.select_rounds(range(3))
    human = HumanModel(load_self_model(shipped_weights("driving"))[0])
    uniform = torch.full((5, 1, *train.actions.shape[1:], 2), math.log(0.5))
    found = left_out(human, train, uniform)
    for number in range(3):
        rest = recordings.select_rounds([one for one in range(3) if one != number])
        often = base_rate(rest, recordings.select_rounds([number]), 2)
        steps = int(train.mask[0, number].sum())
        torch.testing.assert_close(found.shares[number].float(), -often.sum())
        torch.testing.assert_close(found.model[number], torch.tensor(-steps * math.log(2)).double())
    assert found.actions == int(train.mask.sum()) and found.pareto_k == -math.inf
    assert left_out(human, recordings.select_rounds([0]), uniform[:, :, :1]) is None


class Watched(HumanModel):
    def act(self, implants, belief, values):
        pyro.factor("gaze", 0.1 * implants["lapse"])
        return super().act(implants, belief, values)


@pytest.mark.parametrize("kind", [Watched, InRounds])
def test_where_actions_are_not_all_that_is_recorded(kind, recordings):
    """No round can be left out by weighting draws, and there is no evidence of actions alone."""
    train = recordings.select_rounds(range(3))
    uniform = torch.full((5, 1, *train.actions.shape[1:], 2), math.log(0.5))
    human = kind(robot_of_few_reaches())
    assert left_out(human, train, uniform) is None
    assert not has_evidence(human)
    fit = mirror_ppl.infer(train, human=human, draws=10, train_rounds=2, explore=0)
    assert fit.summary["people"][0]["log_evidence"] is None
    assert fit.data["posterior"].attrs[ADDS_TO_ROUNDS] == "1"


def test_people_without_held_out_rounds_can_be_unexplained(late, monkeypatch):
    """Here whoever is late and, as far as the model says, does the opposite of what it predicts."""
    human = HumanModel(robot_of_few_reaches())
    draws = draw_prior(human, 1, 20, 0)
    train = late.select_people([1])
    sure = torch.full((20, 1, *train.actions.shape[1:], 2), math.log(0.01))
    wrong = 1 - train.actions.clamp(min=0)
    sure.scatter_(-1, wrong.expand(20, 1, -1, -1)[..., None], math.log(0.99))
    monkeypatch.setattr(criticism, "perception_p_values", lambda *_: {})
    found = criticism.criticize(human, (train, None), (sure, None), draws, 0)
    assert found["verdict"] == "unexplained" and found["nll_base_rate"] is None
    assert found["reasons"][-1].startswith("from other rounds, actions are predicted ")
    assert found["reasons"][-1].endswith(" nats worse than by how often each was chosen there")


@pytest.fixture(scope="module")
def late():
    """Rounds of two people from the prior, of whom the second nearly always acts a step late."""
    self_model = robot_of_few_reaches()
    human = load_human_model(f"{ROOT}/docs/examples/late_reactions.py:LatePerson", self_model)
    implants = {name: value[0] for name, value in draw_prior(human, 2, 1, 100).items()}
    implants["late"] = torch.tensor([[0.01], [0.99]])
    return play_rounds(human, implants, 24, "fog", torch.Generator().manual_seed(100))


# Of a person whom the model does not explain, Pareto k is near .7 with 256 to 2,048 proposals.
@pytest.mark.filterwarnings("ignore::mirror_ppl.errors.UnreliableWeights")
def test_a_fit_says_who_is_late(late):
    human = HumanModel(robot_of_few_reaches())
    few = {"settings": {"proposals": 256, "enough": 100.0}, "draws": 200, "explore": 0}
    fit = mirror_ppl.infer(late, human=human, engine="importance", seed=1, **few)
    check = fit.check
    assert list(check.index) == ["person-01", "person-02"]
    assert check["verdict"].iloc[0] == "ok"
    assert check["verdict"].iloc[1] in ("suspect", "unexplained")
    assert "acts as if one step late" in check["reasons"].iloc[1]
    assert check["delayed"].iloc[0] > 0.005 > check["delayed"].iloc[1]
    assert f"; {check['verdict'].iloc[1]}: person-02)" in repr(fit)
    assert "one step late" in repr(fit.person("person-02"))
    own = fit.summary["people"][1]["check"]
    assert (
        own["verdict"] == check["verdict"].iloc[1]
        and own["p_values"]["delayed"] == check["delayed"].iloc[1]
    )
    group = fit.data["model_check"]
    assert list(group["verdict"].values) == list(check["verdict"])
    assert group["p_value"].sel(person="person-02", check="delayed") == check["delayed"].iloc[1]
    left_out = "nll_left_out", "nll_left_out_base_rate"
    assert check.loc[:, left_out].notna().all(axis=None) and own["pareto_k_left_out"] is not None
    for name in ("nll", "nll_base_rate", "nll_no_implants", *left_out):
        assert list(group[name].values) == list(check[name])
    assert [ax.get_title() for ax in fit.plot.check().axes][1:] == ["Held-out actions"]
    # Without held-out rounds, those of training rounds are drawn; without any, none.
    data = az.InferenceData(model_check=group.copy())
    for name in ("nll", "nll_base_rate", "nll_no_implants"):
        data["model_check"][name][:] = np.nan
    axes = plot_model_check(data).axes
    assert [ax.get_title() for ax in axes][1:] == ["Left-out rounds"]
    drawn = {line.get_label(): list(line.get_xdata()) for line in axes[1].lines}
    assert drawn["the model"] == list(check["nll_left_out"])
    assert drawn["base rate of each action"] == list(check["nll_left_out_base_rate"])
    for name in left_out:
        data["model_check"][name][:] = np.nan
    assert len(plot_model_check(data).axes) == 1
