"""The engine `auto`: who is inferred by the network, who is not, and that it is told."""

from dataclasses import replace

import pytest
import torch

import mirror_ppl
from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.inference import automatic
from mirror_ppl.inference.adaptive_importance import ImportanceOptions
from mirror_ppl.inference.amortized import AmortizedOptions
from mirror_ppl.inference.amortized_guide import AmortizedGuide, reference_places
from mirror_ppl.inference.automatic import AutomaticOptions
from mirror_ppl.inference.calibration.study import prior_people
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.toy import ToyHuman
from mirror_ppl.models.weights import load_self_model, shipped_weights

QUICK = AutomaticOptions(
    AmortizedOptions(256, ImportanceOptions(256, 100.0)), ImportanceOptions(256, 100.0), enough=50
)


@pytest.fixture(scope="module")
def toy():
    return ToyHuman(load_self_model(shipped_weights("driving"))[0])


@pytest.fixture(scope="module")
def recordings(toy):
    generator = torch.Generator().manual_seed(3)
    return play_rounds(toy, prior_people(toy, 3, generator), 2, "fog", generator)


@pytest.fixture(scope="module")
def network(toy):
    """Not trained: what it proposes is corrected, and draws of the prior are there, too."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return AmortizedGuide(reference_places(toy))


def found_by(toy, recordings, network, settings=QUICK, engine="auto", **more):
    return infer(toy, recordings, InferenceOptions(engine, 50, settings), 0, network, **more)


def same(one, other):
    assert torch.equal(one.pareto_k, other.pareto_k)
    return all(torch.equal(value, other.draws[name]) for name, value in one.draws.items())


def test_who_the_network_serves_is_inferred_as_by_amortized(toy, recordings, network):
    found = found_by(toy, recordings, network, replace(QUICK, enough=0, pareto_k=float("inf")))
    assert found.engines == ("amortized",) * 3
    assert same(found, found_by(toy, recordings, network, QUICK.amortized, "amortized"))


@pytest.mark.parametrize("limit", [{"enough": 1e6}, {"pareto_k": -1e6}])
def test_who_it_does_not_serve_is_inferred_by_importance(toy, recordings, network, limit):
    found = found_by(toy, recordings, network, replace(QUICK, **limit))
    assert found.engines == ("importance",) * 3


def test_without_a_network_everybody_is_inferred_by_importance(toy, recordings):
    found = found_by(toy, recordings, None)
    assert found.engines == ("importance",) * 3
    assert same(found, found_by(toy, recordings, None, QUICK.importance, "importance"))


def test_each_person_is_judged_alone(toy, recordings, network, monkeypatch):
    """Also by a run that goes on after it was stopped."""
    doubtful = []

    def sometimes(*given):
        found = automatic.amortized.sample_amortized(*given)
        doubtful.append(len(doubtful))
        return replace(found, pareto_k=1.0) if doubtful[-1] % 2 else replace(found, pareto_k=0.0)

    monkeypatch.setattr(automatic, "sample_amortized", sometimes)
    whole = found_by(toy, recordings, network, replace(QUICK, enough=0))
    assert whole.engines == ("amortized", "importance", "amortized")


def test_a_resumed_run_knows_the_engine_of_each_person(toy, recordings, network, tmp_path):
    checkpoint = (tmp_path / "checkpoint", "this run")

    def stop(name, done, total, message):
        if done == 2:
            raise KeyboardInterrupt

    never = replace(QUICK, enough=1e6)
    always = replace(QUICK, enough=0, pareto_k=float("inf"))
    with pytest.raises(KeyboardInterrupt):
        found_by(toy, recordings, network, never, report=stop, checkpoint=checkpoint)
    found = found_by(toy, recordings, network, always, checkpoint=checkpoint)
    assert found.engines == ("importance", "importance", "amortized")


def test_a_fit_reports_the_engine_of_each_person():
    people = load_demonstrations(asset_path("driving_fog_paper.nc")).select_rounds([0])
    one = people.select_people(["person-01"])
    fit = mirror_ppl.infer(one, draws=5, explore=0)
    assert fit.summary["people"][0]["engine"] in ("amortized", "importance")
    # No network ships for this human model.
    fit = mirror_ppl.infer(one, human="one-radius", draws=5, explore=0)
    assert fit.summary["people"][0]["engine"] == "importance"
