"""The communicator: which candidate it chooses, when it is silent, and what it tells of."""

import pytest
import torch
from example_person import (
    CHANNELS,
    DOMAIN,
    FULL_SIGHT,
    begun,
    flags,
    human,
    person,
    plan,
    random_round,
    varied_draws,
)

from mirror_ppl.communication import (
    Automatic,
    Communicator,
    CrossEntropy,
    Divergence,
    Exhaustive,
    ExpectedUtility,
    Gain,
    Person,
    PlanningContext,
    SimulatorWorld,
    Valued,
)
from mirror_ppl.communication.communicator import choose
from mirror_ppl.communication.decision import TIE, gain_over_silence
from mirror_ppl.domains.driving import Driving

WORLD = SimulatorWorld(DOMAIN)


# --- which candidate --------------------------------------------------------------------------


def valued(*utilities, actions=None):
    """Utilities of candidates, each of several draws."""
    return Valued(torch.tensor(utilities), actions)


def test_the_surest_gain_is_chosen_and_not_the_largest():
    # Gains of 4 on average with a standard error of 3, of 2 with one of 0.5, of 1 with none.
    utility = valued([0.0, 0.0], [7.0, 1.0], [2.5, 1.5], [1.0, 1.0])
    assert choose(utility, 0.0) == 1
    assert choose(utility, 0.5) == 1  # 2.5, 1.75, 1
    assert choose(utility, 1.0) == 2  # 1, 1.5, 1
    assert choose(utility, 2.1) == 3  # below 0, 0.95, 1


def test_a_gain_has_to_exceed_its_standard_errors():
    utility = valued([0.0, 0.0, 0.0], [1.0, 2.0, 3.0])  # 2, and 1 / sqrt(3) = 0.577
    assert choose(utility, 3.46) == 1
    assert choose(utility, 3.47) == 0


def test_it_is_the_gain_over_silence_whose_spread_counts():
    """What draws differ in whatever is said does not make a gain less sure."""
    utility = torch.tensor([[-50.0, 0.0, 30.0], [-49.0, 1.0, 31.0]])
    assert choose(Valued(utility, None), 5.0) == 1
    # And a message that is worth the same to all draws is not sure, for silence is not.
    utility = torch.tensor([[-50.0, 0.0, 30.0], [1.0, 1.0, 1.0]])
    assert choose(Valued(utility, None), 2.0) == 0


@pytest.mark.parametrize("gain", [-1.0, 0.0, TIE / 2])
def test_silence_wins_ties(gain):
    assert choose(valued([0.0, 0.0], [gain, gain]), 0.0) == 0
    assert choose(valued([0.0, 0.0], [gain, gain], [2 * TIE, 2 * TIE]), 0.0) == 2


def test_of_equally_good_messages_the_first_is_chosen():
    assert choose(valued([0.0, 0.0], [1.0, 1.0], [3.0, 3.0], [3.0, 3.0]), 2.0) == 2


def test_a_single_draw_is_taken_at_its_word():
    utility = valued([1.0], [1.5], [2.0])
    assert choose(utility, 100.0) == 2
    gain = gain_over_silence(utility, 2)
    assert (gain.mean, gain.standard_error, gain.probability) == (1.0, 0.0, 1.0)


def test_a_gain_by_hand():
    gain = gain_over_silence(valued([1.0, 2.0, 3.0, 4.0], [2.0, 2.0, 6.0, 6.0]), 1)
    # Differences 1, 0, 3, 2: mean 1.5, variance 5/3, and one draw in which nothing is gained.
    assert gain.mean == pytest.approx(1.5)
    assert gain.standard_error == pytest.approx((5 / 3 / 4) ** 0.5)
    assert gain.probability == 0.75
    # 2.353 is the .95 quantile of Student's t with three degrees of freedom.
    assert gain.interval == pytest.approx((1.5 - 2.353 * 0.6455, 1.5 + 2.353 * 0.6455), abs=1e-3)
    assert str(gain) == "+1.50 [-0.02, +3.02]"
    silence = gain_over_silence(valued([1.0, 2.0], [2.0, 2.0]), 0)
    assert silence == Gain(0.0, 0.0, 0.0, 2)


def test_each_draw_of_a_random_world_counts_the_same():
    """Three draws of the person, in two of the world: the first of these has two of them."""
    utility = torch.tensor([[0.0, 0.0, 0.0], [1.0, 4.0, 3.0]])
    found = gain_over_silence(Valued(utility, None, worlds=2), 1)
    assert found == Gain(3.0, 1.0, 1.0, 2)  # of (1 + 3) / 2 and 4
    assert Valued(utility, None, worlds=2).mean.tolist() == [0.0, 3.0]
    assert found.interval == pytest.approx((3 - 6.314, 3 + 6.314), abs=1e-3)


@pytest.mark.parametrize("least", [-0.1, -3.0])
def test_less_than_no_assurance_is_refused(least):
    with pytest.raises(ValueError) as error:
        Communicator(person(), ExpectedUtility(WORLD), min_standard_errors=least)
    assert str(error.value) == f"min_standard_errors must be at least 0, not {least}"


# --- what it asks for -------------------------------------------------------------------------


class Asked:
    """An objective and a search in one, which write down what they are asked."""

    def __init__(self, worth=0.0):
        self.worth, self.given = worth, []

    def at(self, context, steps_left, seed):
        self.given.append({"time": context.past.time, "steps_left": steps_left, "seed": seed})
        return lambda candidates: Valued(self.worth * candidates[:, 0].sum(-1, True).float(), None)

    def __call__(self, value, allowed, seed):
        assert seed == self.given[-1]["seed"]
        self.given[-1]["allowed"] = allowed.tolist()
        return Exhaustive()(value, allowed, seed)


def test_it_asks_for_the_steps_that_are_left_and_the_items_that_may_be_sent():
    past = begun(0, [1, 9, -1, -12], [1, -1, -1, -1])
    allowed = CHANNELS.join(DOMAIN.communicable(past.now))
    assert allowed.tolist() == [True, True, False, False, True, True, True, False]
    seeds = set()
    for seed in range(3):
        asked, later = Asked(1.0), past
        for time in range(DOMAIN.horizon):
            decision = Communicator(person(), asked, asked, seed=seed).plan(later)
            given = asked.given[-1]
            assert (given["time"], given["steps_left"]) == (time, DOMAIN.horizon - time)
            assert given["allowed"] == allowed.tolist()
            assert torch.equal(decision.flags, allowed)  # the more, the better
            seeds.add(given["seed"])
            later = later.then(CHANNELS.split(flags()), 0, past.now)
    # Each step of a round has noise of its own, and so has each communicator.
    assert len(seeds) == 3 * DOMAIN.horizon


# --- silence ----------------------------------------------------------------------------------


def talker(**values):
    """A communicator for four draws of a person who hardly errs."""
    someone = person(4, **({"consistency": 8.0, "lapse": 0.001} | values))
    return Communicator(someone, ExpectedUtility(WORLD))


BLOCKED = (0, [3, 9, -9, -8], [-1, 1, -1, -1])
"""A car closes in, three cells ahead in the own lane; nobody else matters."""


def silent(decision):
    assert not decision.flags.any()
    assert not decision.message
    assert (decision.gain.mean, decision.gain.standard_error) == (0.0, 0.0)
    return decision.why() in (
        "silence: no message is worth its cost",
        "silence: there is nothing new to communicate now",
        "silence: the round is over",
    )


def test_silence_on_an_empty_road():
    asked = Asked(1.0)
    past = begun(1, [30, 12, -30, -12], [1, 1, -1, -1])
    decision = Communicator(person(), asked, asked).plan(past)
    assert silent(decision)
    assert asked.given == []  # there is nothing to choose from
    assert decision.found is None and decision.turning_point is None and decision.matters == {}
    assert decision.plan == (decision.message,)
    assert decision.alternatives["message"].tolist() == ["silence"]
    assert decision.alternatives["chosen"].tolist() == [True]


def test_silence_when_the_round_is_over(monkeypatch):
    monkeypatch.setattr(Driving, "horizon", 1)
    asked = Asked(1.0)
    first = begun(*BLOCKED)
    over = first.then(CHANNELS.split(flags()), 0, first.now)
    assert Communicator(person(), asked, asked).plan(first).message
    assert silent(Communicator(person(), asked, asked).plan(over))
    assert len(asked.given) == 1


def test_the_last_action_can_still_be_helped(monkeypatch):
    """A car comes within two cells if they stay, -2; told, they switch, -1."""
    monkeypatch.setattr(Driving, "horizon", 1)
    decision = talker(sight=2).plan(begun(*BLOCKED))
    assert [item for _, item in decision.message] == ["front-left"]
    assert decision.gain.mean == pytest.approx(1 - decision.cost, abs=0.05)


def test_silence_at_the_last_action_of_a_person_who_acts_the_same_anyway(monkeypatch):
    monkeypatch.setattr(Driving, "horizon", 1)
    assert silent(talker(sight=2, consistency=0.0).plan(begun(*BLOCKED)))
    # And where the reward is the same whatever they do, but for the change of lanes.
    assert silent(talker(sight=2).plan(begun(0, [9, 9, -9, -9], [1, 1, -1, -1])))


def second_look(lane, positions, speeds):
    """A round that came to this scene after one step, in which nothing was said."""
    before = [place - speed for place, speed in zip(positions, speeds, strict=True)]
    past = begun(lane, before, speeds)
    return past.then(CHANNELS.split(flags()), 0, begun(lane, positions, speeds).now)


@pytest.mark.parametrize("assumes_closing", [0, 1])
@pytest.mark.parametrize("assumes_clear", [0, 1])
@pytest.mark.parametrize("scene", [BLOCKED, (1, [5, 8, -6, -4], [1, 1, -1, -1])])
def test_silence_to_a_person_who_sees_everything(assumes_clear, assumes_closing, scene):
    """What they see for the second time they know: no news of it, so it costs what it costs."""
    someone = talker(sight=FULL_SIGHT, assumes_clear=assumes_clear, assumes_closing=assumes_closing)
    past = second_look(*scene)
    decision = someone.plan(past)
    assert silent(decision)
    ahead, behind = ["front-left", "front-right"], ["rear-left", "rear-right"]
    messages = [flags(visual=ahead[:1]), flags(visual=ahead[1:]), flags(visual=ahead)]
    messages += [flags(verbal=ahead[:1]), flags(verbal=ahead + behind)]
    value = someone.objective.at(PlanningContext.of(someone.person, past), 14, 0)
    utility = value(torch.stack([plan(None), *map(plan, messages)])).utility
    expected = -torch.tensor([0.01, 0.01, 0.04, 0.03, 0.48])[:, None].expand(5, 4)
    torch.testing.assert_close(utility[1:] - utility[0], expected)
    # At first sight, to be shown what they see is no news either.
    first = someone.objective.at(PlanningContext.of(someone.person, begun(*scene)), 15, 0)
    utility = first(torch.stack([plan(None), *map(plan, messages[:3])])).utility
    torch.testing.assert_close(utility[1:] - utility[0], expected[:3])


def test_speech_at_first_sight_to_a_person_who_sees_everything():
    """They see a car and take it to come closer, so they would switch lanes for nothing, -1."""
    scene = (0, [3, 11, -11, -11], [1, 1, -1, -1])
    someone = talker(sight=FULL_SIGHT)
    decision = someone.plan(begun(*scene))
    assert ("verbal", "front-left") in decision.message
    assert "visual" not in {name for name, _ in decision.message}
    assert decision.gain.mean == pytest.approx(1 - decision.cost, abs=0.05)
    step, action, untold, told = decision.turning_point
    assert (step, action) == (0, 1)
    assert untold > 0.9 and told < 0.1
    assert silent(someone.plan(second_look(*scene)))


def test_silence_to_a_person_who_does_not_listen(generator):
    for time in (0, 2, 5):
        past, _ = random_round(time, generator)
        assert silent(talker(consistency=0.0).plan(past))


@pytest.mark.parametrize(
    ("name", "speed", "closing", "news"),
    [
        ("visual", -1, 1, False),  # it comes closer, as they think
        ("visual", 1, 1, True),  # it does not; two sights tell
        ("visual", -1, 0, True),  # they do not know how it moves
        ("verbal", -1, 1, False),
        ("verbal", 1, 1, False),
        ("verbal", -1, 0, False),
    ],
)
def test_communicated_items_need_not_be_communicated_again(name, speed, closing, news):
    """What they were told stays known, so the same once more gains nothing.

    What was shown is shown in vain if they imagine it to be where it is. They see two cells.
    """
    communicator = talker(sight=2, assumes_closing=closing)
    message, now = flags(**{name: ["front-left"]}), (0, [5, 9, -9, -9], [speed, 1, -1, -1])
    first = begun(0, [5 - speed, 8, -8, -8], now[2])
    past = first.then(CHANNELS.split(message), 0, begun(*now).now)
    value = communicator.objective.at(PlanningContext.of(communicator.person, past), 14, 0)
    utility = value(torch.stack([plan(None), plan(message)])).utility
    gain = utility[1] - utility[0] + CHANNELS.cost(message)
    assert (gain > 0.5).all() if news else (gain.abs() < 1e-5).all()


# --- a message --------------------------------------------------------------------------------


@pytest.mark.parametrize("assumes_clear", [0, 1])
@pytest.mark.parametrize("lane", [0, 1])
def test_a_car_in_the_fog_is_communicated(assumes_clear, lane):
    """They see two cells; the car ahead in their lane is three away and closes in.

    Untold they stay, get within two cells of it, -2, and switch then. Told, they switch now.
    """
    positions, speeds = ([3, 9], [-1, 1]) if lane == 0 else ([9, 3], [1, -1])
    past = begun(lane, [*positions, -9, -8], [*speeds, -1, -1])
    decision = talker(front_own=2, front_other=2, assumes_clear=assumes_clear).plan(past)
    assert {item for _, item in decision.message} == {("front-left", "front-right")[lane]}
    assert decision.gain.mean == pytest.approx(2 - decision.cost, abs=0.05)
    step, action, untold, told = decision.turning_point
    assert (step, action) == (0, 0)
    assert untold > 0.9 and told < 0.1
    car = f"front car in the {('left', 'right')[lane]} lane, 3 cells ahead, closing"
    assert decision.why().startswith(f"{car}: they would stay in its way with probability ")


class Later:
    """To speak is worth 2 at the next step and 1 at others; to do both is worth no more."""

    def at(self, context, steps_left, seed):
        worth = torch.tensor([1.0, 2.0, 1.0])

        def value(candidates):
            told = candidates.any(-1) * worth[: candidates.shape[1]]
            return Valued(told.amax(1, keepdim=True).expand(-1, 4), None)

        return value


def test_what_can_wait_waits():
    past = begun(0, [30, 30, -5, -30], [1, 1, -1, -1])  # one car, of which can be spoken
    decision = Communicator(person(), Later()).plan(past)
    assert not decision.flags.any() and not decision.message
    assert [bool(message) for message in decision.plan] == [False, True, False]
    assert decision.gain.mean == 2
    car = "rear car in the left lane, 5 cells behind, drawing away"
    assert decision.why() == f"silence: {car}: can wait 1 step"
    # A search that does not look ahead speaks now.
    hasty = Communicator(person(), Later(), Automatic(1)).plan(past)
    assert hasty.message and hasty.gain.mean == 1


def test_mirror_kl_plans_too():
    """It has no predicted actions to tell of."""
    someone = person(4, sight=2)
    decision = Communicator(someone, Divergence(), Exhaustive()).plan(begun(*BLOCKED))
    assert decision.message
    assert decision.turning_point is None
    assert decision.why().endswith(": brings their belief closer to the truth")
    assert not any(name.startswith("p(") for name in decision.alternatives)


# --- the same again ---------------------------------------------------------------------------


def same(one, other):
    return (
        torch.equal(one.flags, other.flags)
        and one.gain == other.gain
        and one.message == other.message
        and torch.equal(one.found.candidates, other.found.candidates)
        and torch.equal(one.found.valued.utility, other.found.valued.utility)
        and torch.equal(one.found.valued.actions, other.found.valued.actions)
    )


@pytest.fixture
def rounds(generator):
    return [random_round(time, generator)[0] for time in (0, 1, 2, 3)]


def test_nothing_is_kept_between_decisions(rounds, generator):
    """In whatever order rounds come, and whatever is drawn elsewhere, decisions are the same."""
    someone = Person(human(), varied_draws(6, generator))
    communicator = Communicator(someone, ExpectedUtility(WORLD, 4, enumerate_above=0.3), seed=5)
    forward = [communicator.plan(past) for past in rounds]
    torch.manual_seed(1)
    state = torch.get_rng_state()
    backward = [communicator.plan(past) for past in reversed(rounds)][::-1]
    assert torch.equal(torch.get_rng_state(), state)
    fresh = Communicator(
        Person(human(), someone.draws), ExpectedUtility(WORLD, 4, enumerate_above=0.3), seed=5
    )
    for past, one, other in zip(rounds, forward, backward, strict=True):
        assert same(one, other)
        assert same(one, fresh.plan(past))


def test_another_seed_is_other_noise(rounds, generator):
    someone = Person(human(), varied_draws(6, generator))
    one, other = (
        Communicator(someone, ExpectedUtility(WORLD, 4, enumerate_above=1), seed=seed).plan(
            rounds[0]
        )
        for seed in (0, 1)
    )
    assert not torch.equal(one.found.valued.utility[0], other.found.valued.utility[0])


def test_planning_leaves_the_round_as_it_was(rounds):
    before = [CHANNELS.join(past.told).clone() for past in rounds]
    seen = [{name: value.clone() for name, value in past.observation.items()} for past in rounds]
    for past in rounds:
        talker().plan(past)
    for past, told, observation in zip(rounds, before, seen, strict=True):
        assert torch.equal(CHANNELS.join(past.told), told)
        assert all(torch.equal(past.observation[name], observation[name]) for name in observation)


@pytest.mark.parametrize("seed", range(4))
def test_cross_entropy_finds_what_trying_everything_finds(seed):
    """On what messages are really worth, where items help or spoil one another."""
    generator = torch.Generator().manual_seed(seed)
    someone = Person(human(), varied_draws(8, generator))
    past, _ = random_round(3, generator)
    utility = ExpectedUtility(WORLD, 3)
    every, searched = (
        Communicator(someone, utility, search, min_standard_errors=0.0).plan(past)
        for search in (Exhaustive(), CrossEntropy(1))
    )
    assert searched.gain.mean == pytest.approx(every.gain.mean, abs=1e-4)
    assert torch.equal(searched.flags, every.flags)
