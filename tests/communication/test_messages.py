"""Messages: flags, masks and names, what they cost, which there are; and rounds under way."""

import pytest
import torch
from example_person import CHANNELS, DOMAIN, observed

from mirror_ppl.communication import Message, RoundSoFar, every_message
from mirror_ppl.domains.driving import CARS
from mirror_ppl.errors import InputError, UnknownNameError

NUMBER = 8


def every_flags():
    """All 256 messages about four cars in two modalities."""
    return every_message(torch.ones(NUMBER, dtype=torch.bool))


# --- flags, masks and names -------------------------------------------------------------------


def test_flags_are_in_the_order_of_modalities_and_items():
    assert len(CHANNELS) == NUMBER
    assert CHANNELS.pairs == [("visual", car) for car in CARS] + [("verbal", car) for car in CARS]
    for place, (name, car) in enumerate(CHANNELS.pairs):
        assert CHANNELS.flags({name: [car]}).tolist() == [i == place for i in range(NUMBER)]


def test_flags_become_masks_and_come_back():
    every = every_flags()
    masks = CHANNELS.split(every)
    assert list(masks) == ["visual", "verbal"]
    assert torch.equal(masks["visual"], every[:, :4])
    assert torch.equal(masks["verbal"], every[:, 4:])
    assert torch.equal(CHANNELS.join(masks), every)
    # Masks are joined by name, in whatever order they come.
    assert torch.equal(CHANNELS.join(dict(reversed(masks.items()))), every)
    # Batches keep their shape.
    batch = every.view(4, 64, NUMBER)
    assert CHANNELS.split(batch)["verbal"].shape == (4, 64, 4)
    assert torch.equal(CHANNELS.join(CHANNELS.split(batch)), batch)


def test_flags_become_names_and_come_back():
    for flags in every_flags():
        message = CHANNELS.message(flags)
        assert torch.equal(CHANNELS.flags(message.items), flags)
        assert len(message) == int(flags.sum())
        assert bool(message) == bool(flags.any())
        assert list(message) == [
            pair for pair, flag in zip(CHANNELS.pairs, flags.tolist(), strict=True) if flag
        ]


def test_a_message_in_words():
    message = CHANNELS.message(CHANNELS.flags({"verbal": ["rear-left", "front-left"]}))
    assert message == Message({"visual": (), "verbal": ("front-left", "rear-left")})
    assert str(message) == "verbal: front-left, rear-left"
    both = CHANNELS.flags({"visual": ["front-right"], "verbal": ["rear-left"]})
    assert str(CHANNELS.message(both)) == "visual: front-right; verbal: rear-left"
    assert str(CHANNELS.message(torch.zeros(NUMBER, dtype=torch.bool))) == "silence"


@pytest.mark.parametrize(
    ("items", "message"),
    [
        ({"spoken": ["front-left"]}, 'unknown modality "spoken"; known: verbal, visual'),
        (
            {"verbal": ["front-lefft"]},
            'unknown verbal item "front-lefft"; known: front-left, front-right, rear-left, '
            'rear-right; perhaps you meant "front-left"',
        ),
        ({"visual": ["tram"]}, 'unknown visual item "tram"'),
        ({"visual": ["rear-left"], "verbal": ["tram"]}, 'unknown verbal item "tram"'),
    ],
)
def test_names_that_are_not_there_are_refused(items, message):
    with pytest.raises(UnknownNameError) as error:
        CHANNELS.flags(items)
    assert str(error.value).startswith(message)


# --- costs ------------------------------------------------------------------------------------


def test_costs_grow_with_the_square_of_the_number_in_each_modality():
    """Supplement, Table I: 0.01 n^2 for cars shown, 0.03 n^2 for utterances."""
    every = every_flags()
    expected = [0.01 * sum(row[:4]) ** 2 + 0.03 * sum(row[4:]) ** 2 for row in every.tolist()]
    torch.testing.assert_close(CHANNELS.cost(every), torch.tensor(expected))
    assert CHANNELS.cost(every.view(4, 8, 8, NUMBER)).shape == (4, 8, 8)


@pytest.mark.parametrize(
    ("visual", "verbal", "cost"),
    [(0, 0, 0), (1, 0, 0.01), (0, 1, 0.03), (2, 0, 0.04), (1, 1, 0.04), (3, 2, 0.21), (4, 4, 0.64)],
)
def test_costs_by_hand(visual, verbal, cost):
    flags = CHANNELS.flags({"visual": CARS[:visual], "verbal": CARS[:verbal]})
    assert float(CHANNELS.cost(flags)) == pytest.approx(cost)


# --- every message ----------------------------------------------------------------------------


@pytest.mark.parametrize("places", [(), (3,), (0, 7), (1, 2, 5), (0, 2, 3, 4, 6), range(NUMBER)])
def test_every_message_of_the_allowed_items_once_and_silence_first(places):
    allowed = torch.zeros(NUMBER, dtype=torch.bool)
    allowed[list(places)] = True
    messages = every_message(allowed)
    assert messages.shape == (2 ** len(places), NUMBER)
    assert messages.dtype == torch.bool
    assert not messages[0].any()
    assert not messages[:, ~allowed].any()
    assert len(set(map(tuple, messages.tolist()))) == len(messages)


# --- rounds under way -------------------------------------------------------------------------


def states(steps, generator):
    """The states ``[1]`` of a round, and what is done between them."""
    actions = torch.tensor([0, 1, 1])[:steps]
    result = [DOMAIN.initial(1, generator)]
    for action in actions:
        result.append(DOMAIN.transition(result[-1], action[None]))
    return [observed(state) for state in result], actions


def test_a_round_begins_with_one_observation(generator):
    (first,), _ = states(0, generator)
    past = RoundSoFar.begin(DOMAIN, first)
    assert past.time == 0
    assert past.actions.shape == (0,) and past.actions.dtype == torch.long
    for name, mask in past.told.items():
        assert mask.shape == (0, 4) and mask.dtype == torch.bool, name
    assert list(past.told) == ["visual", "verbal"]
    for name, value in first.items():
        assert torch.equal(past.observation[name], value[None])
        assert torch.equal(past.now[name], value)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("ego", lambda value: value + 3, "this observation cannot be: ego lane has to be 0 or 1"),
        ("visual", lambda value: value * torch.nan, "time 0: .* has nan, expected finite numbers"),
        ("verbal", lambda value: value[None], r"has shape \(1, 4, 3\), expected \(4, 3\)"),
    ],
)
def test_observations_that_cannot_be_are_refused(generator, name, change, message):
    (first,), _ = states(0, generator)
    with pytest.raises(ValueError, match=message):
        RoundSoFar.begin(DOMAIN, first | {name: change(first[name])})
    later = RoundSoFar.begin(DOMAIN, first)
    later = RoundSoFar(
        {
            key: value.repeat(2, *[1] * (value.dim() - 1))
            for key, value in later.observation.items()
        },
        torch.tensor([7]),
        {key: torch.zeros(1, 4, dtype=torch.bool) for key in later.told},
    )
    with pytest.raises(ValueError, match="there is no action 7; actions count from 0 to 1"):
        later.check(DOMAIN)


@pytest.mark.parametrize("as_tensor", [False, True])
def test_a_round_grows_step_by_step(generator, as_tensor):
    seen, actions = states(3, generator)
    told = torch.rand(3, NUMBER, generator=generator) < 0.5
    past = RoundSoFar.begin(DOMAIN, seen[0])
    for step in range(3):
        before = past
        action = actions[step] if as_tensor else int(actions[step])
        past = past.then(CHANNELS.split(told[step]), action, seen[step + 1])
        assert before.time == step  # the round before is left as it was
    assert past.time == 3
    assert torch.equal(past.actions, actions)
    assert torch.equal(CHANNELS.join(past.told), told)
    for name in seen[0]:
        assert torch.equal(past.observation[name], torch.stack([one[name] for one in seen]))
        assert torch.equal(past.now[name], seen[3][name])


def parts(steps=2):
    return {
        "observation": {
            "ego": torch.zeros(steps + 1, 1),
            "visual": torch.zeros(steps + 1, 4, 2),
            "verbal": torch.zeros(steps + 1, 4, 3),
        },
        "actions": torch.zeros(steps, dtype=torch.long),
        "told": {name: torch.zeros(steps, 4, dtype=torch.bool) for name in ("visual", "verbal")},
    }


@pytest.mark.parametrize("name", ["ego", "visual", "verbal"])
@pytest.mark.parametrize("steps", [1, 2, 4])
def test_observations_that_do_not_go_with_the_actions_are_refused(name, steps):
    given = parts()
    RoundSoFar(**given)
    given["observation"][name] = parts(steps - 1)["observation"][name]
    with pytest.raises(ValueError) as error:
        RoundSoFar(**given)
    assert str(error.value) == f'2 actions go with 3 observations; "{name}" has {steps}'


@pytest.mark.parametrize("name", ["visual", "verbal"])
@pytest.mark.parametrize("steps", [0, 1, 3])
def test_messages_that_do_not_go_with_the_actions_are_refused(name, steps):
    given = parts()
    given["told"][name] = parts(steps)["told"][name]
    with pytest.raises(ValueError) as error:
        RoundSoFar(**given)
    assert str(error.value) == f'2 actions go with as many steps of told "{name}", not {steps}'


def test_what_a_step_leaves_out_is_noticed(generator):
    seen, _ = states(1, generator)
    past = RoundSoFar.begin(DOMAIN, seen[0])
    nothing = CHANNELS.split(torch.zeros(NUMBER, dtype=torch.bool))
    with pytest.raises(InputError, match="told has visual, expected visual, verbal"):
        past.then({"visual": nothing["visual"]}, 0, seen[1])
    with pytest.raises(InputError, match="the observation has ego, verbal, expected ego, visual"):
        past.then(nothing, 0, {"ego": seen[1]["ego"], "verbal": seen[1]["verbal"]})
