"""Moments that likely policies do not tell apart, merged in tables and during sampling."""

import pytest
import torch
from example_views import Few

from mirror_ppl.inference import ImportanceOptions, sampler
from mirror_ppl.inference.adaptive_importance import sample_importance
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.likelihood.densities import choices
from mirror_ppl.likelihood.enumeration import conditioned, log_joints
from mirror_ppl.likelihood.merged_moments import merged_for
from mirror_ppl.likelihood.tables import build_view_table
from mirror_ppl.likelihood.view_table import NO_VIEW
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.randomness import seed_everything

POLICIES = 6


@pytest.fixture(scope="module")
def human(self_model):
    return Few(self_model)


@pytest.fixture(scope="module")
def rounds(recordings):
    return recordings.select_people([0]).select_rounds([0, 1, 2, 3])


@pytest.fixture(scope="module")
def table(human, rounds):
    return build_view_table(human, rounds)


@pytest.fixture(scope="module")
def policies(human, table):
    drawn = draw_prior(human, 1, POLICIES, 0)
    return {name: value for name, value in drawn.items() if name not in table.sites}


def of_steps(human, table, policies):
    """Log-probability of the recorded action at each step of each view, ``[S, V, T]``."""
    with conditioned(policies, POLICIES, 1):
        _, found = choices(human, human.prior(), table.belief, table.values, table.acted)
    return found[:, 0, table.moments[0].clamp(min=0)].masked_fill(table.moments[0] == NO_VIEW, 0)


@pytest.mark.parametrize("resolution", [1e-6, 0.1, 1.0])
def test_a_step_is_off_by_no_more_than_the_grid(human, table, policies, resolution):
    found = merged_for(human, table, policies, resolution)
    before, after = (of_steps(human, one, policies) for one in (table, found))
    # Views in the order of combinations, since equal views are merged.
    worst = 0.0
    for number in range(table.rounds):
        one, other = (part.index[0, number] for part in (table, found))
        worst = max(worst, float((before[:, one] - after[:, other]).abs().max()))
    assert worst <= resolution + 1e-5
    if resolution > 0.01:
        assert worst > resolution / 4
        assert found.acted.numel() < table.acted.numel() / 2
    joints = [log_joints(human, one, policies) for one in (table, found)]
    assert float((joints[0] - joints[1]).abs().max()) <= resolution * int(table.steps.sum()) + 1e-3


def test_moments_of_other_rounds_and_actions_stay_apart(human, table, policies):
    """However alike: on a grid this coarse, one moment of each action is left of each round."""
    found = merged_for(human, table, policies, 1e6)
    of_rounds = [
        {action for action in table.recorded[0, number][real].tolist()}
        for number, real in enumerate(table.steps[0])
    ]
    assert found.acted.numel() == sum(map(len, of_rounds))
    assert found.moments.shape[1] == table.rounds


def test_one_view_of_each_combination_is_kept(human, table, policies):
    found = merged_for(human, table, policies, 0.1)
    assert torch.equal(found.index == NO_VIEW, table.index == NO_VIEW)
    acted = [one.acted[0][one.moments[0].clamp(min=0)] for one in (table, found)]
    real = [one.moments[0] != NO_VIEW for one in (table, found)]
    for combination in range(table.index.shape[-1]):
        for number in range(table.rounds):
            one, other = (part.index[0, number, combination] for part in (table, found))
            assert torch.equal(real[0][one], real[1][other])
            assert torch.equal(acted[0][one][real[0][one]], acted[1][other][real[1][other]])


def sampled(human, table, **options):
    seed_everything(0)
    return sample_importance(human, table, ImportanceOptions(enough=1e9, stages=2, **options))


def test_the_evidence_hardly_changes(human, table, monkeypatch):
    """With the same random numbers up to the merging, which a small table does not need."""
    alone = sampled(human, table)
    merged, done = [], sampler.merged_for

    def merging(*given):
        merged.append(done(*given))
        return merged[-1]

    monkeypatch.setattr(sampler, "merged_for", merging)
    again = sampled(human, table)
    assert not merged
    assert again.log_evidence == alone.log_evidence
    monkeypatch.setattr(sampler, "MANY_MOMENTS", 1)
    found = sampled(human, table)
    assert len(merged) == 1
    assert merged[0].acted.numel() < table.acted.numel()
    spread = (found.evidence_error**2 + alone.evidence_error**2) ** 0.5
    assert found.log_evidence == pytest.approx(alone.log_evidence, abs=4 * spread)
    never = sampled(human, table, resolution=0)
    assert len(merged) == 1
    assert never.log_evidence == alone.log_evidence


@pytest.mark.parametrize("screened", [True, False])
def test_without_screening_nothing_is_merged(human, rounds, screened, monkeypatch):
    monkeypatch.setattr(sampler, "MANY_MOMENTS", 1)
    called = []
    monkeypatch.setattr(sampler, "merged_for", lambda *given: called.append(1) or given[1])
    settings = ImportanceOptions(proposals=64, stages=1, enough=1e9)
    options = {} if screened else {"screening": None}
    infer(human, rounds, InferenceOptions("importance", 8, settings, **options), 0)
    assert bool(called) == screened
