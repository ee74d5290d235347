"""What differs from round to round: summed out by likelihoods, posteriors and predictions."""

import itertools
import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_attention import (
    NOTICED,
    NOTICES,
    STEPS,
    Fixed,
    OneItem,
    by_hand,
    drawn,
    example,
    geometric,
)
from example_views import ragged

from mirror_ppl.errors import HumanModelError
from mirror_ppl.inference.adaptive_importance import ImportanceOptions, sample_importance
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.nuts import NUTSOptions
from mirror_ppl.inference.online import OnlinePosterior
from mirror_ppl.inference.svi import SVIOptions
from mirror_ppl.likelihood.attention import KEPT, VALUES
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.likelihood.enumeration import log_joints
from mirror_ppl.likelihood.predictive import predict_actions
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.table_program import log_likelihoods
from mirror_ppl.likelihood.tables import (
    build_view_table,
    combination_scores,
    join_tables,
    restricted,
    rounds_of,
)
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models import HumanModel
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.variants import OneRadius, PerItem

# --- likelihoods, posteriors, predictions


@pytest.mark.parametrize("lengths", [[[15, 15, 6], [], [15, 9]]])
def test_likelihoods_are_sums_over_when_something_was_noticed(self_model, recordings, lengths):
    human, rounds = OneItem(self_model), ragged(recordings, lengths)
    implants = {name: value[0] for name, value in drawn(human, 1, 3).items()}
    table = build_view_table(human, rounds)
    found = combination_scores(table, log_likelihoods(human, implants, table))[:, 0]
    for person, own in enumerate(lengths):
        expected = torch.zeros(())
        for number, length in enumerate(own):
            probabilities = by_hand(human, implants, rounds, person, number)
            done = rounds.actions[person, number].clamp(min=0)
            along = probabilities[:, torch.arange(STEPS), done][:, :length].sum(-1)
            prior = geometric(float(implants[NOTICES[0]][person])).log()
            expected = expected + torch.logsumexp(along + prior, 0)
        torch.testing.assert_close(found[person], expected, rtol=1e-3, atol=1e-3)


def test_a_table_of_many_is_that_of_each(per_item, recordings):
    """Also where they differ in rounds, lengths and what is left of them after screening."""
    rounds = ragged(recordings, [[15, 6], [], [9]])
    implants = {name: value[0] for name, value in drawn(per_item, 1, 3).items()}
    together = build_view_table(per_item, rounds, screening=Screening(policies=4))
    found = combination_scores(together, log_likelihoods(per_item, implants, together))
    for person in range(3):
        alone = rounds.select_people([person])
        own = {name: value[person : person + 1] for name, value in implants.items()}
        table = build_view_table(per_item, alone, screening=Screening(policies=4))
        expected = combination_scores(table, log_likelihoods(per_item, own, table))
        torch.testing.assert_close(found[person : person + 1], expected, rtol=1e-4, atol=1e-4)
    assert together.attention is not None
    assert together.attention.log_weights.shape[:2] == (3, 2)
    assert together.attention.kept.shape[-1] <= KEPT + 1 < VALUES


def test_people_may_have_different_numbers_of_values(per_item, recordings):
    rounds = recordings.select_people([0, 1]).select_rounds(range(2))
    implants = {name: value[0] for name, value in drawn(per_item, 1, 2).items()}
    tables, expected = [], []
    for person, values in enumerate((20, 7)):
        table = build_view_table(per_item, rounds.select_people([person]), values=values)
        own = {name: value[person : person + 1] for name, value in implants.items()}
        expected.append(combination_scores(table, log_likelihoods(per_item, own, table)))
        tables.append(table)
    together = join_tables(tables, rounds.shape)
    found = combination_scores(together, log_likelihoods(per_item, implants, together))
    torch.testing.assert_close(found, torch.cat(expected), rtol=1e-4, atol=1e-4)
    less = restricted(together, together.possible & (torch.arange(4) % 2 == 0))
    found = combination_scores(less, log_likelihoods(per_item, implants, less))[:, ::2]
    torch.testing.assert_close(found, torch.cat(expected)[:, ::2], rtol=1e-4, atol=1e-4)


def test_thinning_hardly_moves_likelihoods(per_item, recordings):
    """By much less than likelihoods of different people differ."""
    rounds = recordings.select_people([0]).select_rounds(range(4))
    one = drawn(per_item, 1)
    likely = {name: value.expand(16, *value.shape[1:]) for name, value in one.items()}
    likely |= {site: torch.linspace(0.1, 0.6, 16).view(16, 1, 1) for site in NOTICES}
    policy = {name: value for name, value in likely.items() if not name.startswith("assumes")}
    found = []
    for screening in (None, Screening(margin=1e9, policies=16, resolution=0)):
        table = build_view_table(per_item, rounds, screening=screening, likely=likely)
        found.append(log_joints(per_item, table, policy)[:, 0])
    assert (found[0] - found[1]).abs().mean() < found[0].std(0).mean() / 5


def test_every_implant_of_noticing_has_a_gradient(per_item, recordings):
    table = build_view_table(per_item, recordings.select_people([0]).select_rounds(range(3)))
    implants = {name: value[0].clone() for name, value in drawn(per_item, 1).items()}
    for site in NOTICES:
        implants[site] = torch.full((1, 1), 0.3, requires_grad=True)
    log_likelihoods(per_item, implants, table).sum().backward()
    for site in NOTICES:
        gradient = implants[site].grad
        assert gradient is not None
        assert gradient.isfinite().all()
        assert gradient.abs().min() > 1e-3


def test_the_posterior_is_the_exact_one(self_model):
    """Mean and spread of a probability of noticing agree with a grid, all else being known."""
    human = Fixed(self_model)
    generator = torch.Generator().manual_seed(3)
    truth = {NOTICES[0]: torch.tensor([[0.15]])}
    rounds = play_rounds(human, truth, 8, "fog", generator)
    grid = (torch.arange(200) + 0.5) / 200
    known = {name: value.view(1, 1) for name, value in human.prior().items()}
    each = [by_hand(human, known, rounds, 0, number) for number in range(8)]
    total = torch.zeros(200)
    prior = torch.stack([geometric(float(value)) for value in grid]).log()
    for number, probabilities in enumerate(each):
        along = probabilities[:, torch.arange(STEPS), rounds.actions[0, number]].sum(-1)
        total += torch.logsumexp(along + prior, -1)
    exact = torch.softmax(total, 0)
    mean = (exact * grid).sum()
    spread = (exact * (grid - mean).square()).sum().sqrt()
    builder = ViewTableBuilder(human, Screening())
    builder.add(rounds_of(rounds, 0))
    torch.manual_seed(0)
    found = sample_importance(human, builder.table(), ImportanceOptions())
    weights, value = found.log_weights.exp(), found.policy[NOTICES[0]].flatten().double()
    error = 5 / math.sqrt(found.effective)
    assert abs((weights * value).sum() - mean) < error * spread
    assert abs((weights * (value - mean).square()).sum().sqrt() / spread - 1) < error
    assert spread < 0.2  # they tell something


def test_predictions_condition_on_the_round_so_far(self_model, recordings):
    human, rounds = OneItem(self_model), ragged(recordings, [[15, 6], [9]])
    draws = drawn(human, 2, 2)
    found = predict_actions(human, build_view_table(human, rounds, likely=draws), draws)
    for draw, person in itertools.product(range(2), range(2)):
        implants = {name: value[draw] for name, value in draws.items()}
        for number, length in enumerate([[15, 6], [9]][person]):
            each = by_hand(human, implants, rounds, person, number)
            done = rounds.actions[person, number].clamp(min=0)
            log_weights = geometric(float(implants[NOTICES[0]][person])).log()
            for step in range(length):
                shares = log_weights.log_softmax(0)
                expected = torch.logsumexp(shares[:, None] + each[:, step], 0)
                torch.testing.assert_close(
                    found[draw, person, number, step], expected, rtol=1e-3, atol=1e-3
                )
                log_weights = log_weights + each[:, step, done[step]]


def test_other_guides_agree_with_importance_sampling(self_model):
    """On a posterior of one number: means within .15 and half of the spread of each other."""
    human = Fixed(self_model)
    truth = {NOTICES[0]: torch.tensor([[0.1]])}
    rounds = play_rounds(human, truth, 6, "fog", torch.Generator().manual_seed(1))
    found = {}
    for name, settings in (
        ("importance", None),
        ("svi", SVIOptions(steps=100)),
        ("nuts", NUTSOptions(warmup=40)),
    ):
        options = InferenceOptions(name, 80, settings)
        found[name] = infer(human, rounds, options, 0).draws[NOTICES[0]].flatten()
    for guide in ("svi", "nuts"):
        assert abs(found[guide].mean() - found["importance"].mean()) < 0.15
        assert 0.5 < found[guide].std() / found["importance"].std() < 2


def test_rounds_that_come_in_are_those_that_were_there(self_model, recordings):
    human = Fixed(self_model)
    rounds = recordings.select_people([0]).select_rounds(range(3))
    at_once, one_by_one = OnlinePosterior(human), OnlinePosterior(human)
    at_once.add(rounds)
    for number in range(3):
        one_by_one.add(rounds.select_rounds([number]))
    assert at_once.rounds == one_by_one.rounds == 3
    for site, value in at_once.draws(20).items():
        assert torch.equal(value, one_by_one.draws(20)[site])


def test_the_example_is_a_mixture_of_seeing_and_not(self_model, recordings):
    """Rounds of a person who is away with some probability; by the package's own model."""
    human = example(self_model)
    check_contract(human)
    one = recordings.select_people([0]).select_rounds([0])
    implants = {name: value[0] for name, value in drawn(human, 1).items()}
    some = [torch.arange(0, 9604, 97)]

    def scores(model):
        table = build_view_table(model, one, some)
        return combination_scores(table, log_likelihoods(model, implants, table))[0][some[0]]

    seeing, blind = scores(HumanModel(self_model)), scores(Blind(self_model))
    away = float(implants["distracted"])
    expected = torch.logaddexp(math.log1p(-away) + seeing, math.log(away) + blind)
    torch.testing.assert_close(scores(human), expected, rtol=1e-4, atol=1e-4)
    assert (seeing - blind).abs().max() > 0.5


class Blind(HumanModel):
    """Sees nothing by themselves."""

    def sees(self, implants, observation, step):
        seen = super().sees(implants, observation, step)
        return {name: torch.zeros_like(mask) for name, mask in seen.items()}


# --- what a user may get wrong


class Wrong(PerItem):
    """Attends in some way that cannot be."""

    kind = ""

    def round_latents(self, implants):
        if self.kind == "returns":
            super().round_latents(implants)
            return {}
        if self.kind == "param":
            pyro.param("p", torch.tensor(0.5))
            return super().round_latents(implants)
        if self.kind == "clash":
            return {"lapse": pyro.sample("lapse", dist.Bernoulli(0.5))}
        if self.kind == "support":
            return {"m": pyro.sample("m", dist.Poisson(implants[NOTICES[0]]))}
        if self.kind == "event":
            return {"m": pyro.sample("m", dist.Bernoulli(0.5).expand([3]).to_event(1))}
        return {"m": implants["nothing"]}


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("returns", "round_latents has to return a dict of the sites that it samples, by name"),
        ("support", '"m" of round_latents has no finite support'),
        ("param", '"p" is a pyro.param; sample it'),
        ("clash", r'"lapse" is a site of prior\(\) and of round_latents\(\)'),
        ("event", r'"m" of round_latents has shape \(1,\) and event shape \(3,\), expected'),
        ("raises", r"Wrong.round_latents fails: NotReturned: 'nothing' \(test_attention.py, line"),
    ],
)
def test_what_cannot_be_attended_to_is_refused(self_model, kind, message):
    human = Wrong(self_model)
    human.kind = kind
    with pytest.raises(HumanModelError, match=message):
        check_contract(human)


class Empty(PerItem):
    """Overrides round_latents, and nothing differs."""

    def round_latents(self, implants):
        return {}

    def sees(self, implants, observation, step):
        return super().sees(dict.fromkeys(NOTICED, torch.tensor(0)), observation, step)


@pytest.mark.filterwarnings("ignore::mirror_ppl.errors.UnreadSite")
def test_attention_to_nothing_is_none(self_model, recordings):
    human = Empty(self_model)
    check_contract(human)
    assert not human.has_round_latents
    one = recordings.select_people([0]).select_rounds([0])
    assert build_view_table(human, one).attention is None


class ReadsSight(OneRadius):
    """Is away only if they see two cells, which cannot be summed out."""

    def round_latents(self, implants):
        chance = 0.1 + 0.8 * (implants["sight_radius"] == 2)
        return {"away": pyro.sample("away", dist.Bernoulli(chance))}


def test_attention_that_depends_on_what_is_seen_is_refused(self_model, recordings):
    """On a value in the middle, too."""
    one = recordings.select_people([0]).select_rounds([0])
    message = '"away" of round_latents depends on a site that perceive'
    with pytest.raises(HumanModelError, match=message):
        build_view_table(ReadsSight(self_model), one)
