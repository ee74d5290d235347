"""Views: those that the self-model is trained under, and tables of what people may have seen."""

import math
from dataclasses import fields, replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_course import gone_through
from example_person import Averaging, Unused

from mirror_ppl.data import Demonstrations, asset_path, load_demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.domains.base import roll_out
from mirror_ppl.domains.driving import DrivingState
from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.combinations import MAX_COMBINATIONS, log_priors
from mirror_ppl.likelihood.enumeration import combination_values
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.table_program import log_likelihoods
from mirror_ppl.likelihood.tables import (
    build_view_table,
    combination_scores,
    restricted,
    rounds_of,
)
from mirror_ppl.likelihood.view_table import IMPOSSIBLE, NO_VIEW, RecordedActions
from mirror_ppl.likelihood.view_table_builder import GROWTH, ViewTableBuilder
from mirror_ppl.models import HumanModel, View
from mirror_ppl.models.implants import assumption_sites, policy_implants, sight_sites
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.training.views import (
    KIND_PROBABILITIES,
    TOLD_PROBABILITY,
    draw_views,
)

DRIVING = get_domain("driving")
STEPS = DRIVING.horizon
SIGHTS, ASSUMED = sight_sites(DRIVING), assumption_sites(DRIVING)


class Few(HumanModel):
    """A person with unknown sight ahead in their lane, and unknown assumptions.

    Of cars that they saw once, they assume that these come closer; of others it is open.
    """

    KNOWN = {
        "sight_front_other": 2,
        "sight_back_own": 0,
        "sight_back_other": 0,
        "assumes_closing": 1,
    }

    def prior(self):
        bins = torch.arange(1.0, len(self.domain.reach_bins) + 1)
        own = {
            "sight_front_own": pyro.sample("sight_front_own", dist.Categorical(bins / bins.sum())),
            "assumes_clear": pyro.sample(
                "assumes_clear", dist.Categorical(torch.tensor([0.3, 0.7]))
            ),
        }
        like = next(self.self_model.parameters())
        return own | policy_implants(self.domain, self.self_model.latent, like)

    def perceive(self, implants, knowledge, observation, told, step):
        known = {
            site: torch.full_like(implants["sight_front_own"], value)
            for site, value in self.KNOWN.items()
        }
        own = {site: implants[site] for site in ("sight_front_own", "assumes_clear")}
        return super().perceive(known | own, knowledge, observation, told, step)


class Sure(Few):
    """A person of whom only the policy is unknown."""

    def prior(self):
        like = next(self.self_model.parameters())
        return policy_implants(self.domain, self.self_model.latent, like)

    def perceive(self, implants, knowledge, observation, told, step):
        return View(self.domain.visibility("fog", observation)), knowledge


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


@pytest.fixture(scope="module")
def recordings():
    return load_demonstrations(asset_path("driving_fog_diverse.nc"))


def ragged(recordings, lengths):
    """Rounds of these lengths, ``lengths[person][round]``, in which now and then something is told.

    What stands in the padding of the arrays is what was recorded there.
    """
    most = max(1, *map(len, lengths))
    some = recordings.select_people(range(len(lengths))).select_rounds(range(most))
    variables = some.variables()
    generator = torch.Generator().manual_seed(2)
    for name in ("told_visual", "told_verbal"):
        shape = variables[name].shape
        variables[name] = torch.rand(shape, generator=generator) < 0.1
    variables["round_count"] = torch.tensor([len(rounds) for rounds in lengths])
    padded = [[*rounds, *[0] * (most - len(rounds))] for rounds in lengths]
    variables["length"] = torch.tensor(padded)
    return Demonstrations.from_variables(some.domain, some.setting, some.people, variables)


LENGTHS = [[15, 4], [], [7, 1]]


def policies(human, number, people):
    """Draws ``[S, P, 1, ...]`` of the policy implants from the prior."""
    plates = pyro.plate("draw", number, dim=-3), pyro.plate("person", people, dim=-2)
    with plates[0], plates[1]:
        return policy_implants(DRIVING, human.self_model.latent, torch.zeros(()))


def log_likelihoods_by_hand(human, rounds, person, number, values, policy):
    """Of one round ``[M]``: each combination by itself, one step after the other.

    Args:
        values: the discrete implants ``[M]`` by name.
        policy: the others, ``[1, 1, ...]``.
    """
    steps = int(rounds.lengths[person, number])
    observation = {
        name: value[person, number, :steps][None] for name, value in rounds.observation().items()
    }
    told = {name: value[person, number, :steps][None] for name, value in rounds.told.items()}
    actions = rounds.actions[person, number, :steps][None]
    result = []
    for one in range(len(next(iter(values.values())))):
        implants = {site: value[one : one + 1] for site, value in values.items()}
        belief = gone_through(human, implants, observation, told, actions)
        chosen = human.act(policy, belief, human.action_values(belief))
        result.append(chosen[0].gather(-1, actions[0, :, None]).sum())
    return torch.stack(result)


def assert_tables_equal(one, other, tolerance=0.0):
    for field in fields(one):
        left, right = getattr(one, field.name), getattr(other, field.name)
        if isinstance(left, torch.Tensor):
            torch.testing.assert_close(left, right, rtol=0.0, atol=tolerance)
        else:
            assert left == right, field.name


def assert_rounds_equal(one, other):
    """Each combination has the same rounds in both tables, however their views are numbered."""

    def rounds_of_combinations(table):
        people = torch.arange(len(table.index))[:, None, None]
        moments = table.moments[people, table.index.clamp(min=0)]  # [P, B, M, T]
        real = (moments != NO_VIEW) & (table.index != NO_VIEW)[..., None]
        place = people[..., None], moments.clamp(min=0)
        belief, values = (part[place] * real[..., None] for part in (table.belief, table.values))
        return real, belief, values, table.acted[place] * real, table.recorded, table.steps

    assert (one.sites, one.sizes) == (other.sites, other.sizes)
    assert torch.equal(one.index == NO_VIEW, other.index == NO_VIEW)
    assert torch.equal(one.view_counts, other.view_counts)
    assert one.belief.shape == other.belief.shape and one.moments.shape == other.moments.shape
    parts = zip(rounds_of_combinations(one), rounds_of_combinations(other), strict=True)
    for mine, theirs in parts:
        torch.testing.assert_close(mine, theirs, rtol=0.0, atol=1e-4)


# --- tables of views --------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [HumanModel, Averaging, Few], ids=["own", "averaging", "few"])
def test_table_agrees_with_perceive_believe_act(self_model, recordings, kind):
    human, rounds = kind(self_model), ragged(recordings, LENGTHS)
    number = 14 if kind is Few else 9604
    some = torch.randperm(number)[:28].sort().values
    table = build_view_table(human, rounds, [some] * 3)
    assert table.sites == ((*SIGHTS, *ASSUMED) if number > 14 else (SIGHTS[0], ASSUMED[0]))
    assert math.prod(table.sizes) == table.index.shape[-1] == number
    policy = {name: value[0] for name, value in policies(human, 1, 1).items()}
    found = combination_scores(table, log_likelihoods(human, policy, table))
    axes = torch.unravel_index(some, table.sizes)
    values = dict(zip(table.sites, axes, strict=True))
    for person, lengths in enumerate(LENGTHS):
        expected = torch.zeros(len(some))
        for index in range(len(lengths)):
            expected += log_likelihoods_by_hand(human, rounds, person, index, values, policy)
        torch.testing.assert_close(found[person, some], expected, rtol=1e-4, atol=1e-4)
    # What is not looked at is out of the question, wherever there is a round to tell.
    others = torch.ones(number, dtype=torch.bool)
    others[some] = False
    assert (found[0, others] == IMPOSSIBLE).all()
    assert (found[1] == 0).all()


def test_views_are_looked_up_by_combination(self_model, recordings):
    table = build_view_table(Few(self_model), ragged(recordings, LENGTHS))
    sights, clear = torch.meshgrid(torch.arange(7), torch.arange(2), indexing="ij")
    implants = {"sight_front_own": sights.flatten(), "assumes_clear": clear.flatten()}
    assert torch.equal(table.combination(implants), torch.arange(14))
    # [E, P, 1] and [P, 1]: a leading dimension of enumeration is kept.
    enumerated = {name: value[:, None, None] for name, value in implants.items()}
    assert torch.equal(table.sight_of(enumerated), table.index.permute(2, 0, 1))
    mixed = {"sight_front_own": torch.tensor([[1], [0], [6]]), "assumes_clear": torch.ones(3, 1)}
    expected = table.index[torch.arange(3), :, torch.tensor([3, 1, 13])]
    assert torch.equal(table.sight_of(mixed), expected)


def test_no_view_is_kept_twice_or_for_nothing(self_model, recordings):
    table = build_view_table(Few(self_model), ragged(recordings, LENGTHS))
    assert table.view_counts.tolist()[1] == 1  # of padding, to be looked up
    for person, lengths in enumerate(LENGTHS):
        used = table.index[person][table.index[person] != NO_VIEW].unique()
        assert used.tolist() == list(range(int(table.view_counts[person])))
        assert (table.index[person, len(lengths) or 1 :] == NO_VIEW).all()
        assert table.real[person].tolist() == [True] * len(lengths) + [False] * (2 - len(lengths))
        for number in range(len(lengths)):
            views = table.index[person, number].unique()
            # A view belongs to one round: its actions and steps are those of that round.
            steps = torch.arange(STEPS) < lengths[number]
            moments = table.moments[person, views]
            assert torch.equal(moments != NO_VIEW, steps.expand(len(views), -1))
            real = rounds_actions(recordings, person, number)[steps]
            assert (table.acted[person, moments[:, steps]] == real).all()
            # Different views lead to different beliefs, so none is there twice.
            beliefs = table.belief[person, moments[:, steps]].flatten(1)
            assert len(beliefs.unique(dim=0)) == len(views)
        moments = table.moments[person][table.moments[person] != NO_VIEW]
        used = moments.unique()
        assert used.tolist() == list(range(len(used)))
        assert (table.belief[person, max(len(used), 1) :] == 0).all()


def rounds_actions(recordings, person, number):
    return recordings.actions[person, number]


def test_values_of_shared_beginnings_are_those_of_the_belief(self_model, recordings):
    table = build_view_table(HumanModel(self_model), ragged(recordings, [[15], [9]]))
    assert table.view_counts.min() > 50
    with torch.no_grad():
        expected = self_model.action_values(table.belief)
    close = (table.values - expected).abs().amax(-1) < 1e-4
    assert close.shape[1] > 500
    for person in range(2):
        assert close[person, table.moments[person].clamp(min=0)].all()


def test_padding_has_no_influence(self_model, recordings):
    human, rounds = Few(self_model), ragged(recordings, LENGTHS)
    policy = {name: value[0] for name, value in policies(human, 1, 1).items()}

    def scores(rounds):
        table = build_view_table(human, rounds)
        return combination_scores(table, log_likelihoods(human, policy, table))

    together = scores(rounds)
    for person, lengths in enumerate(LENGTHS):
        alone = torch.zeros(14)
        for number in range(len(lengths)):
            one = rounds.select_people([person]).select_rounds([number])
            assert one.shape == (1, 1, lengths[number])  # no padding
            alone += scores(one)[0]
        torch.testing.assert_close(together[person], alone, rtol=1e-4, atol=1e-4)


def test_recorded_actions_by_hand():
    likelihood = torch.tensor([[-1.0, -2.0, -3.0], [-4.0, -5.0, -6.0]]).requires_grad_()
    place = torch.tensor([[[0], [1]], [[2], [NO_VIEW]]])  # [E, P, 1]
    actions = RecordedActions(likelihood, place, torch.Size((4, 15)))
    found = actions.log_prob(torch.zeros(2, 2, 1, 4, 15))
    expected = [[[-1.0], [-5.0]], [[-3.0], [IMPOSSIBLE]]]
    assert found.tolist() == expected
    assert actions.batch_shape == (2, 2, 1) and actions.event_shape == (4, 15)
    found.sum().backward()
    assert likelihood.grad.tolist() == [[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]]
    # Enumerated likelihoods [E', 1, P, C] broadcast against enumerated places.
    many = torch.stack([likelihood.detach(), 10 * likelihood.detach()])[:, None]
    both = RecordedActions(many, place, torch.Size((4, 15))).log_prob(torch.zeros(4, 15))
    assert both.shape == (2, 2, 2, 1)
    assert both[0].tolist() == expected
    assert both[1, 0].tolist() == [[-10.0], [-50.0]]


def test_scores_are_those_of_the_possible_combinations(self_model, recordings):
    human, rounds = Few(self_model), ragged(recordings, LENGTHS)
    whole = build_view_table(human, rounds)
    alive = (torch.arange(14) + torch.arange(3)[:, None]) % 3 == 0
    table = restricted(whole, alive)
    # Of a person without rounds nothing is given up.
    assert torch.equal(table.possible, alive | ~table.real.any(-1)[:, None])
    policy = {name: value[0] for name, value in policies(human, 1, 1).items()}
    likelihoods = log_likelihoods(human, policy, table)
    expected = combination_scores(table, likelihoods)
    found = table.scores(likelihoods)
    for combination in range(14):
        implants = {
            "sight_front_own": torch.full((3, 1), combination // 2),
            "assumes_clear": torch.full((3, 1), combination % 2),
        }
        place = table.place_of(implants)[:, 0]
        for person in range(3):
            if table.possible[person, combination]:
                torch.testing.assert_close(
                    found[person, place[person]], expected[person, combination]
                )
            else:
                assert place[person] == NO_VIEW


# --- giving combinations up -------------------------------------------------------------------


def test_infinite_margin_without_merging_changes_nothing(self_model, recordings):
    rounds = ragged(recordings, LENGTHS)
    for human in (Few(self_model), Sure(self_model)):
        screening = Screening(margin=math.inf, resolution=0.0)
        assert_rounds_equal(
            build_view_table(human, rounds, screening=screening), build_view_table(human, rounds)
        )


@pytest.mark.parametrize("margin", [0.7, 2.0, 15.0])
def test_screening_drops_whoever_falls_behind_and_never_the_best(self_model, recordings, margin):
    human, screening = Few(self_model), Screening(margin=margin, resolution=0.0)
    rounds = recordings.select_rounds(range(4))
    whole = build_view_table(human, rounds)
    with pyro.plate("policy", screening.policies, dim=-3), pyro.plate("person", 1, dim=-2):
        torch.manual_seed(screening.seed)
        ways = human.prior()
    likelihood = log_likelihoods(human, ways, whole)
    grid = combination_values(human, whole)
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
        assert (distance - margin).abs().min() > 1e-3
        expected &= distance <= margin
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


def test_a_memory_that_is_not_used_leaves_the_likelihoods_as_they_are(self_model, recordings):
    rounds, found = ragged(recordings, LENGTHS), []
    some = torch.randperm(9604)[:40].sort().values
    policy = {name: value[0] for name, value in policies(HumanModel(self_model), 1, 1).items()}
    for kind in (HumanModel, Unused, Averaging):
        human = kind(self_model)
        table = build_view_table(human, rounds, [some] * 3)
        found.append(combination_scores(table, log_likelihoods(human, policy, table)))
        assert table.belief.shape[-1] == human.belief_size
    torch.testing.assert_close(found[0], found[1], rtol=1e-4, atol=1e-4)
    assert (found[0] - found[2]).abs().max() > 0.1


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


def test_restricted_keeps_what_is_alive_and_forgets_the_rest(self_model, recordings):
    human = Few(self_model)
    table = build_view_table(human, ragged(recordings, LENGTHS))
    before = replace(table, index=table.index.clone())
    alive = (torch.arange(14) + torch.arange(3)[:, None]) % 4 == 0
    small = restricted(table, alive)
    assert_tables_equal(table, before)  # untouched
    scores = {}
    policy = {name: value[0] for name, value in policies(human, 1, 1).items()}
    for name, part in (("all", table), ("some", small)):
        scores[name] = combination_scores(part, log_likelihoods(human, policy, part))
    assert torch.equal(scores["some"][alive], scores["all"][alive])
    assert (scores["some"][0][~alive[0]] == IMPOSSIBLE).all()
    for person in range(3):
        used = small.index[person][small.index[person] != NO_VIEW].unique()
        assert used.tolist() == list(range(int(small.view_counts[person])))
    assert small.moments.shape[1] == small.view_counts.max() < table.moments.shape[1]
    assert small.belief.shape[1] < table.belief.shape[1]
    # Bit by bit is the same as at once.
    first = alive | (torch.rand(3, 14) < 0.5)
    assert_tables_equal(restricted(restricted(table, first), alive), small)
    assert_tables_equal(restricted(small, torch.ones_like(alive)), small)


# --- what cannot be tabulated -----------------------------------------------------------------


def test_people_without_discrete_implants_have_one_view_a_round(self_model, recordings):
    table = build_view_table(Sure(self_model), ragged(recordings, LENGTHS))
    assert (table.sites, table.sizes) == ((), ())
    assert table.index.tolist() == [[[0], [1]], [[0], [-1]], [[0], [1]]]


def test_perceive_may_only_read_what_can_be_enumerated(self_model, recordings):
    class Dreamer(HumanModel):
        def perceive(self, implants, knowledge, observation, told, step):
            implants["lapse"]
            return super().perceive(implants, knowledge, observation, told, step)

    message = 'perceive\\(\\) reads "lapse", which is not a discrete site .*sight_front_own'
    with pytest.raises(HumanModelError, match=message):
        build_view_table(Dreamer(self_model), recordings)


def test_too_many_combinations_are_refused(self_model, recordings):
    class Many(Few):
        def prior(self):
            size = MAX_COMBINATIONS // 14 + 1
            many = pyro.sample("many", dist.Categorical(torch.ones(size) / size))
            return super().prior() | {"many": many}

        def perceive(self, implants, knowledge, observation, told, step):
            implants["many"]
            return super().perceive(implants, knowledge, observation, told, step)

    message = rf"depends on {14 * (MAX_COMBINATIONS // 14 + 1)} combinations .* at most 100000"
    with pytest.raises(HumanModelError, match=message):
        build_view_table(Many(self_model), recordings)


# --- views of training -----------------------------------------------------------------------


def standard_error(share, number):
    return math.sqrt(share * (1 - share) / number)


@pytest.fixture(scope="module")
def many_views():
    """20,000 views of one course of a round, with the plan they come from."""
    generator = torch.Generator().manual_seed(11)
    plan = draw_views(DRIVING, 20_000, STEPS, generator)
    # A slow car 3 cells ahead, and one 2 cells behind in the other lane.
    start = DrivingState(
        torch.zeros(20_000, dtype=torch.long),
        torch.tensor([3, 11, -11, -2]).expand(20_000, 4),
        torch.tensor([-1, 1, -1, -1]).expand(20_000, 4),
    )
    states = roll_out(DRIVING, start, torch.zeros(20_000, STEPS, dtype=torch.long))
    observation = DRIVING.observe(states)
    return plan, observation, plan.visibility(DRIVING, observation)


def kinds(plan):
    """Which views are full, dropout and sight; told apart by what they keep of either modality."""
    visual, verbal = plan.keep["visual"], plan.keep["verbal"]
    return (visual == 1) & (verbal == 1), visual < 1, (visual == 1) & (verbal == 0)


def test_kinds_of_views_come_as_often_as_stated(many_views):
    plan, _, _ = many_views
    full, dropout, sight = kinds(plan)
    assert torch.equal(full.long() + dropout.long() + sight.long(), torch.ones(20_000).long())
    for kind, share in zip((full, dropout, sight), KIND_PROBABILITIES, strict=True):
        error = standard_error(share, 20_000)
        assert kind.float().mean().item() == pytest.approx(share, abs=4 * error)
    number = int(sight.sum())
    assert torch.equal(plan.remembers, sight)
    spoken_to = plan.told["visual"] > 0
    assert not spoken_to[~sight].any()
    assert torch.equal(spoken_to, plan.told["verbal"] > 0)
    error = standard_error(TOLD_PROBABILITY, number)
    assert spoken_to[sight].float().mean().item() == pytest.approx(TOLD_PROBABILITY, abs=4 * error)
    # Each reach is equally likely in each direction; only sight is limited.
    assert (plan.reach[~sight] == DRIVING.reach_bins[-1]).all()
    bins = len(DRIVING.reach_bins)
    for edge in DRIVING.reach_bins:
        share = (plan.reach[sight] == edge).float().mean(0)
        assert (share - 1 / bins).abs().max() < 4.5 * standard_error(1 / bins, number)


def test_full_views_show_and_communicate_everything(many_views):
    plan, _, visible = many_views
    full, _, _ = kinds(plan)
    assert visible["visual"][full].all()
    assert visible["verbal"][full].all()


def test_dropout_views_keep_each_item_at_the_rate_of_the_round(many_views):
    plan, _, visible = many_views
    _, dropout, _ = kinds(plan)
    for name in ("visual", "verbal"):
        kept = visible[name][dropout].float()
        rate = plan.keep[name][dropout]
        number = kept[0].numel()
        # Standardized by round; their squares average to one, with a standard error of at most
        # sqrt(3 / n), as the kurtosis is at most that of the rarest rate tried.
        middle = (rate > 0.1) & (rate < 0.9)
        error = (rate * (1 - rate) / number).sqrt()
        standardized = ((kept.mean((1, 2)) - rate) / error)[middle]
        count = len(standardized)
        assert standardized.mean().abs().item() < 4 / math.sqrt(count)
        assert standardized.square().mean().item() == pytest.approx(
            1.0, abs=4 * math.sqrt(3 / count)
        )
    # Of the two modalities, each has a rate of its own.
    rates = torch.stack([plan.keep[name][dropout] for name in ("visual", "verbal")])
    assert torch.corrcoef(rates)[0, 1].abs().item() < 4 / math.sqrt(rates.shape[1])


def test_sight_views_show_cars_within_reach_and_communicated_items(many_views):
    plan, observation, visible = many_views
    _, _, sight = kinds(plan)
    direction, distance = DRIVING.distance(observation)
    near = distance <= plan.reach[torch.arange(20_000)[:, None, None], direction]
    quiet = sight & (plan.told["visual"] == 0)
    assert torch.equal(visible["visual"][quiet], near[quiet])
    assert not visible["verbal"][quiet].any()
    spoken_to = sight & (plan.told["visual"] > 0)
    allowed = DRIVING.communicable(observation)
    assert not (visible["verbal"] & ~allowed["verbal"])[spoken_to].any()
    assert (visible["visual"] | ~near)[spoken_to].all()
    extra = (visible["visual"] & ~near)[spoken_to]
    assert not (extra & ~allowed["visual"][spoken_to]).any()
    # As often as stated, over all occasions to tell: the rate of a round is at most one half.
    for name in ("visual", "verbal"):
        rate = plan.told[name][spoken_to]
        assert rate.max() <= 0.5
        occasions = allowed[name] & ~near if name == "visual" else allowed[name]
        occasions = occasions[spoken_to].flatten(1).sum(1)
        told = (extra if name == "visual" else visible[name][spoken_to]).flatten(1).sum(1)
        variance = (occasions * rate * (1 - rate)).sum()
        assert (told - occasions * rate).sum().abs() < 4 * variance.sqrt()


def test_a_plan_says_the_same_of_each_step_by_itself(many_views):
    plan, observation, visible = many_views
    for step in (0, 7, STEPS):
        now = {name: value[:, step : step + 1] for name, value in observation.items()}
        alone = plan.visibility(DRIVING, now, first=step)
        for name, mask in visible.items():
            assert torch.equal(alone[name], mask[:, step : step + 1])
