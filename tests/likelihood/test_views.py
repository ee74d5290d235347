"""Tables of what people may have seen."""

import math
from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_person import AssumesAtOddSteps, Averaging, Unused
from example_views import (
    ASSUMED,
    LENGTHS,
    SIGHTS,
    STEPS,
    Few,
    Sure,
    assert_tables_equal,
    log_likelihoods_by_hand,
    policies,
    ragged,
)

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.combinations import MAX_COMBINATIONS
from mirror_ppl.likelihood.points import whole_grid
from mirror_ppl.likelihood.table_program import log_likelihoods
from mirror_ppl.likelihood.tables import build_view_table, combination_scores, restricted
from mirror_ppl.likelihood.view_table import IMPOSSIBLE, NO_VIEW, RecordedActions
from mirror_ppl.models import HumanModel


@pytest.fixture(scope="module")
def recordings():
    return load_demonstrations(asset_path("driving_fog_diverse.nc"))


# --- tables of views --------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [HumanModel, Averaging, AssumesAtOddSteps, Few])
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


def test_perceive_may_only_read_sites(self_model, recordings):
    class Dreamer(HumanModel):
        def perceive(self, implants, knowledge, observation, told, step):
            implants["dreams"]
            return super().perceive(implants, knowledge, observation, told, step)

    message = 'perceive\\(\\) reads "dreams", which is no site that prior.*sight_front_own'
    with pytest.raises(HumanModelError, match=message):
        build_view_table(Dreamer(self_model), recordings)


def test_too_many_combinations_are_refused(self_model):
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
        whole_grid(Many(self_model))
    assert whole_grid(Few(self_model)).number == 14
