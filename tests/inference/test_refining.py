"""Refining: variational inference that starts where another guide ended."""

from functools import partial

import pytest
import torch
from running import command

from mirror_ppl import fit
from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.inference import batches, svi
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.marginal_elbo import elbo_of
from mirror_ppl.inference.svi import SVIOptions, continuous_guide, own_parameters
from mirror_ppl.likelihood.compiled import compile
from mirror_ppl.models.variants import PerceptualOnly, PolicyOnly
from mirror_ppl.models.weights import load_self_model, shipped_weights


@pytest.fixture(scope="module")
def human():
    return PerceptualOnly(load_self_model(shipped_weights("driving"))[0])


@pytest.fixture(scope="module")
def recordings():
    whole = load_demonstrations(asset_path("driving_fog_paper.nc"))
    return whole.select_people([0, 1, 2]).select_rounds(range(3))


def test_the_guide_starts_at_the_draws(human):
    recordings = load_demonstrations(asset_path("driving_fog_paper.nc"))
    policy = PolicyOnly(human.self_model)
    two = recordings.select_people([0, 1]).select_rounds([0])
    guide = continuous_guide(compile(policy, two))
    before = {name: value.detach().clone() for name, value in guide.state_dict().items()}
    draws = {
        "consistency": torch.tensor([[2.0, 3.0], [2.0, 6.0]])[..., None],
        "lapse": torch.tensor([[0.1, 0.5], [0.1, 0.5]])[..., None],
    }
    draws |= {name: torch.zeros(2, 2, 1, 9, 9) for name in ("residual_in", "residual_out")}
    guide.start_at(draws)
    loc, scale = guide._get_loc_and_scale("consistency")
    torch.testing.assert_close(loc.flatten(), draws["consistency"].log().mean(0).flatten())
    spread = draws["consistency"].log().std(0).flatten().clamp(min=0.01)
    torch.testing.assert_close(scale.flatten(), spread)
    loc, _ = guide._get_loc_and_scale("lapse")
    assert loc.flatten().tolist() == pytest.approx([-2.1972, 0.0], abs=1e-4)
    # Of weights the prior is better than draws.
    after = guide.state_dict()
    weights = [name for name in before if "residual" in name]
    assert weights and all(torch.equal(after[name], before[name]) for name in weights)


def test_refining_starts_near_the_end(human):
    """The bound of a single draw at the fresh start has a standard deviation of 27 nats."""
    whole = load_demonstrations(asset_path("driving_fog_paper.nc"))
    rounds = whole.select_people(range(5)).select_rounds(range(20))
    found = infer(human, rounds, InferenceOptions(draws=50, refine=30), seed=0)
    options = InferenceOptions("svi", 50, settings=SVIOptions(steps=150))
    fresh = infer(human, rounds, options, seed=0)
    assert len(found.losses) == 30
    assert found.pareto_k is None
    compiled = compile(human, rounds)
    with own_parameters(0):
        guide, elbo = continuous_guide(compiled), elbo_of(compiled)
        begun = sum(elbo.loss(compiled.program, guide) for _ in range(60)) / 60
    ended = sum(fresh.losses[-20:]) / 20
    assert begun - ended > 20
    assert sum(found.losses[:10]) / 10 - ended < 0.3 * (begun - ended)
    assert found.draws["consistency"].shape == (50, 5, 1)
    assert found.draws.keys() == fresh.draws.keys()


def test_refining_of_many_is_done_in_batches(human, recordings, monkeypatch):
    monkeypatch.setattr(batches, "PEOPLE_AT_ONCE", 2)
    found = infer(human, recordings, InferenceOptions(draws=8, refine=2), seed=0)
    assert found.draws["lapse"].shape == (8, 3, 1)


def test_refining_continues(human, recordings, tmp_path, monkeypatch):
    monkeypatch.setattr(svi, "SVIOptions", partial(SVIOptions, checkpoint_every=2))
    options = InferenceOptions(draws=8, refine=4)
    file = tmp_path / "fit.checkpoint"
    first = infer(human, recordings, options, 0, checkpoint=(file, "run"))
    assert (tmp_path / "fit.checkpoint.refined").exists()
    again = infer(human, recordings, options, 0, checkpoint=(file, "run"))
    assert again.losses == first.losses


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"engine": "svi", "refine": 3},
            "refining is for the engines auto, importance and amortized, not svi",
        ),
        ({"refine": -1}, "refine must be at least 0, not -1"),
    ],
)
def test_what_cannot_be_refined(options, message):
    with pytest.raises(ValueError, match=message):
        InferenceOptions(**options)


def test_the_command_refuses_it_in_one_line(capsys):
    assert command(fit, "--guide", "nuts", "--refine", 5) == 2
    assert "--refine is for --guide auto, importance and amortized" in capsys.readouterr().err
    assert command(fit, "--refine", -5) == 2
    assert "--refine must be at least 0, not -5" in capsys.readouterr().err


def test_the_command_refines(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    given = ("--train-rounds", 1, "--draws", 4, "--explore", 0, "--human-model", "perceptual-only")
    assert command(fit, *given, "--refine", 2) == 0
    assert not list(tmp_path.glob("**/*checkpoint*"))
