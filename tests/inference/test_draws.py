"""Draws of implants follow their prior or exact posterior, and so do predictions."""

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from exact import log_joint
from example_combinations import COMBINATIONS, LENGTHS, PRIOR, SITES, some_policy
from example_views import Few, log_likelihoods_by_hand, policies
from scipy.stats import chi2

from mirror_ppl.domains import get_domain
from mirror_ppl.inference.svi import continuous_guide, draw_implants
from mirror_ppl.likelihood import compiled
from mirror_ppl.likelihood.compiled import Compiled, ViewTables
from mirror_ppl.likelihood.enumeration import draw_combinations
from mirror_ppl.likelihood.predictive import predict_actions
from mirror_ppl.likelihood.tables import build_view_table
from mirror_ppl.models.prior import draw_prior

DRIVING = get_domain("driving")
STEPS = DRIVING.horizon


class Moody(Few):
    """Few, with discrete sites before and after theirs that perception does not depend on."""

    def prior(self):
        mood = pyro.sample("mood", dist.Categorical(torch.tensor([0.2, 0.5, 0.3])))
        own = super().prior()
        return own | {"mood": mood, "bold": pyro.sample("bold", dist.Bernoulli(0.4))}

    def act(self, implants, belief, values):
        factor = 1 + implants["bold"] + implants["mood"]
        return super().act(
            {**implants, "consistency": implants["consistency"] * factor}, belief, values
        )


def assert_follows(draws, probabilities, tests=1):
    """Draws ``[S]`` of indices follow these probabilities, by a chi-square test.

    Wrong once in 10,000 for all of the ``tests`` together. Cells that expect fewer than 5 are
    taken together.
    """
    expected = probabilities.double() / probabilities.double().sum() * len(draws)
    counts = torch.bincount(draws.flatten(), minlength=len(expected)).double()
    rare = expected < 5
    parts = [expected[~rare], expected[rare].sum()[None]], [counts[~rare], counts[rare].sum()[None]]
    expected, counts = (torch.cat(part) for part in parts)
    assert counts[-1] <= 0 or expected[-1] > 1e-3 * counts[-1]
    statistic = ((counts - expected) ** 2 / expected.clamp(min=1.0)).sum().item()
    assert statistic < chi2.isf(1e-4 / tests, len(expected))


class Enumerated(ViewTables):
    """Draws discrete sites as programs do that are not compiled."""

    sample_discrete = Compiled.sample_discrete


def test_draws_of_combinations_follow_their_weights(few, table):
    joint = log_joint(few, table, some_policy(few))
    draws = draw_combinations(few, table, joint, 4000)
    assert draws["assumes_clear"].shape == (4000, 3, 1)
    combination = table.combination(draws)[..., 0]
    for person in range(3):
        assert_follows(combination[:, person], joint[person].softmax(-1), tests=3)


@pytest.mark.parametrize(("method", "calls"), [(ViewTables, 400), (Enumerated, 150)])
def test_both_ways_of_drawing_follow_the_exact_posterior(few, rounds, method, calls):
    table = build_view_table(few, rounds.select_people([0, 1]))
    policy = some_policy(few, 2)
    given = {name: value.expand(calls, *value.shape) for name, value in policy.items()}
    draws = method(few, table).sample_discrete(given)
    assert set(draws) == {*SITES, *policy}
    for name, value in policy.items():
        assert torch.equal(draws[name], value.expand(len(draws[name]), *value.shape))
    combination = table.combination(draws)[..., 0]
    joint = log_joint(few, table, policy)
    for person in range(2):
        assert_follows(combination[:, person], joint[person].softmax(-1), tests=4)


@pytest.mark.parametrize("at_once", [1, 100, 10**6])
def test_many_draws_are_drawn_as_one_by_one(few, rounds, seed, monkeypatch, at_once):
    monkeypatch.setattr(compiled, "AT_ONCE", at_once)
    whole = ViewTables(few, build_view_table(few, rounds.select_people([0, 1])))
    given = {
        name: value * torch.linspace(0.2, 1, 30).view(-1, *(1,) * value.dim())
        for name, value in some_policy(few, 2).items()
    }
    torch.manual_seed(seed)
    found = whole.sample_discrete(given)
    torch.manual_seed(seed)
    each = [whole.sample_discrete({n: v[[d]] for n, v in given.items()}) for d in range(30)]
    assert found.keys() == each[0].keys() == {*SITES, *given}
    for name, value in found.items():
        assert torch.equal(value, torch.cat([one[name] for one in each])), name


def test_sites_beyond_perception_are_drawn_with_it(self_model, rounds):
    human = Moody(self_model)
    table = build_view_table(human, rounds.select_people([0]))
    assert table.sites == SITES
    policy = some_policy(human)
    given = {name: value.expand(300, *value.shape) for name, value in policy.items()}
    draws = ViewTables(human, table).sample_discrete(given)
    draws = {name: value[:, 0, 0] for name, value in draws.items()}
    weights = torch.zeros(14, 3, 2)
    for mood, chance in enumerate((0.2, 0.5, 0.3)):
        for bold, other in enumerate((0.6, 0.4)):
            given = {"mood": torch.full((1, 1), mood), "bold": torch.full((1, 1), float(bold))}
            joint = log_joint(human, table, policy | given)[0]
            weights[:, mood, bold] = joint.exp() * chance * other
    index = (table.combination(draws) * 3 + draws["mood"]) * 2 + draws["bold"].long()
    assert_follows(index, weights.flatten())


def test_draws_are_as_many_as_asked_for(few, table):
    with pyro.settings.context(module_local_params=True):
        compiled = ViewTables(few, table)
        draws = draw_implants(compiled, continuous_guide(compiled), 10)
    assert {name: value.shape[:3] for name, value in draws.items()} == dict.fromkeys(
        [*SITES, "consistency", "lapse", "residual_in", "residual_out"], (10, 3, 1)
    )
    assert len(draws["consistency"][:, 0, 0].unique()) == 10  # each a draw of its own


def test_prior_draws_are_those_of_the_program(self_model, rounds):
    human = Moody(self_model)
    table = build_view_table(human, rounds)
    torch.manual_seed(1)
    draws = draw_prior(human, table.people, 2000, seed=4)
    torch.manual_seed(2)
    again = draw_prior(human, table.people, 2000, seed=4)
    assert all(torch.equal(value, again[name]) for name, value in draws.items())
    assert list(draws)[:3] == ["mood", *SITES]
    assert draws["residual_out"].shape == (2000, 3, 1, 9, 2)
    assert_follows(table.combination(draws)[:, 0, 0], PRIOR, tests=3)
    assert_follows(draws["mood"][:, 1, 0], torch.tensor([0.2, 0.5, 0.3]), tests=3)
    assert_follows(draws["bold"][:, 2, 0].long(), torch.tensor([0.6, 0.4]), tests=3)
    # The logarithm of consistency is normal about log 3 with 0.5.
    logs = draws["consistency"].log()
    assert logs.mean().item() == pytest.approx(math.log(3), abs=4.5 * 0.5 / math.sqrt(6000))
    assert logs.std().item() == pytest.approx(0.5, abs=4.5 * 0.5 / math.sqrt(12_000))


def test_predictions_agree_with_perceive_believe_act(few, rounds):
    table = build_view_table(few, rounds)
    combinations = torch.randint(14, (5, 3, 1))
    draws = {site: value[combinations] for site, value in COMBINATIONS.items()}
    draws |= policies(few, 5, 3)
    found = predict_actions(few, table, draws)
    assert found.shape == (5, 3, 3, STEPS, 2)
    torch.testing.assert_close(found.exp().sum(-1), torch.ones(5, 3, 3, STEPS))
    chosen = found.gather(-1, table.recorded[..., None].expand(5, -1, -1, -1, -1)).squeeze(-1)
    chosen = torch.where(table.steps, chosen, 0.0).sum(-1)
    for draw in range(5):
        for person, lengths in enumerate(LENGTHS):
            values = {site: draws[site][draw, person] for site in SITES}
            policy = {
                name: value[draw, person][None]
                for name, value in draws.items()
                if name not in SITES
            }
            for number in range(len(lengths)):
                expected = log_likelihoods_by_hand(few, rounds, person, number, values, policy)
                torch.testing.assert_close(
                    chosen[draw, person, number], expected[0], rtol=1e-4, atol=1e-4
                )
