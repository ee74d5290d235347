"""What differs from round to round: sampled by the program, summed out by inference."""

import itertools
import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_course import gone_through, perceived
from paths import EXAMPLES
from test_views import ragged

from mirror_ppl.communication import (
    Communicator,
    ExpectedUtility,
    Person,
    PlanningContext,
    RoundSoFar,
)
from mirror_ppl.communication.rollouts import SelfModelWorld
from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.errors import HumanModelError
from mirror_ppl.inference.adaptive_importance import ImportanceOptions, sample_importance
from mirror_ppl.inference.calibration.study import prior_people
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.online import OnlinePosterior
from mirror_ppl.inference.svi import SVIOptions
from mirror_ppl.likelihood.attention import KEPT, VALUES, choose_values, site_probabilities
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.likelihood.densities import log_weighted_latents
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
from mirror_ppl.models.implants import first_success, noticed_sites, policy_implants
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.variants import OneRadius, PerItem
from mirror_ppl.models.weights import load_self_model, shipped_weights

DRIVING = get_domain("driving")
STEPS = DRIVING.horizon
NOTICED = noticed_sites(DRIVING)
NOTICES = tuple(site.replace("noticed_", "notices_") for site in NOTICED)


class OneItem(PerItem):
    """Notices the first car at some time, and never the others: attention can be enumerated."""

    def prior(self):
        like = next(self.self_model.parameters())
        known = {NOTICES[0]: pyro.sample(NOTICES[0], dist.Beta(1.0, 1.0))}
        return known | policy_implants(self.domain, self.self_model.latent, like)

    def round_latents(self, implants):
        first = NOTICED[0]
        return {first: pyro.sample(first, first_success(implants[NOTICES[0]], STEPS))}

    def sees(self, implants, observation, step):
        never = dict.fromkeys(NOTICED, torch.tensor(STEPS))
        return super().sees({**never, NOTICED[0]: implants[NOTICED[0]]}, observation, step)


class Fixed(OneItem):
    """The same, all else known."""

    def prior(self):
        known = {"consistency": torch.tensor(4.0), "lapse": torch.tensor(0.02)}
        return known | {NOTICES[0]: pyro.sample(NOTICES[0], dist.Beta(1.0, 1.0))}


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


@pytest.fixture(scope="module")
def per_item(self_model):
    return PerItem(self_model)


@pytest.fixture(scope="module")
def recordings():
    return load_demonstrations(asset_path("driving_fog_paper.nc"))


def drawn(human, number, people=1, seed=0):
    """Draws ``[S, P, 1, ...]`` of all sites."""
    return draw_prior(human, people, number, seed)


def geometric(probability):
    """Probabilities of each number of failures, by hand."""
    probabilities = [probability * (1 - probability) ** n for n in range(STEPS)]
    return torch.tensor([*probabilities, (1 - probability) ** STEPS])


def by_hand(human, implants, recordings, person, number):
    """Log-probabilities ``[16, T, A]`` of actions for each time at which the car is noticed."""
    observation, told, actions, _ = vars(
        rounds_of(recordings, person).at(number, number + 1)
    ).values()
    when = {NOTICED[0]: torch.arange(STEPS + 1)}
    belief = gone_through(human, when, observation, told, actions)
    values = human.self_model.action_values(belief)
    own = {name: value[person : person + 1] for name, value in implants.items()}
    each = human.act(own, belief.flatten(0, 1)[None], values.flatten(0, 1)[None])
    return each[0].unflatten(0, belief.shape[:2])


# --- the program


def test_the_first_success_is_geometric():
    for probability in (0.05, 0.5, 0.9):
        found = first_success(torch.tensor(probability), STEPS).probs
        torch.testing.assert_close(found, geometric(probability), rtol=1e-4, atol=1e-7)
    for sure, when in ((1.0, 0), (0.0, STEPS)):
        assert first_success(torch.tensor(sure), STEPS).probs[when] > 0.9999


def test_the_probability_of_attention_is_that_of_the_program(per_item):
    implants = {site: torch.rand(3, 1) for site in NOTICES}
    values = {site: torch.randint(STEPS + 1, (3, 2, 7)) for site in NOTICED}
    weights = torch.randn(3, 2, 7)
    with pyro.plate("person", 3, dim=-2):
        found = log_weighted_latents(per_item, implants, values, weights)
    expected = weights.clone()
    for person, number, value in itertools.product(range(3), range(2), range(7)):
        for notices, noticed in zip(NOTICES, NOTICED, strict=True):
            probabilities = geometric(float(implants[notices][person, 0]))
            expected[person, number, value] += probabilities[
                values[noticed][person, number, value]
            ].log()
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3)
    assert pyro.get_param_store().keys() == {}.keys()


def test_an_item_is_seen_from_when_it_is_noticed(per_item, recordings):
    observation, told, _, _ = vars(rounds_of(recordings, 0).at(0, 1)).values()
    nothing = {name: torch.zeros_like(mask) for name, mask in told.items()}
    when = dict(zip(NOTICED, torch.tensor([[0], [4], [14], [15]]), strict=True))
    open_ = {"assumes_clear": torch.tensor([0]), "assumes_closing": torch.tensor([0])}
    seen = perceived(per_item, when | open_, observation, nothing).visible["visual"][0]
    steps = torch.arange(STEPS)
    for place, first in enumerate((0, 4, 14, 15)):
        assert torch.equal(seen[:, place], steps >= first)


def test_attention_differs_between_rounds_and_people_and_follows_its_seed(per_item):
    def play(seed):
        generator = torch.Generator().manual_seed(seed)
        people = prior_people(per_item, 2, torch.Generator().manual_seed(0))
        people |= {site: torch.full((2, 1), 0.3) for site in NOTICES}
        return play_rounds(per_item, people, 3, "fog", generator).actions

    torch.manual_seed(5)
    first = play(1)
    torch.manual_seed(6)
    state = torch.random.get_rng_state()
    assert torch.equal(play(1), first)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert not torch.equal(play(2), first)


def test_attention_of_two_people_is_drawn_with_their_own_probabilities(per_item):
    implants = {site: torch.tensor([[0.9], [0.05]]) for site in NOTICES}
    torch.manual_seed(0)
    with pyro.plate("person", 2, dim=-2), pyro.plate("round", 1000, dim=-1):
        drawn = per_item.round_latents(implants)
    for site in NOTICED:
        assert drawn[site].shape == (2, 1000)
        for person, probability in enumerate((0.9, 0.05)):
            at_once = (drawn[site][person] == 0).double().mean()
            error = math.sqrt(probability * (1 - probability) / 1000)
            assert abs(at_once - probability) < 5 * error


# --- values that stand for all


SUPPORTS = {"a": torch.arange(4), "b": torch.tensor([1, 3]), "c": torch.arange(5)}
CHANCES = {
    "a": torch.tensor([0.7, 0.2, 0.05, 0.05]),
    "b": torch.tensor([0.9, 0.1]),
    "c": torch.tensor([0.5, 0.3, 0.1, 0.05, 0.05]),
}


def chosen(number, seed=0):
    return choose_values(SUPPORTS, CHANCES, number, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("number", [40, 100])
def test_few_combinations_are_all_there(number):
    found = chosen(number)
    assert len(found) == 40
    rows = set(zip(*(found.values[site].tolist() for site in SUPPORTS), strict=True))
    assert rows == set(itertools.product(*(support.tolist() for support in SUPPORTS.values())))
    assert (found.log_weights == 0).all()


@pytest.mark.parametrize("number", [1, 3, 12, 39])
def test_of_many_there_are_as_many_as_asked_for_without_repetition(number):
    for seed in range(20):
        found = chosen(number, seed)
        assert abs(len(found) - number) <= 1
        rows = list(zip(*(found.values[site].tolist() for site in SUPPORTS), strict=True))
        assert len(set(rows)) == len(rows)
        assert (found.log_weights >= 0).all()
        if number >= 12:  # the most probable one, of .315, is there for certain
            place = rows.index((0, 1, 0))
            assert found.log_weights[place] == 0


@pytest.mark.parametrize("number", [6, 20])
def test_weighted_sums_are_right_on_average(number):
    """Whatever is summed; the standard error comes from the repetitions themselves."""
    axes = torch.meshgrid(*(support.double() for support in SUPPORTS.values()), indexing="ij")
    functions = [
        lambda a, b, c: torch.ones_like(a),
        lambda a, b, c: (a == 3).double() * (c == 4).double() * 100,
        lambda a, b, c: a * b - c,
    ]
    exact = torch.stack([function(*axes).sum() for function in functions])
    totals = []
    for seed in range(3000):
        found = chosen(number, seed)
        rows = [found.values[site].double() for site in SUPPORTS]
        weights = found.log_weights.double().exp()
        totals.append(torch.stack([(weights * function(*rows)).sum() for function in functions]))
    found = torch.stack(totals)
    error = found.std(0) / math.sqrt(len(found))
    assert ((found.mean(0) - exact).abs() < 5 * error).all()


def test_what_is_kept_stands_for_what_is_not():
    found = chosen(30)
    useful = torch.softmax(torch.arange(30.0) / 4, 0)
    something = torch.arange(30.0).double()
    totals = []
    for seed in range(2000):
        kept = found.thinned(useful, 8, seed)
        assert abs(len(kept.kept) - 8) <= 1
        totals.append((something[kept.kept] / kept.log_kept.double().exp()).sum())
    totals = torch.stack(totals)
    error = totals.std() / math.sqrt(len(totals))
    assert abs(totals.mean() - something.sum()) < 5 * error


def test_sites_are_proposed_by_probable_people(per_item):
    ways = drawn(per_item, 2)
    ways |= {site: torch.tensor([0.2, 0.8]).view(2, 1, 1) for site in NOTICES}
    found = site_probabilities(per_item, ways)
    for site in NOTICED:
        expected = (geometric(0.2) + geometric(0.8)) / 2
        torch.testing.assert_close(found[site], expected, rtol=1e-4, atol=1e-6)
    found = site_probabilities(per_item, ways, torch.tensor([0.0, 1.0]))
    torch.testing.assert_close(found[NOTICED[0]], geometric(0.8), rtol=1e-4, atol=1e-6)


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
    """Of a probability on a grid, all else known; draws are weighted, so errors are theirs."""
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


@pytest.mark.parametrize("guide", ["svi", "nuts"])
def test_other_guides_agree_with_importance_sampling(self_model, guide):
    """On a posterior of one number: means within .15 and half of the spread of each other."""
    human = Fixed(self_model)
    truth = {NOTICES[0]: torch.tensor([[0.1]])}
    rounds = play_rounds(human, truth, 6, "fog", torch.Generator().manual_seed(1))
    found = {}
    for name in ("importance", guide):
        options = InferenceOptions(name, 100, SVIOptions(steps=150) if name == "svi" else None)
        found[name] = infer(human, rounds, options, 0).draws[NOTICES[0]].flatten()
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


def example(self_model):
    path = EXAMPLES / "distracted.py"
    return load_human_model(f"{path}:DistractedPerson", self_model)


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


# --- in communication


def past_of(recordings, time):
    observation, _, actions, _ = vars(rounds_of(recordings, 0).at(0, 1)).values()
    whole = recordings.observation()
    return RoundSoFar(
        {name: value[0, 0, : time + 1] for name, value in whole.items()},
        actions[0, :time],
        {name: torch.zeros(time, 4, dtype=torch.bool) for name in observation if name != "ego"},
    )


def test_who_acts_as_if_they_saw_has_noticed(self_model, recordings):
    """Weights of attention are likelihoods of what was done so far."""
    human = OneItem(self_model)
    draws = drawn(human, 300) | {NOTICES[0]: torch.full((300, 1, 1), 0.3)}
    draws["consistency"], draws["lapse"] = draws["lapse"] * 0 + 4, draws["lapse"] * 0 + 0.02
    for site in ("residual_in", "residual_out"):
        draws[site] = draws[site] * 0
    someone = Person(human, draws)
    assert someone.percept_count == 1
    for time in (0, 9):
        past = past_of(recordings, time)
        there = someone.in_round(past)
        when = there.percepts[NOTICED[0]][there.percept]
        log_weights = geometric(0.3).log()
        if time:
            each = by_hand(human, {n: v[0] for n, v in draws.items()}, recordings, 0, 0)
            log_weights = log_weights + each[:, torch.arange(time), past.actions].sum(-1)
        expected = torch.softmax(log_weights, 0)
        found = torch.bincount(when, minlength=STEPS + 1) / 300
        error = 5 * (expected * (1 - expected) / 300).sqrt() + 1e-3
        assert ((found - expected).abs() < error).all()
        assert there.in_round(past).percepts.keys() == there.percepts.keys()
    assert someone.percept_count == 1  # untouched
    bare = HumanModel(self_model)
    unchanged = Person(bare, drawn(bare, 2))
    assert unchanged.in_round(past_of(recordings, 3)) is unchanged


def test_rare_attention_is_found_out(self_model, recordings):
    """A person who is hardly ever away does what only a person who is away would do."""
    human = example(self_model)
    draws = drawn(human, 200)
    draws |= {"distracted": torch.full((200, 1, 1), 0.02)}
    for site in ("sight_front_own", "sight_front_other", "sight_back_own", "sight_back_other"):
        draws[site] = torch.full((200, 1, 1), 6)
    draws["consistency"], draws["lapse"] = draws["lapse"] * 0 + 5, draws["lapse"] * 0 + 0.001
    for site in ("residual_in", "residual_out"):
        draws[site] = draws[site] * 0
    someone, told = Person(human, draws), 0
    for number in range(10):
        past = past_of(recordings.select_rounds([number]), 12)
        there = someone.in_round(past)
        away = (there.percepts["away"][there.percept] == 1).double().mean()
        values = torch.tensor([0.0, 1.0])
        alike = {n: value[:1] for n, value in draws.items()}
        log_probabilities = Person(human, alike)._log_probabilities({"away": values}, past)[0]
        expected = torch.softmax(log_probabilities + torch.tensor([0.98, 0.02]).log(), 0)[1]
        # Assumptions differ between draws, the first of which is held against all.
        if expected > 0.9:
            told += 1
            assert away > 0.5
    assert told > 0


def test_a_communicator_plans_for_a_person_who_attends(per_item, recordings):
    someone = Person(per_item, drawn(per_item, 8))
    communicator = Communicator(someone, ExpectedUtility(SelfModelWorld(per_item.self_model), 3))
    for time in (0, 5):
        past = past_of(recordings, time)
        assert communicator.plan(past).message == communicator.plan(past).message
        context = PlanningContext.of(someone, past)
        assert context.person.percept_count > someone.percept_count


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
        ("raises", r"Wrong.round_latents fails: KeyError: 'nothing' \(test_attention.py, line"),
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
    message = '"away" of round_latents depends on a discrete site that perceive'
    with pytest.raises(HumanModelError, match=message):
        build_view_table(ReadsSight(self_model), one)
