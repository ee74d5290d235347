"""SQIL: its loss by hand, the rounds that it plays, and tasks that it must solve."""

from dataclasses import replace

import pytest
import torch
from example_rounds import alternate, anything, avoid, ragged, rounds_of, untrained

from mirror_ppl.baselines import SoftQOptions, fit_soft_q, held_out_nll, input_size
from mirror_ppl.baselines.inputs import StepInputs
from mirror_ppl.baselines.sqil import _told_rates, mean_error, soft_q_loss, squared_errors
from mirror_ppl.data import concatenate
from mirror_ppl.domains import get_domain
from mirror_ppl.domains.driving import SWITCH
from mirror_ppl.errors import DemonstrationsError, UnknownNameError
from mirror_ppl.people import simulate

BRIEF = SoftQOptions(epochs=6, sampled=3)


class HandSet:
    """Networks whose values are these, ``[1, B, T, A]``."""

    def __init__(self, values):
        self.values = torch.tensor(values)

    def __call__(self, inputs):
        return self.values


def test_the_loss_is_the_soft_bellman_error():
    """Two steps and padding: 1 + .5 log(e^0 + e^0) after the first, 1 after the second."""
    own = HandSet([[[[2.0, 7.0], [3.0, 4.0], [9.0, 9.0]]]])
    ahead = HandSet([[[[5.0, 5.0], [0.0, 0.0], [8.0, 8.0]]]])
    actions = torch.tensor([[[0, 1, -1]]])
    inputs = StepInputs.of(torch.zeros(1, 1, 3, 1))
    errors = squared_errors(own, ahead, inputs, actions, torch.ones(1, 1), 0.5)
    first = 2.0 - 1.0 - 0.5 * torch.tensor(2.0).log()
    second = 4.0 - 1.0
    torch.testing.assert_close(errors[0, 0], torch.tensor([first**2, second**2, 0.0]))
    torch.testing.assert_close(mean_error(errors, actions), ((first**2 + second**2) / 2)[None])


@pytest.mark.parametrize("rule", [avoid, alternate])
def test_solves_a_task_that_it_must(rule, generator):
    data = rounds_of(rule, generator, 80)
    train, validation, test = (
        data.select_rounds(slice(*ends)) for ends in ((0, 40), (40, 50), (50, 80))
    )
    networks = fit_soft_q(train, validation, SoftQOptions(epochs=60, patience=1000), seed=0)
    rate = (train.actions == SWITCH).float().mean()
    knowing_nothing = float(torch.special.entr(torch.stack([rate, 1 - rate])).sum())
    assert held_out_nll(networks, test).item() < 0.6 * knowing_nothing
    right = networks.log_probabilities(test).argmax(-1) == test.actions
    assert right.float().mean() > 0.95


@pytest.mark.parametrize("name", ["driving", "search_rescue", "bomb_defusal"])
def test_played_rounds_are_of_the_domain_and_of_the_networks(name):
    domain = get_domain(name)
    networks = untrained(domain, ("a", "b"))
    generators = [torch.Generator().manual_seed(5), torch.Generator().manual_seed(6)]
    inputs, actions = networks.play(domain.settings[-1], 3, generators)
    read = inputs.steps
    assert read.shape == (2, 3, domain.horizon, input_size(domain))
    assert actions.shape == (2, 3, domain.horizon)
    assert (actions >= -1).all() and (actions[..., 0] >= 0).all()
    # What comes after the end stays after it.
    ended = actions < 0
    assert (ended[..., :-1] <= ended[..., 1:]).all()
    # Inputs hold what was done before.
    done = read[..., -len(domain.actions) - 1 :].argmax(-1)
    assert (done[..., 0] == len(domain.actions)).all()
    before, after = actions[..., :-1], done[..., 1:]
    assert (before == after)[before >= 0].all()
    # They act as their values say, each by its own.
    probabilities = networks(inputs).softmax(-1)[..., 0]
    for place in range(2):
        real = actions[place] >= 0
        expected, rate = probabilities[place][real].detach(), (actions[place][real] == 0).float()
        error = (expected * (1 - expected)).sum().sqrt() / len(rate)
        assert abs(float(rate.mean() - expected.mean())) < 4.5 * float(error) + 1e-6


def test_played_rounds_have_as_many_messages_as_recorded_ones():
    domain = get_domain("driving")
    networks = untrained(domain, ("a", "b"))
    recorded = simulate("driving", "fog", "paper", 2, 40, seed=0, told=0.1)
    rates = _told_rates(recorded)
    # Of 40 rounds of 15 steps some thousand items can be told.
    assert ((rates - 0.1).abs() < 4.5 * (0.1 * 0.9 / 1000) ** 0.5).all()
    assert (_told_rates(simulate("driving", "fog", "paper", 2, 3, seed=0)) == 0).all()

    def play(told):
        generators = [torch.Generator().manual_seed(seed) for seed in (5, 6)]
        return networks.play("fog", 40, generators, told)

    silent, _ = play(None)
    told, actions = play(torch.tensor([0.0, 0.5]))
    heard = (told.steps - silent.steps)[:, :, 0].abs().sum((1, 2))
    assert heard[0] == 0 and heard[1] > 0
    assert actions.shape == (2, 40, domain.horizon)


def test_recorded_and_played_rounds_are_learned_from_as_each_by_itself(generator):
    """The loss is the weighted sum of both parts' own, though their rounds differ in shape."""
    domain = get_domain("driving")
    networks, target = (untrained(domain, ("a", "b"), seed=seed) for seed in (0, 1))
    with torch.no_grad():
        for one in (networks, target):
            one.weights["input"].normal_(generator=generator)
    size, parts = (input_size(domain),), []
    for shape in ((2, 3, 5), (2, 4, 7)):
        inputs = StepInputs.of(torch.randint(2, shape + size, generator=generator).float())
        actions = torch.randint(-1, 2, shape, generator=generator)
        actions[:, :, 0] = 1
        parts.append((inputs, actions.cummin(-1).values))
    options = SoftQOptions(reward=3.0, discount=0.5, sampled_weight=0.25)
    found = soft_q_loss(networks, target, *parts, options)
    each = [
        mean_error(squared_errors(networks, target, *part, torch.tensor([[reward]]), 0.5), part[1])
        for part, reward in zip(parts, (3.0, 0.0), strict=True)
    ]
    torch.testing.assert_close(found, each[0] + 0.25 * each[1], rtol=1e-4, atol=1e-4)


def test_a_person_s_network_is_their_own(generator):
    one, other = rounds_of(avoid, generator, 8), rounds_of(alternate, generator, 8, "b")
    both = concatenate([one, other])
    together = fit_soft_q(both, both, BRIEF, seed=3)
    alone = fit_soft_q(other, other, BRIEF, seed=3)
    torch.testing.assert_close(
        together.log_probabilities(other), alone.log_probabilities(other), atol=1e-4, rtol=1e-4
    )
    again = fit_soft_q(other, other, BRIEF, seed=3)
    assert torch.equal(again.log_probabilities(other), alone.log_probabilities(other))
    unlike = fit_soft_q(other, other, BRIEF, seed=4)
    assert not torch.equal(unlike.log_probabilities(other), alone.log_probabilities(other))


@pytest.mark.parametrize("rounds", [3, 6])
def test_a_person_s_network_does_not_depend_on_how_many_rounds_others_have(rounds, generator):
    """Also where a batch holds all rounds of one person, but not all of another."""
    options = replace(BRIEF, batch=4)
    one, other = rounds_of(avoid, generator, rounds), rounds_of(alternate, generator, 8, "b")
    both = concatenate([one, other])
    together, alone = (fit_soft_q(part, part, options, seed=3) for part in (both, one))
    own, expected = (part.log_probabilities(one) for part in (together, alone))
    torch.testing.assert_close(own, expected, atol=1e-4, rtol=1e-4)


def test_padding_and_progress(generator):
    data = ragged(generator, "a", 12)
    told = []
    networks = fit_soft_q(data, data, BRIEF, seed=0, report=lambda *now: told.append(now))
    assert told[-1][0] == BRIEF.epochs and "nats an action" in told[-1][1]
    assert networks.log_probabilities(data).isfinite().all()


def test_what_cannot_be_learned_from_is_refused(generator):
    data = rounds_of(anything, generator, 4)
    with pytest.raises(DemonstrationsError, match="expected those of training: driving, a"):
        fit_soft_q(data, replace(data, people=("b",)), BRIEF, seed=0)
    with pytest.raises(UnknownNameError):
        SoftQOptions(sight="nothing")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sampled": 0}, "sampled must be at least 1"),
        ({"learning_rate": 0.0}, "learning_rate must be positive"),
        ({"reward": 0.0}, "reward must be positive"),
        ({"discount": 1.0}, "discount must be at least 0 and below 1"),
        ({"weight_decay": -1.0}, "weight_decay must not be negative"),
    ],
)
def test_impossible_settings_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        SoftQOptions(**changes)
