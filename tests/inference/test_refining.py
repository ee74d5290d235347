"""Refining: what a network proposes, fitted to a person's own rounds before draws are weighted."""

import math

import pytest
import torch
from running import command
from scipy import stats

from mirror_ppl.commands import fit
from mirror_ppl.data import asset_path, load_demonstrations, save_demonstrations
from mirror_ppl.errors import InputError
from mirror_ppl.inference.adaptive_importance import ImportanceOptions
from mirror_ppl.inference.amortized import AmortizedOptions, sample_amortized
from mirror_ppl.inference.amortized_guide import (
    AmortizedGuide,
    guide_screening,
    reference_places,
)
from mirror_ppl.inference.automatic import AutomaticOptions
from mirror_ppl.inference.calibration.study import prior_people
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.likelihood.tables import person_builders
from mirror_ppl.models import HumanModel
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.toy import RATES, ToyHuman, toy_posterior
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.training.guide_file import network_for

STEPS = 40


@pytest.fixture(scope="module")
def toy():
    return ToyHuman(load_self_model(shipped_weights("driving"))[0])


@pytest.fixture(scope="module")
def recordings(toy):
    generator = torch.Generator().manual_seed(3)
    return play_rounds(toy, prior_people(toy, 4, generator), 3, "fog", generator)


@pytest.fixture(scope="module")
def network(toy):
    """Not trained, so it has much to learn from a person's own rounds."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return AmortizedGuide(reference_places(toy)).eval()


def test_refined_draws_have_the_exact_posterior_and_more_of_them_count(toy, recordings, network):
    effective = {0: [], STEPS: []}
    exact = toy_posterior(toy, recordings)
    before = [value.clone() for value in network.state_dict().values()]
    for person, builder in enumerate(person_builders(toy, recordings, guide_screening())):
        for refine, counts in effective.items():
            torch.manual_seed(person)
            options = AmortizedOptions(512, ImportanceOptions(stages=0), refine)
            found = sample_amortized(toy, network, builder, options)
            counts.append(found.effective)
            assert found.pareto_k < 0.7
            for site in RATES:
                value = (found.log_weights.exp() * found.policy[site].flatten()).sum()
                variance = exact.variance(site)[person] / (found.effective / 2)
                off = abs(float(value - exact.mean(site)[person]))
                assert off < -stats.norm.ppf(5e-7) * float(variance.sqrt())
    gain = torch.tensor(effective[STEPS]) / torch.tensor(effective[0])
    assert gain.min() > 0.95
    assert gain.mean() > 1.2
    # The network itself is as it was.
    assert all(map(torch.equal, before, network.state_dict().values()))


@pytest.mark.parametrize(
    ("engine", "settings"),
    [("auto", AutomaticOptions(enough=0, pareto_k=math.inf)), ("amortized", AmortizedOptions())],
)
def test_engines_refine_each_person_alone(toy, recordings, network, engine, settings):
    options = InferenceOptions(engine, 50, settings, refine=2)
    unrefined = InferenceOptions(engine, 50, settings)
    together = infer(toy, recordings.select_people([0, 1]), options, 0, network)
    alone = infer(toy, recordings.select_people([0]), options, 0, network)
    plain = infer(toy, recordings.select_people([0]), unrefined, 0, network)
    assert together.engines == ("amortized",) * 2
    assert together.pareto_k is not None
    for name, value in alone.draws.items():
        assert torch.equal(together.draws[name][:, :1], value)
    assert not torch.equal(alone.draws["in_sight"], plain.draws["in_sight"])


def test_weights_of_a_residual_have_a_guide_beside_it():
    human = HumanModel(load_self_model(shipped_weights("driving"))[0])
    some = load_demonstrations(asset_path("driving_fog_paper.nc"))
    some = some.select_people([0]).select_rounds([0])
    options = InferenceOptions("amortized", 10, refine=2)
    found = infer(human, some, options, 0, network_for("amortized", None, human))
    assert found.draws["residual_out"].shape[:3] == (10, 1, 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"engine": "svi"}, "refining is for the engines auto and amortized, not svi"),
        ({"engine": "importance"}, "refining is for the engines auto and amortized, not imp"),
        ({"refine": -1}, "refine must be at least 0, not -1"),
    ],
)
def test_what_cannot_be_refined(options, message):
    with pytest.raises(ValueError, match=message):
        InferenceOptions(**{"refine": 3} | options)


def test_without_a_network_nothing_is_refined(toy, recordings):
    with pytest.raises(InputError, match="refining needs its network, not None"):
        infer(toy, recordings, InferenceOptions(refine=3), 0)


def test_the_command_refuses_it_in_one_line(capsys):
    assert command(fit, "--guide", "nuts", "--refine", 5) == 2
    assert "--refine is for --guide auto and amortized" in capsys.readouterr().err
    assert command(fit, "--refine", -5) == 2
    assert "--refine must be at least 0, not -5" in capsys.readouterr().err


def test_the_command_refines(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    some = load_demonstrations(asset_path("driving_fog_paper.nc"))
    save_demonstrations("one.nc", some.select_people([0]).select_rounds([0, 1]))
    given = ("--demos", "one.nc", "--train-rounds", 1, "--draws", 4, "--explore", 0)
    assert command(fit, *given, "--refine", 2) == 0
    assert not list(tmp_path.glob("**/*checkpoint*"))
