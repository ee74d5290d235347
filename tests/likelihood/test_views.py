"""Tables of what people may have seen, and which combinations are given up."""

import math
from dataclasses import fields, replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_person import Averaging, Unused
from example_views import DRIVING, Few, Sure, log_likelihoods_by_hand, policies, ragged
from torch.nn.functional import pad

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood import view_table_builder
from mirror_ppl.likelihood.combinations import MAX_COMBINATIONS, log_priors
from mirror_ppl.likelihood.enumeration import combination_values
from mirror_ppl.likelihood.round_views import Rounds
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.table_program import log_likelihoods
from mirror_ppl.likelihood.tables import build_view_table, combination_scores, restricted, rounds_of
from mirror_ppl.likelihood.view_table import IMPOSSIBLE, NO_VIEW, RecordedActions
from mirror_ppl.likelihood.view_table_builder import GROWTH, ViewTableBuilder
from mirror_ppl.models import HumanModel
from mirror_ppl.models.implants import assumption_sites, sight_sites
from mirror_ppl.models.weights import load_self_model, shipped_weights

STEPS = DRIVING.horizon
SIGHTS, ASSUMED = sight_sites(DRIVING), assumption_sites(DRIVING)
LENGTHS = [[15, 4], [], [7, 1]]


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


@pytest.fixture(scope="module")
def recordings():
    return load_demonstrations(asset_path("driving_fog_diverse.nc"))


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


@pytest.mark.parametrize(("margin", "early"), [(0.7, 0.0), (2.0, 1.5), (15.0, 25.0)])
def test_screening_drops_whoever_falls_behind_and_never_the_best(
    self_model, recordings, margin, early
):
    human, screening = Few(self_model), Screening(margin=margin, early=early, resolution=0.0)
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


@pytest.mark.parametrize("early", [0.0, 1.0])
def test_beginnings_of_long_rounds_drop_combinations_before(
    self_model, recordings, monkeypatch, early
):
    human, rounds = Few(self_model), rounds_of(recordings.select_rounds(range(6)), 0)
    screening = Screening(margin=1.0, early=early, resolution=0.0)
    plain = ViewTableBuilder(human, Screening(margin=1.0 + early, early=0.0, resolution=0.0))
    plain.add(rounds.first_steps(5))
    monkeypatch.setattr(view_table_builder, "MANY", 2)
    monkeypatch.setattr(view_table_builder, "BEGINNING", 5)
    margins, margin_after = [], Screening.margin_after

    def noted(self, number):
        margins.append(number)
        return margin_after(self, number)

    monkeypatch.setattr(Screening, "margin_after", noted)
    monkeypatch.setattr(ViewTableBuilder, "_order", lambda self, rounds: None)
    found = ViewTableBuilder(human, screening)
    found.add(rounds)
    # Rounds 0; 1 to 3; 4 and 5: the beginnings, which count as no rounds, then the whole.
    assert margins == [0, 0, 0, 1, 4, 6]
    begun = [part for part, _ in found._seen][0]
    assert len(begun) < 14
    assert torch.equal(begun, plain.alive)
    after = ViewTableBuilder(human, screening, candidates=begun)
    monkeypatch.setattr(view_table_builder, "MANY", 15)
    after.add(rounds)
    assert torch.equal(found.alive, after.alive) and torch.equal(found.score, after.score)
    assert_tables_equal(found.table(), after.table())
    monkeypatch.setattr(view_table_builder, "MANY", 2)
    margins.clear()
    one_by_one = ViewTableBuilder(human, screening)
    for number in range(3):
        one_by_one.alive = torch.arange(14)
        one_by_one.add(rounds.at(number, number + 1))
    assert margins == [0, 1, 0, 2, 0, 3]
    monkeypatch.setattr(view_table_builder, "LONG", 4)
    for steps in (0, 20):  # padding, as beside people with longer rounds, changes nothing
        short = ViewTableBuilder(human, screening)
        short.add(padded(rounds, steps))
        assert len(short._seen[0][0]) == 14


def padded(rounds, steps):
    """Rounds with unused steps at their ends."""

    def longer(value):
        return torch.cat([value, value[:, -1:].expand(-1, steps, *value.shape[2:])], 1)

    return Rounds(
        {name: longer(value) for name, value in rounds.observation.items()},
        {name: longer(mask) for name, mask in rounds.told.items()},
        longer(rounds.actions),
        pad(rounds.real, [0, steps]),
    )


def test_what_one_round_contradicts_is_kept_until_others_agree(self_model, recordings):
    """A round that leaves one combination 20 nats behind drops it only without other rounds."""
    human = Few(self_model)
    for early, kept in ((0.0, False), (25.0, True)):
        builder = ViewTableBuilder(human, Screening(early=early))
        builder.add(rounds_of(recordings.select_rounds([0]), 0))
        builder.alive, builder._evidence = torch.arange(14), 1.0
        builder.score.zero_()
        found = torch.zeros_like(builder.score)
        found[:, 3] = -20.0
        builder._screen(found, builder.screening)
        assert (3 in builder.alive.tolist()) == kept
        builder._evidence = 20.0
        builder._screen(torch.zeros_like(builder.score)[:, builder.alive], builder.screening)
        assert 3 not in builder.alive.tolist()


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
