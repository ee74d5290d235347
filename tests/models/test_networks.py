"""Networks and chains: sizes, densities, gradients, what masks hide, which action enters where."""

import math
from dataclasses import replace

import pytest
import torch
from pyro import poutine
from torch import nn
from torch.distributions import Normal

from mirror_ppl.domains import get_domain
from mirror_ppl.evaluation.self_model import fixed_views
from mirror_ppl.models.distributions import GaussianChain
from mirror_ppl.models.networks import (
    MIN_SCALE,
    Decoder,
    Encoder,
    Gaussian,
    GaussianHead,
    QNetwork,
    Reward,
    Transition,
    log_softmax_of_few,
)
from mirror_ppl.models.self_model import Rounds, SelfModel
from mirror_ppl.models.sizes import Sizes
from mirror_ppl.training.experience import Course, experience

DRIVING = get_domain("driving")
LATENT, ACTIONS, HIDDEN = 48, 2, 64
SYMBOLS = {"ego": 2, "visual": 50, "verbal": 53}
ITEMS = {"visual": 4, "verbal": 4}
STEPS = 15


def linear_sizes(module):
    """(in, out) of each linear layer, in order."""
    return [
        (part.in_features, part.out_features)
        for part in module.modules()
        if isinstance(part, nn.Linear)
    ]


def encoder(dtype=torch.float64):
    return Encoder(DRIVING, Sizes()).to(dtype)


def symbols(*batch, dtype=torch.float64):
    """Any values of the encoder's inputs, not only those that occur."""
    ego = torch.randn(*batch, SYMBOLS["ego"], dtype=dtype)
    items = {name: torch.randn(*batch, ITEMS[name], SYMBOLS[name], dtype=dtype) for name in ITEMS}
    return {"ego": ego, **items}


def masks(*batch):
    return {name: torch.rand(*batch, number) < 0.5 for name, number in ITEMS.items()}


# --- sizes of the supplement, section D -------------------------------------------------------


def test_transition_has_three_layers_of_32():
    assert linear_sizes(Transition(LATENT, ACTIONS)) == [(50, 32), (32, 32), (32, 32), (32, 96)]


def test_encoder_has_three_layers_of_64():
    network = encoder()
    # The first layer is spread over its inputs; together they are one layer to 64.
    assert linear_sizes(network.ego) == [(2, 64)]
    assert linear_sizes(network.previous) == [(48, 64)]
    assert network.action.weight.shape == (ACTIONS + 1, 64)
    for name, items in ITEMS.items():
        assert network.items[name].weight.shape == (items, SYMBOLS[name], 64)
        assert network.items[name].bias.shape == (items, 64)
    assert linear_sizes(network.body) == [(64, 64), (64, 64)]
    assert linear_sizes(network.head) == [(64, 96)]


@pytest.mark.parametrize(("items", "features"), [(1, 1), (4, 2), (4, 3)])
def test_decoder_has_three_layers_of_32(items, features):
    network = Decoder(LATENT, items, features)
    outputs = 2 * items * features
    assert linear_sizes(network) == [(48, 32), (32, 32), (32, 32), (32, outputs)]
    mean, scale = network(torch.randn(5, 7, LATENT))
    assert mean.shape == scale.shape == (5, 7, items, features)


def test_reward_has_three_layers_of_32():
    assert linear_sizes(Reward(LATENT, ACTIONS)) == [(50, 32), (32, 32), (32, 32), (32, 2)]


def test_q_network_has_three_layers_of_128_on_state_and_action():
    network = QNetwork(LATENT, ACTIONS).double()
    assert linear_sizes(network) == [(48, 128), (128, 128), (128, 128), (128, 1)]
    # The first layer reads the state and the action's one-hot code, written as a sum.
    z = torch.randn(3, LATENT, dtype=torch.float64)
    weight = torch.cat([network.latent.weight, network.action.weight.T], 1)
    for action in range(ACTIONS):
        chosen = torch.eye(ACTIONS, dtype=z.dtype)[action].expand(3, -1)
        first = torch.relu(torch.cat([z, chosen], -1) @ weight.T + network.latent.bias)
        expected = network.value(network.body(first)).squeeze(-1)
        torch.testing.assert_close(network(z)[:, action], expected)


def test_self_model_is_put_together_from_them():
    model = SelfModel(DRIVING)
    assert model.latent == LATENT
    assert set(model.decoders) == {"ego", "visual", "verbal"}
    # Counted by hand: weights and biases of the layers above.
    sizes = {
        "encoder": 2 * 64 + 64 + 4 * 51 * 64 + 4 * 54 * 64 + 3 * 64 + 48 * 64,
        "transition": 50 * 32 + 32 + 2 * (32 * 32 + 32) + 32 * 96 + 96,
        "reward": 50 * 32 + 32 + 2 * (32 * 32 + 32) + 32 * 2 + 2,
        "q_network": 48 * 128 + 128 + 2 * 128 + 2 * (128 * 128 + 128) + 128 + 1,
    }
    sizes["encoder"] += 2 * (64 * 64 + 64) + 64 * 96 + 96
    for name, size in sizes.items():
        assert sum(part.numel() for part in getattr(model, name).parameters()) == size, name


@pytest.mark.parametrize("scale", [0.5, 1.0])
def test_head_starts_at_its_scale_and_never_reaches_zero(scale):
    head = GaussianHead(32, 200, scale)
    with torch.no_grad():
        head.linear.weight.zero_()
        # The layer's own bias is uniform within 1 / sqrt(32), and softplus is no steeper than 1.
        start = head(torch.zeros(1, 32)).scale - MIN_SCALE
        assert (start - scale).abs().max() <= 32**-0.5
        head.linear.bias.fill_(-200.0)
        assert torch.equal(head(torch.zeros(1, 32)).scale, torch.full((1, 200), MIN_SCALE))


# --- Gaussian chains --------------------------------------------------------------------------


def initial(*batch, dtype=torch.float64):
    return Gaussian(
        torch.randn(*batch, LATENT, dtype=dtype), 0.1 + torch.rand(*batch, LATENT, dtype=dtype)
    )


def chains():
    """A chain whose inputs are actions, and one whose inputs are vectors; batches of 3 and 2 x 3"""
    actions = torch.randint(ACTIONS, (3, STEPS))
    yield GaussianChain(initial(3), Transition(LATENT, ACTIONS).double(), actions, 0)
    evidence = torch.randn(2, 3, STEPS, HIDDEN, dtype=torch.float64)
    yield GaussianChain(initial(2, 3), encoder(), evidence, 1)


def test_chain_log_prob_is_the_sum_over_steps_of_normals():
    for chain in chains():
        value = torch.randn(*chain.batch_shape, STEPS + 1, LATENT, dtype=torch.float64)
        expected = Normal(*chain.initial).log_prob(value[..., 0, :]).sum(-1)
        for step in range(1, STEPS + 1):
            inputs = chain.inputs.select(chain.time, step - 1)
            density = Normal(*chain.step(value[..., step - 1, :], inputs))
            expected = expected + density.log_prob(value[..., step, :]).sum(-1)
        assert chain.log_prob(value).shape == chain.batch_shape
        torch.testing.assert_close(chain.log_prob(value), expected)


def test_chain_draws_are_reparameterized():
    # The released MIRROR code drew latent states without this: its implants got no gradient.
    for chain in chains():
        for part in chain.initial:
            part.requires_grad_()
        assert chain.has_rsample
        chain.rsample()[..., -1, :].sum().backward()
        for part in (*chain.initial, *chain.step.head.parameters(), *chain.step.body.parameters()):
            assert part.grad is not None
            assert part.grad.abs().max() > 0


def linear_chain(batch, steps, decay, drift, noise, first):
    """z_t = decay z_{t-1} + drift u_t + noise e_t, and its parameters."""
    mean, scale = (torch.full((batch, 1), value, dtype=torch.float64) for value in first)
    inputs = torch.arange(1.0, steps + 1, dtype=torch.float64).expand(batch, steps)[..., None]

    def step(previous, inputs):
        mean = decay * previous + drift * inputs
        return Gaussian(mean, torch.full_like(mean, noise))

    return GaussianChain(Gaussian(mean, scale), step, inputs, 1)


def test_chain_gradient_of_a_linear_chain_is_exact():
    chain = linear_chain(1, 6, decay=0.8, drift=0.3, noise=0.5, first=(1.0, 2.0))
    chain.initial.mean.requires_grad_()
    chain.rsample()[0, -1, 0].backward()
    assert chain.initial.mean.grad.item() == pytest.approx(0.8**6, rel=1e-12)


def test_chain_marginals_of_a_linear_chain():
    number, steps, decay, drift, noise = 40_000, 4, 0.8, 0.3, 0.5
    chain = linear_chain(number, steps, decay, drift, noise, first=(1.0, 2.0))
    z = chain.sample()[..., 0]
    means, variances = [1.0], [4.0]
    for step in range(1, steps + 1):
        means.append(decay * means[-1] + drift * step)
        variances.append(decay**2 * variances[-1] + noise**2)
    # 15 comparisons at 4.5 standard errors: wrong once in 10,000.
    for step in range(steps + 1):
        error = math.sqrt(variances[step] / number)
        assert z[:, step].mean().item() == pytest.approx(means[step], abs=4.5 * error)
        error = variances[step] * math.sqrt(2 / number)
        assert z[:, step].var().item() == pytest.approx(variances[step], abs=4.5 * error)
    for step in range(steps):
        expected = decay * variances[step]
        error = math.sqrt((variances[step] * variances[step + 1] + expected**2) / number)
        covariance = torch.cov(z[:, step : step + 2].T)[0, 1].item()
        assert covariance == pytest.approx(expected, abs=4.5 * error)
    # Minus the log density of a draw is the entropy, but for a half chi-square with steps + 1.
    scales = torch.tensor([2.0] + [noise] * steps, dtype=torch.float64)
    entropy = Normal(0.0, scales).entropy().sum().item()
    error = math.sqrt((steps + 1) / 2 / number)
    assert -chain.log_prob(z[..., None]).mean().item() == pytest.approx(entropy, abs=4.5 * error)


def test_chain_draws_several_at_once_from_either_network():
    for chain in chains():
        draws = chain.rsample(torch.Size([5]))
        assert draws.shape == (5, *chain.batch_shape, STEPS + 1, LATENT)
        assert chain.log_prob(draws).shape == (5, *chain.batch_shape)
        torch.testing.assert_close(chain.log_prob(draws)[3], chain.log_prob(draws[3]))


def test_chain_has_one_trajectory_for_each_of_its_inputs():
    chain = next(chains())
    assert chain.expand(torch.Size([3])) is chain
    with pytest.raises(ValueError, match="one trajectory for each"):
        chain.expand(torch.Size([2, 3]))


# --- what masks hide --------------------------------------------------------------------------


@pytest.mark.parametrize("name", ITEMS)
def test_hidden_item_contributes_exactly_nothing(name):
    network, values, visible = encoder(torch.float32), symbols(6, dtype=torch.float32), masks(6)
    before = network.combine(network.embed(values), visible)
    other = {key: value.clone() for key, value in values.items()}
    hidden = ~visible[name]
    assert 0 < hidden.sum() < hidden.numel()
    other[name][hidden] += 100.0
    assert torch.equal(network.combine(network.embed(other), visible), before)
    # And each visible one does count.
    for row, item in visible[name].nonzero().tolist():
        changed = {key: value.clone() for key, value in values.items()}
        changed[name][row, item] += 1.0
        after = network.combine(network.embed(changed), visible)
        assert not torch.equal(after[row], before[row])


def test_hidden_item_gets_and_gives_no_gradient():
    network, values = encoder(), symbols(1)
    values["visual"].requires_grad_()
    visible = {name: torch.tensor([[True, False, True, False]]) for name in ITEMS}
    network.combine(network.embed(values), visible).sum().backward()
    used = network.items["visual"].bias.grad.abs().amax(-1) > 0
    assert used.tolist() == [True, False, True, False]
    assert (values["visual"].grad.abs().amax((0, 2)) > 0).tolist() == [True, False, True, False]


def test_first_layer_is_the_linear_layer_on_masked_values_and_masks():
    network, values, visible = encoder(), symbols(7), masks(7)
    action = torch.randint(ACTIONS + 1, (7,))
    previous = torch.randn(7, LATENT, dtype=torch.float64)

    inputs, columns = [values["ego"], previous], [network.ego.weight, network.previous.weight]
    for name in ITEMS:
        mask = visible[name].double()
        inputs += [(mask[..., None] * values[name]).flatten(1), mask]
        columns += [network.items[name].weight.flatten(0, 1).T, network.items[name].bias.T]
    inputs.append(nn.functional.one_hot(action, ACTIONS + 1).double())
    columns.append(network.action.weight.T)
    layer = torch.cat(inputs, -1) @ torch.cat(columns, -1).T + network.ego.bias
    mean, scale = network.head(network.body(torch.relu(layer)))

    evidence = network.combine(network.embed(values), visible) + network.action(action)
    result = network(previous, evidence)
    torch.testing.assert_close(result.mean, previous + mean)
    torch.testing.assert_close(result.scale, scale)


# --- which action enters where: a_{t-1} at z_t, everywhere ------------------------------------


CHANGED = 6
"""The step whose action is changed."""


@pytest.fixture
def courses(generator):
    """A self-model, actions of 5 rounds, and the same with the action of one step changed."""
    actions = torch.randint(ACTIONS, (5, STEPS), generator=generator)
    other = actions.clone()
    other[:, CHANGED] = 1 - other[:, CHANGED]
    return SelfModel(DRIVING), actions, other


def lived(actions):
    """Rounds of the same start, under the same clear view."""
    generator = torch.Generator().manual_seed(3)
    start = DRIVING.initial(len(actions), generator)
    return experience(
        DRIVING, Course.of(DRIVING, start, actions), fixed_views(DRIVING, len(actions), generator)
    )


def assert_first_difference(one, other, step, time=1):
    """The two agree up to a step, but not at it."""
    assert torch.equal(one.narrow(time, 0, step), other.narrow(time, 0, step))
    differs = (one.select(time, step) != other.select(time, step)).flatten(1).any(1)
    assert differs.all()


def test_encoder_reads_the_action_that_led_to_the_observation(courses):
    # The released code's transition read an action one step older than its encoder did.
    model, actions, other = courses
    rounds = lived(actions).rounds
    changed = replace(rounds, actions=other)  # the same observations

    def evidence(rounds):
        return model.evidence(rounds.observation, rounds.visible, rounds.actions)

    one, two = evidence(rounds), evidence(changed)
    assert_first_difference(one, two, CHANGED + 1)
    # It enters at that observation and no other.
    assert torch.equal(one[:, CHANGED + 2 :], two[:, CHANGED + 2 :])
    assert_first_difference(model.believe(one), model.believe(two), CHANGED + 1)


@pytest.mark.parametrize("program", ["model", "guide"])
def test_transition_and_guide_use_the_action_that_led_to_the_state(courses, program):
    model, actions, other = courses
    rounds = lived(actions).rounds

    def states(rounds: Rounds):
        torch.manual_seed(5)
        return poutine.trace(getattr(model, program)).get_trace(rounds).nodes["z"]["value"]

    assert_first_difference(states(rounds), states(replace(rounds, actions=other)), CHANGED + 1)


def test_transition_density_uses_the_action_that_led_to_the_state(courses):
    model, actions, other = courses
    z = torch.randn(5, STEPS + 1, LATENT)
    for chosen in (actions, other):
        chain = GaussianChain(model.prior(torch.Size([5])), model.transition, chosen, 0)
        by_hand = Normal(*model.transition(z[:, CHANGED], chosen[:, CHANGED]))
        step = chain.step(z[:, :-1], chosen)
        torch.testing.assert_close(step.mean[:, CHANGED], by_hand.mean)
        torch.testing.assert_close(step.scale[:, CHANGED], by_hand.scale)
    assert not torch.equal(
        model.transition(z[:, 0], actions[:, CHANGED]).mean,
        model.transition(z[:, 0], other[:, CHANGED]).mean,
    )


def test_reward_belongs_to_the_state_before_its_action(courses):
    model, actions, other = courses
    z = torch.randn(5, STEPS + 1, LATENT)

    def means(actions):
        rounds = replace(lived(actions).rounds, rewards=torch.zeros(5, STEPS))
        replayed = poutine.condition(model.model, data={"z": z})
        return poutine.trace(replayed).get_trace(rounds).nodes["reward"]["fn"].base_dist.loc

    one, two = means(actions), means(other)
    differs = (one != two).all(0)
    assert differs.tolist() == [step == CHANGED for step in range(STEPS)]
    expected = model.reward(z[:, CHANGED], actions[:, CHANGED]).mean
    torch.testing.assert_close(one[:, CHANGED], expected)


def test_experience_uses_the_same_indices(courses):
    _, actions, other = courses
    one, two = lived(actions), lived(other)
    for name in ("ego", "visual"):
        assert_first_difference(
            one.rounds.observation[name], two.rounds.observation[name], CHANGED + 1
        )
    rewards = one.rounds.rewards, two.rounds.rewards
    assert torch.equal(rewards[0][:, :CHANGED], rewards[1][:, :CHANGED])
    # Outcomes at a step are those of both actions at its state, whichever is taken there.
    for ours, theirs in zip(one.outcomes, two.outcomes, strict=True):
        assert_first_difference(ours.observation["ego"], theirs.observation["ego"], CHANGED + 1)
        assert torch.equal(ours.reward[:, : CHANGED + 1], theirs.reward[:, : CHANGED + 1])
    # The outcome of the action that is taken is what happens.
    for step in range(STEPS):
        for row in range(len(actions)):
            outcome = one.outcomes[actions[row, step]]
            assert outcome.reward[row, step] == one.rounds.rewards[row, step]
            for name, value in one.rounds.observation.items():
                assert torch.equal(outcome.observation[name][row, step], value[row, step + 1])
                if name in ITEMS:
                    seen = one.rounds.visible[name]
                    assert torch.equal(outcome.visible[name][row, step], seen[row, step + 1])


@pytest.mark.parametrize("shape", [(3,), (4, 2), (2, 3, 1, 5), (0, 3), (2, 0, 4)])
def test_log_softmax_of_few_is_that_of_torch(shape, generator):
    logits = 5 * torch.randn(shape, generator=generator).double()
    logits.requires_grad_()
    found = log_softmax_of_few(logits)
    assert found.shape == logits.shape
    torch.testing.assert_close(found, logits.log_softmax(-1))
    weights = torch.randn(shape, generator=generator).double()
    (own,) = torch.autograd.grad((found * weights).sum(), logits)
    (expected,) = torch.autograd.grad((logits.log_softmax(-1) * weights).sum(), logits)
    torch.testing.assert_close(own, expected)
    # Of expanded inputs, too.
    wide = logits.detach().expand(2, *shape)
    torch.testing.assert_close(log_softmax_of_few(wide), wide.log_softmax(-1))
