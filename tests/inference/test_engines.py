"""What engines have in common: weights, checkpoints, and models that are refused."""

from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_draws import bound, options_of
from running import command

from mirror_ppl.commands import fit, simulate
from mirror_ppl.errors import CheckpointError, HumanModelError, UnknownNameError
from mirror_ppl.inference.adaptive_importance import ImportanceOptions
from mirror_ppl.inference.calibration.study import prior_people
from mirror_ppl.inference.engines import InferenceOptions, infer, run_identity
from mirror_ppl.inference.nuts import NUTSOptions
from mirror_ppl.inference.results import fitting
from mirror_ppl.inference.sampler import Sampler
from mirror_ppl.inference.svi import SVIOptions
from mirror_ppl.likelihood.enumeration import acts_on_beliefs
from mirror_ppl.likelihood.tables import build_view_table
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.toy import RATES, ToyHuman, toy_posterior
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.training.guide import GuideOptions, simulate_examples


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


@pytest.fixture(scope="module")
def toy(self_model):
    return ToyHuman(self_model)


@pytest.fixture(scope="module")
def recordings(toy):
    generator = torch.Generator().manual_seed(3)
    return play_rounds(toy, prior_people(toy, 6, generator), 3, "fog", generator)


# --- weights ----------------------------------------------------------------------------------


def test_weights_do_not_depend_on_what_was_proposed(toy, recordings):
    table = build_view_table(toy, recordings.select_people([1]))
    exact = toy_posterior(toy, recordings.select_people([1]))
    for mean, width in ((0.0, 1.0), (-1.0, 2.0)):
        torch.manual_seed(0)
        sampler = Sampler(toy, table)
        sampler.draw(500)
        sampler.propose(dist.Normal(torch.full((2,), mean), width).to_event(1), 1500)
        found = sampler.weighted()
        for site in RATES:
            value = (found.log_weights.exp() * found.policy[site].flatten()).sum()
            off = abs(float(value - exact.mean(site)[0]))
            assert off < float(bound(exact.variance(site)[0], found.effective / 2))


def test_unreliable_weights_are_reported(toy, recordings):
    table = build_view_table(toy, recordings.select_people([1]))
    torch.manual_seed(0)
    sampler = Sampler(toy, table)
    sampler.draw(1)
    sampler.propose(dist.Normal(torch.full((2,), 6.0), 0.3).to_event(1), 400)
    assert sampler.weighted().pareto_k > 0.7


def test_pruning_leaves_the_posterior_as_it_is(toy, recordings):
    table = build_view_table(toy, recordings.select_people([0]))
    whole, pruned = Sampler(toy, table), Sampler(toy, table)
    for sampler in (whole, pruned):
        torch.manual_seed(0)
        sampler.draw(100)
    pruned.prune(0.5)
    kept = torch.isin(whole.combinations.first, pruned.combinations.first)
    assert 0 < int(kept.sum()) < len(whole.combinations)
    torch.manual_seed(1)
    policy, joint = whole._policies[0], whole._joints[0]
    assert torch.equal(pruned._joints[0], joint[:, kept])
    torch.testing.assert_close(pruned._joint(policy, len(joint)), joint[:, kept])
    behind = (joint.max() - joint).amin(0)
    assert torch.equal(kept, behind <= 0.5)


@pytest.mark.filterwarnings("ignore::mirror_ppl.errors.UnreadSite")
@pytest.mark.parametrize("guide", ["importance", "svi"])
def test_models_with_little_to_infer(toy, recordings, guide):
    """Sight alone, and an implant that actions do not depend on."""
    some, few = recordings.select_people([0]), SVIOptions(steps=2) if guide == "svi" else None

    class OnlySight(ToyHuman):
        def act(self, implants, belief, values):
            rate = torch.where(belief[..., 0] > 0, 0.8, 0.1)
            return torch.stack([torch.log1p(-rate), torch.log(rate)], -1)

    class OnlyReach(OnlySight):
        def prior(self):
            like = next(self.self_model.parameters())
            bins = like.new_ones(7) / 7
            return {"reach": pyro.sample("reach", dist.Categorical(bins))}

    human = OnlySight(toy.self_model)
    draws = infer(human, some, InferenceOptions(guide, 40, few), 0).draws
    assert draws["reach"].shape == draws["in_sight"].shape == (40, 1, 1)
    if guide == "importance":  # svi needs a continuous site for its guide
        draws = infer(OnlyReach(toy.self_model), some, InferenceOptions(guide, 40), 0).draws
        assert list(draws) == ["reach"] and draws["reach"].shape == (40, 1, 1)


def test_a_prior_that_depends_on_what_is_seen_is_refused(toy, recordings):
    class Hierarchical(ToyHuman):
        def prior(self):
            implants = super().prior()
            far = (implants["reach"] > 2).float()
            return implants | {"depends": pyro.sample("depends", dist.Beta(1 + far, 2 - far))}

    human = Hierarchical(toy.self_model)
    for guide in ("importance", "svi"):
        with pytest.raises(HumanModelError, match='"depends" depends on a site'):
            infer(human, recordings, InferenceOptions(guide, 5), 0)


def test_people_whose_weights_cannot_be_relied_on_are_named(tmp_path, monkeypatch, capsys):
    def doubtful(*args):
        found = infer(*args)
        return replace(found, pareto_k=torch.tensor([0.9, 0.2]))

    monkeypatch.setattr(fitting, "infer", doubtful)
    (tmp_path / "toy.py").write_text(
        "from mirror_ppl.models.toy import ToyHuman\n\n\nclass Toy(ToyHuman):\n    pass\n"
    )
    demos = tmp_path / "some.nc"
    assert command(simulate, "--people", 2, "--rounds", 2, "--out", demos) == 0
    human = ("--human-model", f"{tmp_path / 'toy.py'}:Toy")
    small = ("--draws", 9, "--explore", 0)
    assert command(fit, "--demos", demos, *human, *small, "--out", tmp_path / "f") == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "not to be relied on for person-01 (Pareto k above 0.7)" in out


# --- checkpoints ------------------------------------------------------------------------------


def test_training_goes_on_where_it_was(toy, tmp_path):
    options = GuideOptions(people=12, rounds=(1, 2), steps=1, together=4)
    path = tmp_path / "guide.checkpoint"

    def stop(name, done, total, message):
        if done == 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_examples(toy, options, 0, stop, path)
    done = []
    whole = simulate_examples(toy, options, 0, lambda *told: done.append(told[1]), path)
    assert done == [8, 12]
    again = simulate_examples(toy, options, 0)
    for name, value in vars(again).items():
        assert torch.equal(getattr(whole, name), value), name
    with pytest.raises(CheckpointError, match="other options"):
        simulate_examples(toy, options, 1, checkpoint=path)
    # Nor is another model gone on with, even one of the same file.
    other = Other(toy.self_model)
    assert run_identity(Peeking(toy.self_model), None, []) != run_identity(other, None, [])
    with pytest.raises(CheckpointError, match="other options"):
        simulate_examples(other, options, 0, checkpoint=path)


def test_inference_goes_on_from_its_checkpoint(toy, recordings, tmp_path):
    run = (tmp_path / "fit.checkpoint", "this run")

    def stop(name, done, total, message):
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        infer(toy, recordings, options_of("importance"), 0, None, stop, run)
    done = []
    resumed = infer(
        toy, recordings, options_of("importance"), 0, None, lambda *told: done.append(told[1]), run
    )
    assert done == [4, 5, 6]  # person by person
    whole = infer(toy, recordings, options_of("importance"), 0)
    for name, value in whole.draws.items():
        assert torch.equal(resumed.draws[name], value)
    assert torch.equal(resumed.pareto_k, whole.pareto_k)
    # What another run has kept is not for this one.
    done.clear()
    another = (run[0], "another")
    infer(
        toy,
        recordings,
        options_of("importance"),
        0,
        report=lambda *told: done.append(told[1]),
        checkpoint=another,
    )
    assert done == list(range(7))


class Other(ToyHuman):
    """Has the toy person's program, and another name."""


class Peeking(ToyHuman):
    """Acts on what is within reach without believing in it."""

    def act(self, implants, belief, values):
        far = (implants["reach"] > 3)[..., None]
        seen = torch.where(far, 1.0, belief)
        return super().act(implants, seen, values)


@pytest.mark.parametrize(
    "options",
    [
        InferenceOptions("svi", 10, SVIOptions(steps=3)),
        InferenceOptions("nuts", 4, NUTSOptions(warmup=2)),
        InferenceOptions("importance", 10, ImportanceOptions(stages=0)),
        InferenceOptions("importance", 10, ImportanceOptions(stages=0), pooling="partial"),
    ],
    ids=["svi", "nuts", "importance", "pooled"],
)
def test_progress_of_new_work_begins_at_none(toy, recordings, options):
    """What is done at the first report is taken for that of an earlier run."""
    first, last = {}, {}

    def report(name, done, total, unit):
        del unit
        first.setdefault(name, done)
        last[name] = done, total

    infer(toy, recordings, options, 0, report=report)
    assert first and not any(first.values())
    assert all(done == total for done, total in last.values())


# --- what is refused --------------------------------------------------------------------------


def test_models_whose_views_are_not_enough_are_refused(self_model, recordings):
    human = Peeking(self_model)
    some = recordings.select_people([0]).select_rounds([0])
    table = build_view_table(human, some)
    assert not acts_on_beliefs(human, table.sites)
    assert acts_on_beliefs(ToyHuman(self_model), table.sites)
    with pytest.raises(HumanModelError, match="only the engines svi and nuts"):
        infer(human, some, InferenceOptions("importance"), 0)
    for engine, few in (("svi", SVIOptions(steps=2)), ("nuts", NUTSOptions(warmup=5))):
        draws = infer(human, some, InferenceOptions(engine, 50, few), 0).draws
        assert draws["reach"].shape == (50, 1, 1)


def test_guides_that_are_not_there(toy, recordings):
    with pytest.raises(UnknownNameError, match=r'unknown engine "magic"; known: .*importance'):
        InferenceOptions("magic")
    with pytest.raises(ValueError, match="draws must be from 1 to 100000, not 0"):
        InferenceOptions(draws=0)
    with pytest.raises(ValueError, match="needs its network"):
        infer(toy, recordings, InferenceOptions("amortized"), 0)
