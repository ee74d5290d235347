"""Fits by stochastic variational inference: where they start, go on, give up and end."""

import re
from dataclasses import replace

import pyro
import pytest
import torch
from example_combinations import fixed_policy, some_policy
from example_views import Sure

from mirror_ppl.errors import CheckpointError
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.results.fitting import fit_people
from mirror_ppl.inference.svi import SVIOptions, _prune, continuous_guide, fit_implants
from mirror_ppl.likelihood.combinations import log_priors
from mirror_ppl.likelihood.compiled import ViewTables
from mirror_ppl.likelihood.table_program import log_likelihoods
from mirror_ppl.likelihood.tables import build_view_table, combination_scores
from mirror_ppl.likelihood.view_table import NO_VIEW
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.progress import silent

TINY = SVIOptions(steps=6, checkpoint_every=2, prune_every=2, prune_margin=1.0)
TINY_SVI = InferenceOptions("svi", 9, TINY)


def tiny(few, table, seed=3, report=silent, checkpoint=None):
    return fit_implants(ViewTables(few, table), TINY, 9, seed, report, checkpoint)


def assert_same(one, other):
    assert one.losses == other.losses
    assert list(one.draws) == list(other.draws)
    for name, value in one.draws.items():
        assert torch.equal(value, other.draws[name]), name


def stop_at(step):
    def report(name, done, total, message):
        if (name, done) == ("fit", step):
            raise KeyboardInterrupt

    return report


@pytest.fixture(scope="module")
def tiny_fit(few, table):
    return tiny(few, table)


def test_vectors_start_as_wide_as_their_prior_and_single_numbers_narrow(few, table):
    guide = continuous_guide(ViewTables(few, table))
    expected = {"residual_in": 48**-0.5, "residual_out": 0.1}
    for name in ("consistency", "lapse"):
        torch.testing.assert_close(getattr(guide.scales, name), torch.full((3, 1), 0.1))
    for name, scale in expected.items():
        found = getattr(guide.scales, name)
        assert found.shape[:2] == (3, 1)
        # Estimated from 100 draws of three people: 4 standard errors are a quarter of it or less.
        assert found.mean().item() == pytest.approx(scale, rel=0.25)
    centre = guide.median()
    assert (centre["consistency"] - 3.0).abs().max() < 1.0  # the median of 15 draws
    assert centre["lapse"].max() < 0.1


def test_fit_depends_on_its_seed_alone(few, table, tiny_fit):
    torch.manual_seed(5)
    state = torch.random.get_rng_state()
    assert_same(tiny(few, table), tiny_fit)
    assert torch.equal(torch.random.get_rng_state(), state)
    other = tiny(few, table, seed=4)
    assert other.losses != tiny_fit.losses
    assert len(other.losses) == 6
    assert not list(pyro.get_param_store().keys())


@pytest.mark.parametrize("stop", [3, 5, 6])
def test_fit_goes_on_from_its_checkpoint_as_if_never_stopped(few, table, tiny_fit, tmp_path, stop):
    checkpoint, steps = (tmp_path / "fit.checkpoint", "this run"), []
    with pytest.raises(KeyboardInterrupt):
        tiny(few, table, 3, stop_at(stop), checkpoint)

    def report(name, done, total, message):
        if name == "fit":
            steps.append(done)

    resumed = tiny(few, table, 3, report, checkpoint)
    assert steps == list(range(2 * ((stop - 1) // 2), 7))
    assert_same(resumed, tiny_fit)
    # Killed after the last step, before the results were written: only the draws are made again.
    steps.clear()
    assert_same(tiny(few, table, 3, report, checkpoint), tiny_fit)
    assert steps == [6]


def test_checkpoint_of_another_fit_is_refused(few, recordings, tmp_path):
    path = tmp_path / "fit.checkpoint"
    some = recordings.select_people([0]).select_rounds(range(2))

    def fit(human=few, demonstrations=some, options=TINY_SVI, seed=0, report=lambda *done: None):
        fit_people(human, demonstrations, options, seed, 2, report, path)

    with pytest.raises(KeyboardInterrupt):
        fit(report=stop_at(3))
    content = path.read_bytes()
    for other in (
        {"seed": 1},
        {"options": replace(TINY_SVI, draws=10)},
        {"human": Sure(few.self_model)},
        {"demonstrations": recordings.select_people([1]).select_rounds(range(2))},
    ):
        with pytest.raises(CheckpointError, match="belongs to a run with other"):
            fit(**other)
        assert path.read_bytes() == content
    for damaged in (content[: len(content) // 2], b"", b"nonsense"):
        path.write_bytes(damaged)
        with pytest.raises(CheckpointError, match=re.escape(str(path))):
            fit()


def test_pruning_gives_up_whoever_is_hopeless(few, table):
    policy = some_policy(few, 3)
    one = {name: value[None] for name, value in policy.items()}
    score = combination_scores(table, log_likelihoods(few, policy, table))
    score = score + log_priors(few, table.grid, one, 3)[0]
    behind = score.amax(-1, keepdim=True) - score
    margin = behind[behind > 0].median().item() + 1e-3
    compiled = ViewTables(few, table)
    _prune(compiled, lambda: policy, margin)
    pruned = compiled.table
    alive = (pruned.index != NO_VIEW).any(1)
    assert torch.equal(alive, behind <= margin)
    assert alive[1].sum() >= alive.sum(1).max()  # nothing is known of them but the prior
    assert 0 < (~alive).sum() < alive.sum()
    # Whoever was given up is never drawn.
    given = {name: value.expand(20, *value.shape) for name, value in policy.items()}
    combination = pruned.combination(compiled.sample_discrete(given))[..., 0]
    some = torch.tensor([0, 2])  # the other one has no rounds, of which views could be given up
    assert alive[some.expand(20, 2), combination[:, some]].all()


def test_fit_recovers_consistency_and_reach(few, generator):
    # One decides nearly at random, the other nearly perfectly; they see 1 cell and everything.
    known = fixed_policy(2, torch.tensor([[0.5], [6.0]]))
    known |= {"sight_front_own": torch.tensor([[1], [6]]), "assumes_clear": torch.ones(2, 1)}
    table = build_view_table(few, play_rounds(few, known, 8, "fog", generator))
    posterior = fit_implants(ViewTables(few, table), SVIOptions(steps=60), 200, seed=0)
    low, high = posterior.draws["consistency"][..., 0].unbind(1)
    assert low.quantile(0.95) < high.quantile(0.05)
    assert sum(posterior.losses[-10:]) < sum(posterior.losses[:10])
    assert (posterior.draws["sight_front_own"][:, 1, 0] >= 4).float().mean() > 0.9


def test_people_without_discrete_implants_can_be_fitted(self_model, recordings):
    human = Sure(self_model)
    some = recordings.select_people([0, 1]).select_rounds(range(3))
    fit = fit_people(human, some, TINY_SVI, seed=0, train_rounds=2)
    assert set(fit.posterior.draws) == {"consistency", "lapse", "residual_in", "residual_out"}
    assert [list(person["implants"]) for person in fit.summary["people"]] == [
        ["consistency", "lapse"]
    ] * 2


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("steps", 0, "steps must be at least 1, not 0"),
        ("prune_every", -3, "prune_every must be at least 1, not -3"),
        ("learning_rate", 0.0, "learning_rate must be above 0 and at most 1, not 0.0"),
    ],
)
def test_impossible_options_are_refused(name, value, message):
    with pytest.raises(ValueError, match=message):
        SVIOptions(**{name: value})


def test_people_are_fitted_in_batches_that_do_not_depend_on_each_other(
    few, recordings, tmp_path, monkeypatch
):
    from mirror_ppl.inference import batches

    human = few
    recordings = recordings.select_rounds([0]).select_people([0, 1, 2])
    options = InferenceOptions("svi", 6, SVIOptions(steps=4, checkpoint_every=2))
    monkeypatch.setattr(batches, "PEOPLE_AT_ONCE", 2)
    found = infer(human, recordings, options, 3)
    first = infer(human, recordings.select_people([0, 1]), options, 3)
    last = infer(human, recordings.select_people([2]), options, 3 + 2)
    for name, value in found.draws.items():
        assert torch.equal(value, torch.cat([first.draws[name], last.draws[name]], 1))
    assert found.losses == pytest.approx(
        [one + other for one, other in zip(first.losses, last.losses, strict=True)]
    )
    # Stopped in the second batch and continued, it is the same, and leaves one file.
    path = tmp_path / "some.checkpoint"

    def stop(name, done, total, message):
        if name == "fit" and done == 3 and (tmp_path / "some.checkpoint.2").exists():
            raise KeyboardInterrupt

    def refuse(name, done, total, message):
        raise AssertionError("work was begun")

    with pytest.raises(KeyboardInterrupt):
        infer(human, recordings, options, 3, report=stop, checkpoint=(path, "run"))
    assert len(list(tmp_path.iterdir())) == 2
    again = infer(human, recordings, options, 3, checkpoint=(path, "run"))
    assert all(torch.equal(again.draws[name], value) for name, value in found.draws.items())
    path.write_bytes(b"nonsense")
    with pytest.raises(CheckpointError):
        infer(human, recordings, options, 3, checkpoint=(tmp_path / "some.checkpoint", "run"))
    with pytest.raises(CheckpointError):  # of the second batch, before the first is begun
        infer(human, recordings, options, 3, report=refuse, checkpoint=(path, "another"))
