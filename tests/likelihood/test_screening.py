"""Screening and merging: which combinations and moments are given up."""

import math

import pyro
import pytest
import torch
from example_person import Averaging
from example_views import (
    LENGTHS,
    Few,
    Sure,
    assert_rounds_equal,
    ragged,
)

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.inference.sampler import Sampler
from mirror_ppl.likelihood import likely_policies
from mirror_ppl.likelihood.combinations import log_priors
from mirror_ppl.likelihood.likely_policies import LikelyPolicies
from mirror_ppl.likelihood.policies import draw_policies
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.table_program import log_likelihoods
from mirror_ppl.likelihood.tables import (
    build_view_table,
    combination_scores,
    restricted,
    rounds_of,
    views_of,
)
from mirror_ppl.likelihood.view_table import NO_VIEW
from mirror_ppl.likelihood.view_table_builder import GROWTH, ViewTableBuilder
from mirror_ppl.models import HumanModel
from mirror_ppl.models.family import Preferring
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.randomness import forked


@pytest.fixture(scope="module")
def recordings():
    return load_demonstrations(asset_path("driving_fog_diverse.nc"))


def test_infinite_margin_without_merging_changes_nothing(self_model, recordings):
    rounds = ragged(recordings, LENGTHS)
    for human in (Few(self_model), Sure(self_model)):
        screening = Screening(margin=math.inf, resolution=0.0)
        assert_rounds_equal(
            build_view_table(human, rounds, screening=screening), build_view_table(human, rounds)
        )


@pytest.mark.parametrize(("margin", "early"), [(0.7, 0.0), (2.0, 1.5), (15.0, 25.0)])
def test_screening_drops_whoever_falls_behind_and_never_the_best(
    self_model, recordings, monkeypatch, margin, early
):
    """Under draws from the prior alone; the next test is of those near the person."""
    monkeypatch.setattr(likely_policies, "FIRST", 99)
    human, screening = Few(self_model), Screening(margin=margin, early=early, resolution=0.0)
    rounds = recordings.select_rounds(range(4))
    whole = build_view_table(human, rounds)
    with pyro.plate("policy", screening.policies, dim=-3), pyro.plate("person", 1, dim=-2):
        torch.manual_seed(screening.seed)
        ways = human.prior()
    likelihood = log_likelihoods(human, ways, whole)
    grid = whole.grid
    others = {name: value for name, value in ways.items() if name not in grid}
    prior = log_priors(human, grid, others, 1)
    expected = torch.ones(rounds.num_people, 14, dtype=torch.bool)
    score = torch.zeros(screening.policies, rounds.num_people, 14)
    for number in range(4):
        score += likelihood.gather(-1, whole.index[:, number].expand(screening.policies, -1, -1))
        if 0 < number < GROWTH:
            continue  # these are gone through together
        best = (score + prior).amax(0).masked_fill(~expected, -math.inf)
        distance = best.amax(-1, keepdim=True) - best
        # Rounding may decide either way at the very margin; nobody is there here.
        allowed = screening.margin_after(number + 1)
        assert (distance - allowed).abs().min() > 1e-3
        expected &= distance <= allowed
        # The best one so far stays.
        assert expected.gather(-1, best.argmax(-1, keepdim=True)).all()
    screened = build_view_table(human, rounds, screening=screening)
    assert torch.equal((screened.index != NO_VIEW).all(1), expected)
    assert_rounds_equal(screened, restricted(whole, expected))
    dropped = 1 - expected.float().mean().item()
    assert (dropped > 0.05) if margin < 15 else (dropped < 1)
    # With the margin that is used, the best of all rounds is never among the dropped.
    best = (score + prior).amax(0).argmax(-1, keepdim=True)
    assert margin < 15 or expected.gather(-1, best).all()


def scores_under(human, policies, table, grid):
    """Log-likelihoods ``[S, M]`` of combinations under policies, and log priors ``[S, M]``."""
    others = {site: own for site, own in policies.items() if site not in grid}
    number = len(next(iter(others.values())))
    with (
        pyro.condition(data=others),
        pyro.plate("policy", number, dim=-3),
        pyro.plate("person", 1, dim=-2),
    ):
        likelihoods = log_likelihoods(human, human.prior(), table)
    return combination_scores(table, likelihoods)[:, 0], log_priors(human, grid, others, 1)[:, 0]


def test_policies_near_the_person_are_the_most_probable_ones(self_model, recordings):
    """Chosen from all draws by their likelihood under all combinations, which are few here; then
    rounds add up, and twice as many rounds choose anew."""
    human, own = Few(self_model), recordings.select_people([1])
    table = build_view_table(human, own.select_rounds(range(4)))
    grid = table.grid
    # Views are numbered from round to round.
    rounds = [
        (views_of(table, 0).kept(views.unique()), (torch.arange(14), views - views.min()))
        for views in table.index[0]
    ]
    found, every, best = LikelyPolicies(human, grid, 5), torch.arange(14), torch.arange(14.0)
    assert found.log_joint(rounds[:1], every, best).shape == (0, 14) and not found.policies
    joint = found.log_joint(rounds, every, best)
    pool = draw_policies(human, grid, likely_policies.POOL, 5)
    score, _ = scores_under(human, pool, table, grid)
    likely = score.logsumexp(-1).topk(likely_policies.CHOSEN).indices
    chosen = dict(found.policies)
    assert all(torch.equal(value, pool[site][likely]) for site, value in chosen.items())
    score, prior = scores_under(human, chosen, table, grid)
    torch.testing.assert_close(joint, score + prior, rtol=1e-4, atol=1e-3)
    more = found.log_joint([*rounds, rounds[0]], every, best)
    again, _ = scores_under(human, chosen, build_view_table(human, own.select_rounds([0])), grid)
    torch.testing.assert_close(more, joint + again, rtol=1e-4, atol=1e-3)
    assert all(found.policies[site] is chosen[site] for site in chosen)
    found.log_joint([*rounds, rounds[0], *rounds[:3]], every, best)
    assert any(found.policies[site] is not chosen[site] for site in chosen)


def test_policies_near_the_person_are_chosen_among_distinct_draws(self_model):
    """A factor leaves few prior draws, of which resampling takes some several times."""

    class Careful(HumanModel):
        def prior(self):
            implants = super().prior()
            pyro.factor("careful", -30 * (implants["lapse"] - 0.01).abs())
            return implants

    human = Careful(self_model)
    found = {
        distinct: draw_policies(human, {}, 256, 0, distinct)["consistency"].unique()
        for distinct in (False, True)
    }
    assert len(found[False]) < len(found[True]) == 256


def test_whom_the_robots_values_hardly_move_keeps_their_thresholds(self_model):
    """Prior draws alone leave 19 of 9,604 combinations, without the true one."""
    human = Preferring(self_model)
    implants = {site: value[0] for site, value in draw_prior(human, 1, 1, 209).items()}
    implants["shares_goal"] = torch.full((1, 1), 0.05)
    rounds = play_rounds(human, implants, 20, "fog", torch.Generator().manual_seed(209))
    builder = ViewTableBuilder(human, Screening())
    builder.add(rounds_of(rounds, 0))
    true = torch.stack([grid == implants[site] for site, grid in builder.grid.items()])[:, 0]
    assert int(true.all(0).nonzero()) in builder.alive.tolist()
    # They are not pruned, either, by prior draws that the person does not resemble.
    with torch.no_grad(), forked():
        torch.manual_seed(0)
        sampler = Sampler(human, builder.table())
        sampler.draw(64)
        sampler.prune(12.0)
    assert int(true.all(0).nonzero()) in sampler.combinations.members.tolist()


def test_what_one_round_contradicts_is_kept_until_others_agree(self_model, recordings):
    """A round that leaves one combination 20 nats behind drops it only without other rounds."""
    human = Few(self_model)
    for early, kept in ((0.0, False), (25.0, True)):
        builder = ViewTableBuilder(human, Screening(early=early))
        builder.add(rounds_of(recordings.select_rounds([0]), 0))
        builder.alive = torch.arange(14)
        builder.score.zero_()
        found = torch.zeros_like(builder.score)
        found[:, 3] = -20.0
        builder._screen(found, builder.screening)
        assert (3 in builder.alive.tolist()) == kept
        builder._likely = None
        builder._rounds *= 20
        builder._screen(torch.zeros_like(builder.score)[:, builder.alive], builder.screening)
        assert 3 not in builder.alive.tolist()


@pytest.mark.parametrize("kind", [HumanModel, Averaging], ids=["own", "averaging"])
def test_merging_moves_likelihoods_by_at_most_the_resolution(self_model, recordings, kind):
    human, rounds = kind(self_model), ragged(recordings, [[15, 9]])
    resolution = 0.1
    screening = Screening(margin=math.inf, resolution=resolution, merge_policies=8)
    whole, merged = ViewTableBuilder(human, None), ViewTableBuilder(human, screening)
    for builder in (whole, merged):
        builder.add(rounds_of(rounds, 0))
    tables = [builder.table() for builder in (whole, merged)]
    policies = merged.policies
    scores = []
    for table in tables:
        with (
            pyro.condition(data=policies),
            pyro.plate("policy", screening.policies, dim=-3),
            pyro.plate("person", 1, dim=-2),
        ):
            likelihoods = log_likelihoods(human, human.prior(), table)
        scores.append(combination_scores(table, likelihoods)[:, 0])
    torch.testing.assert_close(scores[1], merged.score, rtol=1e-4, atol=1e-3)
    off = (scores[1] - scores[0]).abs().amax(-1)
    # Under policies that are compared, both are within half a step of one point, at every moment.
    assert off[: screening.merge_policies].max() <= (15 + 9) * resolution
    assert off.max() > 1e-3 and off[screening.merge_policies :].mean() < 0.5
    assert (tables[1].index != NO_VIEW).all()
    number = [table.belief.shape[1] for table in tables]
    assert number[1] < 0.3 * number[0]
