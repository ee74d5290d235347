"""Attention summed out span by span, against every combination of its values by itself."""

from dataclasses import replace
from itertools import product

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_course import gone_through
from example_defusal import ACTIONS, WAIT, WORLD, recorded

from mirror_ppl.data import concatenate
from mirror_ppl.domains.bomb_defusal.human import BombDefusalHuman
from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.chain import Chain
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.likelihood.enumeration import conditioned, log_joints
from mirror_ppl.likelihood.predictive import predict_actions
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.table_program import log_likelihoods
from mirror_ppl.likelihood.tables import build_view_table, restricted, rounds_of
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.self_model import SelfModel


@pytest.fixture(scope="module")
def defuser():
    torch.manual_seed(0)
    human = BombDefusalHuman(SelfModel(WORLD))
    with torch.no_grad():  # actions that hang on beliefs, as those of a trained self-model do
        for weight in human.self_model.q_network.parameters():
            weight.mul_(2.0)
    return human


def by_combination(human, rounds, draws):
    """Log-probabilities ``[S, t, A]`` of actions in each round, and of all that was done ``[S]``.

    Every guess with every time at which each terminal may have been found, one by one.
    """
    number = len(draws["reads_type"])
    total, predicted = torch.zeros(number), []
    for one in rounds_of(rounds, 0).each():
        observation, told, actions, real = vars(one).values()
        steps = int(real.sum())
        seen = {name: value[:, :steps] for name, value in observation.items()}
        heard = {name: mask[:, :steps] for name, mask in told.items()}
        stage = seen["ego"][0, :, 0]
        lengths = [int((stage == number).sum()) for number in range(3)]
        covariates = {
            name: fact.view(1, 1)
            for name, fact in human.covariates(
                {name: value[0] for name, value in seen.items()}
            ).items()
        }
        joint, along = [], []
        for guess, *found in product((0, 1), *(range(length + 1) for length in lengths)):
            chance = torch.full((number,), 0.5).log()
            for place, (time, length) in enumerate(zip(found, lengths, strict=True)):
                terminal = 1 + int(covariates[f"sought_{place}"])
                p = draws[f"notices_terminal {terminal}"].flatten()
                if time < length:
                    chance = chance + p.log()
                chance = chance + time * torch.log1p(-p)
            values = {"guess": guess, **{f"found_{k}": time for k, time in enumerate(found)}}
            attention = {name: torch.tensor([value]) for name, value in values.items()}
            each = torch.zeros(number, steps, len(WORLD.actions))
            for reads in (0, 1):  # all that a belief depends on, besides attention
                sites = {"reads_type": torch.tensor([reads]), **attention}
                belief = gone_through(human, sites, seen, heard, actions[:, :steps])
                rows = (draws["reads_type"].flatten() == reads).nonzero().flatten()
                own = {name: value[rows] for name, value in draws.items()}
                with conditioned(own, len(rows), 1):
                    found_here = human.act(human.prior(), belief, human.action_values(belief))
                each[rows] = found_here[:, 0]
            done = each.gather(-1, actions[:, :steps, None].expand(number, -1, 1)).squeeze(-1)
            before = done.cumsum(-1) - done
            along.append((chance[:, None] + before)[..., None] + each)
            joint.append(chance + done.sum(-1))
        along = torch.stack(along).logsumexp(0)
        predicted.append(along - along.logsumexp(-1, keepdim=True))
        total = total + torch.stack(joint).logsumexp(0)
    return predicted, total


class Late(BombDefusalHuman):
    """Does what they would have done one step before: a belief holds the one before it, too."""

    @property
    def belief_size(self):
        return 2 * self.self_model.latent

    def believe(self, belief, evidence, action, still=None):
        before, _ = belief.chunk(2, -1)
        return torch.cat([super().believe(before, evidence, action, still).mean, before], -1)

    def action_values(self, belief):
        return super().action_values(belief.chunk(2, -1)[1])

    def act(self, implants, belief, values):
        return super().act(implants, belief.chunk(2, -1)[1], values)


@pytest.mark.parametrize(("told", "kind"), [(False, BombDefusalHuman), (True, Late)])
def test_the_sum_is_that_over_all_combinations(defuser, told, kind):
    rounds, human = recorded(told=told), kind(defuser.self_model)
    draws = draw_prior(human, 1, 4, 0)
    draws["reads_type"] = torch.tensor([0, 0, 1, 0]).view(4, 1, 1)
    predicted, total = by_combination(human, rounds, draws)
    table = build_view_table(human, rounds)
    assert isinstance(table.attention, Chain)
    joints = log_joints(human, table, {n: v for n, v in draws.items() if n not in table.sites})
    chosen = joints[torch.arange(4), 0, draws["reads_type"].flatten()]
    torch.testing.assert_close(chosen - torch.tensor(0.5).log(), total, rtol=1e-4, atol=1e-4)
    found = predict_actions(human, table, draws)[:, 0]
    for place, expected in enumerate(predicted):
        steps = expected.shape[1]
        torch.testing.assert_close(found[:, place, :steps], expected, rtol=1e-4, atol=1e-4)


def test_people_of_different_rounds_are_joined(defuser):
    """Each as by themselves; padding of the shorter ones changes nothing."""
    one, other = (
        recorded(),
        recorded(((2, 2), (WAIT, 3, WAIT, WAIT, WAIT, WAIT, WAIT, 1, 1)), person="other"),
    )
    both = concatenate([one, other])
    draws = draw_prior(defuser, 2, 3, 1)
    draws["reads_type"] = torch.zeros_like(draws["reads_type"])
    table = build_view_table(defuser, both)
    predicted = predict_actions(defuser, table, draws)
    policy = {name: value for name, value in draws.items() if name not in table.sites}
    joints = log_joints(defuser, table, policy)
    for place, alone in enumerate((one, other)):
        own = {name: value[:, place : place + 1] for name, value in draws.items()}
        single = build_view_table(defuser, alone)
        steps, rounds = alone.shape[2], alone.shape[1]
        real = alone.mask[0]
        expected = predict_actions(defuser, single, own)[:, 0]
        found = predicted[:, place, :rounds, :steps]
        torch.testing.assert_close(found[:, real], expected[:, real], rtol=1e-4, atol=1e-5)
        mine = {name: value for name, value in own.items() if name not in table.sites}
        expected = log_joints(defuser, single, mine)[:, 0]
        torch.testing.assert_close(joints[:, place], expected, rtol=1e-4, atol=1e-4)


def test_what_is_given_up_changes_nothing_of_the_rest(defuser):
    """Giving up people who read the type leaves likelihoods of those who do not unchanged."""
    rounds = recorded()
    draws = draw_prior(defuser, 1, 3, 2)
    table = build_view_table(defuser, rounds)
    policy = {name: value for name, value in draws.items() if name not in table.sites}
    whole = log_joints(defuser, table, policy)
    less = restricted(table, torch.tensor([[False, True]]))
    assert less.moments.shape[1] < table.moments.shape[1]
    torch.testing.assert_close(log_joints(defuser, less, policy)[..., 1], whole[..., 1])
    assert (log_joints(defuser, less, policy)[..., 0] < -1e5).all()


def test_screening_counts_what_the_table_does(defuser):
    """Ways are scored as the table of the same rounds has it, without merging moments."""
    builder = ViewTableBuilder(defuser, Screening(margin=1e6, policies=3, resolution=0))
    builder.add(rounds_of(recorded(), 0))
    table = builder.table()
    policy = {name: value for name, value in builder.policies.items() if name not in table.sites}
    joints = log_joints(defuser, table, policy)[:, 0]
    torch.testing.assert_close(builder.score + builder.log_prior, joints)


def test_the_sum_has_the_gradient_of_its_differences(defuser):
    """By how probably terminals are noticed."""
    table = build_view_table(defuser, recorded())
    draws = draw_prior(defuser, 1, 1, 3)
    site = next(f"notices_terminal {k}" for k in range(1, 7) if looked_for(table, k))

    def likelihood(value):
        given = {**draws, site: value}
        with conditioned(given, 1, 1):
            return log_likelihoods(defuser, defuser.prior(), table).sum()

    value = draws[site].clone().requires_grad_()
    (slope,) = torch.autograd.grad(likelihood(value), value)
    with torch.no_grad():
        step = 1e-3
        expected = (likelihood(value + step) - likelihood(value - step)) / (2 * step)
    assert slope.isfinite().all() and float(slope) == pytest.approx(float(expected), rel=0.02)


def looked_for(table, terminal):
    """Whether a terminal is lit in the first round."""
    return int(table.attention.covariates["sought_0"][0, 0]) == terminal - 1


def test_a_person_without_rounds_has_a_table(defuser):
    nobody = recorded().select_rounds([])
    table = build_view_table(defuser, nobody)
    assert predict_actions(defuser, table, draw_prior(defuser, 1, 2, 0)).shape[:2] == (2, 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda spans: {"guess": spans["guess"]},
            "spans has to be of the sites of round_latents, guess",
        ),
        (
            lambda spans: {**spans, "found_1": replace(spans["found_1"], first=1)},
            'the span of "found_1", steps 1 to 4 of 7, begins before the one before it is over',
        ),
        (
            lambda spans: {**spans, "found_0": replace(spans["found_0"], values=62)},
            '"found_0" has 61 values, not the 62 of its span',
        ),
    ],
)
def test_spans_that_cannot_be_are_refused(defuser, change, message, monkeypatch):
    spans = BombDefusalHuman.spans
    monkeypatch.setattr(BombDefusalHuman, "spans", lambda self, seen: change(spans(self, seen)))
    with pytest.raises(HumanModelError, match=message):
        build_view_table(defuser, recorded())


class ReadsLater(BombDefusalHuman):
    """Still sees at the second stage what they look for there if they found it at the first."""

    spans = BombDefusalHuman.spans

    def sees(self, implants, observation, step):
        seen = super().sees(implants, observation, step)
        also = (implants["found_0"] == 0)[..., None] & (observation["ego"][..., :1] == 1)
        return {**seen, "visual": seen["visual"] | (also & self.domain.sought(observation))}


class TooFew(BombDefusalHuman):
    """Says that whatever is found later than at once is not found."""

    def spans(self, observation):
        return {
            name: replace(span, values=1) if name == "found_0" else span
            for name, span in super().spans(observation).items()
        }


class Hangs(BombDefusalHuman):
    """Finds what counts later than at the stage before."""

    spans = BombDefusalHuman.spans

    def round_latents(self, implants):
        sites = super().round_latents(implants)
        probabilities = torch.linspace(0.1, 0.9, 61)[sites["found_0"].long()]
        mood = pyro.sample("mood", dist.Bernoulli(probabilities))
        return {**sites, "mood": mood}


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (ReadsLater, 'the span of "found_0" is steps 0 to .*, but at step .* it is read outside'),
        (TooFew, 'the span of "found_0" is .* its values from number 0 on differ'),
        (Hangs, '"mood" of round_latents depends on another of its sites'),
    ],
)
def test_spans_that_are_not_so_are_found(defuser, kind, message):
    with pytest.raises(HumanModelError, match=message):
        check_contract(kind(defuser.self_model))


class Sees(BombDefusalHuman):
    """Has sight of its own, of which nobody says when it is read."""

    spans = HumanModel.spans

    def sees(self, implants, observation, step):
        return super().sees(implants, observation, step)


class Perceives(BombDefusalHuman):
    """Perceives in a way of their own, of which nobody says what it reads."""

    spans = HumanModel.spans

    def perceive(self, implants, knowledge, observation, told, step):
        return super().perceive(implants, knowledge, observation, told, step)


@pytest.mark.parametrize("kind", [Sees, Perceives])
def test_who_may_break_spans_is_summed_out_as_elsewhere(defuser, kind):
    """By values that stand for all; exactly where there are few of them."""
    human, rounds = kind(defuser.self_model), recorded(((WAIT, 2, 1, 3),), told=False)
    assert defuser.chained and not human.chained
    check_contract(human)
    assert not isinstance(build_view_table(human, rounds).attention, Chain)


@pytest.mark.parametrize("name", ["round_latents", "sees", "perceive"])
def test_models_that_change_what_spans_are_about_declare_them(name):
    """Also where a class beside the one with spans changes it."""
    own = {name: getattr(HumanModel, name)}
    message = f"Own overrides {name} and inherits spans: declare .spans = BombDefusalHuman.spans."
    with pytest.raises(HumanModelError, match=message):
        type("Own", (BombDefusalHuman,), own)
    with pytest.raises(HumanModelError, match=message):
        type("Own", (type("Beside", (HumanModel,), own), BombDefusalHuman), {})
    declared = type("Own", (BombDefusalHuman,), {**own, "spans": HumanModel.spans})
    type("Derived", (declared,), own)


def test_merging_moments_hardly_changes_anything(defuser):
    """Moments whose log-probabilities fall on the same points of a grid of .03 are one."""
    rounds = recorded()
    draws = draw_prior(defuser, 1, 8, 5)
    tables = [
        build_view_table(defuser, rounds, screening=Screening(margin=1e6, resolution=width))
        for width in (0, 0.03)
    ]
    assert tables[1].belief.shape[1] < tables[0].belief.shape[1]
    policy = {name: value for name, value in draws.items() if name not in tables[0].sites}
    exact, merged = (log_joints(defuser, table, policy) for table in tables)
    # Twelve steps, each up to half a grid's width off under the ways that are compared.
    assert (exact - merged).abs().max() < 12 * 0.03


def test_screening_counts_the_rounds_that_were_added_together(defuser, monkeypatch):
    counted, margin_after = [], Screening.margin_after

    def noted(self, rounds):
        counted.append(rounds)
        return margin_after(self, rounds)

    monkeypatch.setattr(Screening, "margin_after", noted)
    builder = ViewTableBuilder(defuser, Screening())
    for _ in range(2):
        builder.add(rounds_of(recorded(), 0))
    assert counted == [len(ACTIONS), 2 * len(ACTIONS)]


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 0, 1)])
def test_people_without_rounds_and_dropped_combinations_change_nothing_of_others(defuser, order):
    """Sights and predictions of three people, one of whom played no round, as of each alone."""
    nobody = replace(
        recorded(person="nobody"),
        round_counts=torch.tensor([0]),
        lengths=torch.zeros(1, len(ACTIONS), dtype=torch.long),
    )
    one, other = recorded(), recorded(ACTIONS[:2], told=False, person="other")
    people = [(one, nobody, other)[place] for place in order]
    draws = draw_prior(defuser, 3, 5, 0)
    together = build_view_table(defuser, concatenate(people))
    alive = torch.ones_like(together.index[:, 0], dtype=torch.bool)
    alive[order.index(0), 1:] = False  # of one person, only the first combination is left
    shortened = restricted(together, alive)
    for place, own in enumerate(people):
        some = {name: value[:, [place]] for name, value in draws.items()}
        alone = build_view_table(defuser, own)
        rounds = int(own.round_counts)
        expected = log_joints(defuser, alone, some)[:, 0]
        found = log_joints(defuser, together, draws)[:, place]
        torch.testing.assert_close(found, expected)
        left = log_joints(defuser, shortened, draws)[:, place]
        number = 1 if place == order.index(0) else left.shape[-1]
        torch.testing.assert_close(left[:, :number], expected[:, :number])
        steps = own.actions.shape[2]
        predicted = predict_actions(defuser, together, draws)[:, place, :rounds, :steps]
        torch.testing.assert_close(
            predicted, predict_actions(defuser, alone, some)[:, 0, :rounds, :steps]
        )
