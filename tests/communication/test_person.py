"""People in planning: their draws, what they see, how they act, what is news to them."""

import itertools

import pytest
import torch
from example_course import perceived
from example_person import (
    ASSUMED,
    CHANNELS,
    DOMAIN,
    Averaging,
    begun,
    flags,
    human,
    implants,
    person,
    random_round,
    self_model,
    varied_draws,
)
from example_plans import ACTIONS, candidates_of

from mirror_ppl.communication import ExpectedUtility, Person, SimulatorWorld
from mirror_ppl.communication.decision import standard_error
from mirror_ppl.communication.hearing import hearing
from mirror_ppl.communication.person import PlanningContext
from mirror_ppl.errors import HumanModelError
from mirror_ppl.models.belief_tracking import BeliefState


@pytest.mark.parametrize("number", [None, 0])
def test_without_draws_there_is_no_person(number):
    draws = {} if number is None else implants(number)
    with pytest.raises(HumanModelError) as error:
        Person(human(), draws)
    assert str(error.value) == "planning needs at least one posterior draw"


@pytest.mark.parametrize("site", ["sight_back_own", *ASSUMED, "consistency", "residual_out"])
def test_a_site_without_draws_is_refused(site):
    draws = implants(3)
    del draws[site]
    with pytest.raises(HumanModelError) as error:
        Person(human(), draws)
    assert str(error.value) == f"there are no draws of the site {site}"


def test_all_sites_without_draws_are_named():
    draws = implants(3)
    del draws["sight_front_own"], draws["lapse"]
    with pytest.raises(HumanModelError, match=r"of the site sight_front_own, lapse$"):
        Person(human(), draws)


def test_draws_with_the_same_perception_share_an_percept():
    values = {
        "sight_front_own": [1, 2, 1, 1, 2, 1, 1],
        "assumes_clear": [0, 0, 0, 1, 0, 0, 0],
        "assumes_closing": [1, 1, 1, 1, 1, 1, 0],
    }
    someone = person(7, **values, lapse=[0.1] * 5 + [0.2] * 2)
    assert someone.number == 7
    assert someone.percept_count == 4
    groups = [[0, 2, 5], [1, 4], [3], [6]]
    for group in groups:
        assert len(set(someone.percept[group].tolist())) == 1
    assert len(set(someone.percept.tolist())) == 4
    for name, value in values.items():
        assert someone.percepts[name][someone.percept].tolist() == value
    # Sites that are not discrete say nothing of percepts.
    assert "lapse" not in someone.percepts


def test_everybody_sees_for_themselves():
    past = begun(0, [3, 9, -2, -9], [-1, 1, 1, -1])
    someone = person(
        3,
        front_own=[0, 4, 4],
        back_own=[2, 0, 0],
        assumes_clear=[0, 1, 1],
        assumes_closing=[1, 1, 0],
    )
    observation = {name: value.expand(3, 1, *value.shape) for name, value in past.now.items()}
    nothing = CHANNELS.split(torch.zeros(3, 1, len(CHANNELS), dtype=torch.bool))
    view = perceived(
        human(), {n: v[someone.percept] for n, v in someone.percepts.items()}, observation, nothing
    )
    behind, ahead = [False, False, True, False], [True, False, False, False]
    assert view.visible["visual"][:, 0].tolist() == [behind, ahead, ahead]
    others = [False, True, True, True]
    assert view.taken["visual"][:, 0].tolist() == [[False] * 4, others, others]
    # How the car moves that they see can only be assumed: closer, from behind and from ahead.
    assert view.taken["verbal"][:, 0].tolist() == [behind, ahead, [False] * 4]
    assert view.imagined["verbal"][0, 0, 2].tolist() == [-2, 0, 1]
    assert view.imagined["verbal"][1, 0, 0].tolist() == [3, 0, -1]
    assert view.visible["verbal"].shape == (3, 1, 4)
    assert not view.visible["verbal"].any()
    # A look at one step is the same, and tells what they have learned.
    rows = torch.arange(3)
    first = {name: value[:, 0] for name, value in observation.items()}
    told = {name: mask[:, 0] for name, mask in nothing.items()}
    transition = someone.transition(someone.percept, told["visual"][:, 0], first, told, rows)
    (look,), (after,) = BeliefState.initial(human(), 3).perceive([transition])
    assert torch.equal(look.numbers(), view.numbers()[:, 0])
    assert after.unsure.tolist() == [behind, ahead, ahead]


def test_each_draw_acts_by_its_own_implants(generator):
    draws = varied_draws(3, generator)
    someone = Person(human(), draws)
    belief = torch.randn(3, 4, self_model().latent, generator=generator)
    values = torch.randn(3, 4, ACTIONS, generator=generator)
    together = someone.act(belief, values)
    assert together.shape == (3, 4, ACTIONS)
    for s, m in itertools.product(range(3), range(4)):
        own = {name: value[s] for name, value in draws.items()}
        alone = human().act(own, belief[s, m][None, None], values[s, m][None, None])
        torch.testing.assert_close(together[s, m], alone[0, 0])
    # Where draws share beliefs it is as if each had them.
    shared = someone.act(belief[:1], values[:1])
    torch.testing.assert_close(shared, someone.act(belief[:1].expand(3, -1, -1), values[:1]))


def test_items_are_informative_where_a_person_does_not_know_them_yet():
    # One sees two cells ahead, the other nothing.
    two = DOMAIN.reach_bins.index(2.0)
    someone = person(2, front_own=[two, 0], front_other=[two, 0])
    past = begun(0, [2, 9, -9, -30], [-1, 1, 1, -1])
    allowed = CHANNELS.join(DOMAIN.communicable(past.now))
    assert torch.equal(PlanningContext.of(someone, past).telling(allowed), allowed)
    told = CHANNELS.split(flags(verbal=["rear-left"]))
    past = past.then(told, 0, begun(0, [1, 10, -8, -30], [-1, 1, 1, -1]).now)
    # Whoever heard of a car knows where it is; of the others they may learn more.
    left = allowed & ~flags(visual=["rear-left"], verbal=["rear-left"])
    assert torch.equal(PlanningContext.of(someone, past).telling(allowed), left)
    # The first knows the car in front, having seen it twice; the second does not.
    sighted = person(1, front_own=two, front_other=two)
    left &= ~flags(["front-left"], ["front-left"])
    assert torch.equal(PlanningContext.of(sighted, past).telling(allowed), left)
    # Of a model that remembers more it is the same.
    sighted = person(1, Averaging(self_model()), front_own=two, front_other=two)
    assert torch.equal(PlanningContext.of(sighted, past).telling(allowed), left)


def test_draws_that_repeat_are_no_further_evidence(generator):
    """Their mean and its standard error are those of the draws that there are."""
    draws = varied_draws(5, generator)
    past, _ = random_round(2, generator)
    candidates = candidates_of(past, generator, 2)
    found = []
    for order in (torch.arange(5), torch.arange(16) % 5, torch.arange(20) % 5):
        someone = Person(human(), {name: value[order] for name, value in draws.items()})
        assert someone.cycle == (1 if len(order) == 5 else 5)
        assert hearing(someone, 0.9).cycle == someone.cycle
        utility = ExpectedUtility(SimulatorWorld(DOMAIN), 3, enumerate_above=0.0)
        valued = utility.at(PlanningContext.of(someone, past), 5, 0)(candidates)
        gains = valued.utility - valued.utility[:1]
        found.append((valued.mean, standard_error(valued, gains)))
    for other in found[1:]:
        torch.testing.assert_close(other, found[0], rtol=1e-3, atol=1e-5)


def test_draws_that_are_alike_or_in_no_order_are_not_taken_for_repeated(generator):
    draws = varied_draws(3, generator)
    for order in ([0, 0, 0], [0, 1, 0, 2], [0, 1, 2, 0, 2], [1, 2]):
        someone = Person(human(), {name: value[order] for name, value in draws.items()})
        assert someone.cycle == 1
