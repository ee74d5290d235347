"""Networks: their sizes, and what masks hide of their inputs."""

import math
import re

import pytest
import torch
from example_implants import ACTIONS, LATENT
from example_networks import DRIVING, ITEMS, encoder
from torch import nn

from mirror_ppl.errors import InputError
from mirror_ppl.models.networks import (
    MIN_SCALE,
    TINY,
    BinnedQNetwork,
    Decoder,
    GaussianHead,
    QNetwork,
    Reward,
    Transition,
    log_softmax_with_lapse,
    softmax_of_few,
)
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.sizes import Sizes

SYMBOLS = {"ego": 2, "visual": 50, "verbal": 53}


def linear_sizes(module):
    """(in, out) of each linear layer, in order."""
    return [
        (part.in_features, part.out_features)
        for part in module.modules()
        if isinstance(part, nn.Linear)
    ]


def symbols(*batch, dtype=torch.float64):
    """Any values of the encoder's inputs, not only those that occur."""
    ego = torch.randn(*batch, SYMBOLS["ego"], dtype=dtype)
    items = {name: torch.randn(*batch, ITEMS[name], SYMBOLS[name], dtype=dtype) for name in ITEMS}
    return {"ego": ego, **items}


def masks(*batch):
    return {name: torch.rand(*batch, number) < 0.5 for name, number in ITEMS.items()}


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


def test_binned_q_network_has_an_output_for_each_bin():
    network = BinnedQNetwork(LATENT, ACTIONS, 16, bins=3, least=-1.0, most=3.0).double()
    assert linear_sizes(network) == [(48, 16), (16, 16), (16, 16), (16, 9)]
    # Three bins more on either side.
    assert network.centres.tolist() == [-7, -5, -3, -1, 1, 3, 5, 7, 9]
    z = torch.randn(3, LATENT, dtype=torch.float64)
    probabilities = network.log_probabilities(z).exp()
    assert probabilities.shape == (3, ACTIONS, 9)
    by_hand = sum(probabilities[..., i] * (2 * i - 7) for i in range(9))
    torch.testing.assert_close(network(z), by_hand)


@pytest.mark.parametrize("network", [QNetwork(7, 5, 16), BinnedQNetwork(7, 5, 16, 4, -1.0, 3.0)])
@pytest.mark.parametrize(
    ("shape", "parts"),
    [((0,), [0]), ((288,), [288]), ((289,), [288, 1]), ((2, 5, 70), [288, 288, 124])],
)
def test_many_values_are_computed_in_parts(network, shape, parts, monkeypatch):
    """1,536 values at once are those of 307 latents, rounded down to blocks of 32."""
    sizes, values = [], type(network).values_at_once

    def noted(self, latent):
        sizes.append(latent.shape[:-1].numel())
        return values(self, latent)

    monkeypatch.setattr(type(network), "values_at_once", noted)
    z = torch.randn(*shape, 7, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        found = network(z)
        assert sizes == parts
        torch.testing.assert_close(found, values(network, z))
    sizes.clear()
    assert network(z).requires_grad and len(sizes) == 1  # gradients are of all at once


@pytest.mark.parametrize("ends", [(-20.0, 20.0), (-200.0, 5.0), (-30.0, 0.0), (5.0, 20.0)])
def test_binned_values_begin_next_to_0(ends):
    least, most = ends
    network = BinnedQNetwork(LATENT, ACTIONS, 16, 60, least, most)
    with torch.no_grad():
        network.value.weight.zero_()
    values = network(torch.zeros(1, LATENT))
    # The distance to the value next to 0 is at most that of an exponential distribution.
    assert (values - min(max(0.0, least), most)).abs().max() < 0.05 * (most - least)


def test_bins_are_learned_as_gaussians_around_values():
    """Of bins of width 2 the standard deviation is 1.5, by hand from the normal distribution."""
    network = BinnedQNetwork(LATENT, ACTIONS, 16, bins=101, least=-100.0, most=100.0).double()
    values = torch.tensor([[0.0, 1.0], [3.3, 1000.0]], dtype=torch.float64)
    found = network.target(values)
    assert found.shape == (2, 2, 107)
    torch.testing.assert_close(found.sum(-1), torch.ones(2, 2, dtype=torch.float64))
    normal = torch.distributions.Normal(0.0, 1.5)
    near, far = (float(normal.cdf(torch.tensor(x)) - 0.5) for x in (1.0, 3.0))
    # 0 is the centre of bin 53; 1 lies between this one and the next.
    assert found[0, 0, 52:55].tolist() == pytest.approx([far - near, 2 * near, far - near])
    assert found[0, 1, 53:55].tolist() == pytest.approx(
        2 * [float(normal.cdf(torch.tensor(2.0))) - 0.5]
    )
    # What is beyond the ends counts as at the ends.
    assert torch.equal(found[1, 1], network.target(torch.tensor(100.0, dtype=torch.float64)))


@pytest.mark.parametrize("value", [-4.0, -3.8, 0.0, 1.3, 5.9, 6.0])
def test_bins_have_the_means_that_they_are_learned_from(value):
    """Also at the ends; of a Gaussian over bins of 4 / 3 standard deviations little is lost."""
    network = BinnedQNetwork(LATENT, ACTIONS, 16, bins=6, least=-4.0, most=6.0)
    mean = network.mean(network.target(torch.tensor(value)).log())
    assert float(mean) == pytest.approx(value, abs=0.01)


def test_ranked_cross_entropy_counts_how_far_away_values_are():
    """By hand, of bins of width 2 around -8, -6, -4, -2, 0, 2, 4, 6, 8 and 10."""
    network = BinnedQNetwork(LATENT, ACTIONS, 16, bins=4, least=-2.0, most=4.0)
    assert network.centres.tolist() == list(range(-8, 11, 2))
    target = torch.tensor([0.0, 0.0, 0.25, 0.75, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    found = torch.tensor([0.0, 0.0, 0.5, 0.0, 0.25, 0.25, 0.0, 0.0, 0.0, 0.0])
    # Below -3: .25 is wanted, .5 found; below -1: all is wanted, .5 found; below 1: .75 found.
    by_hand = -2 * (math.log(0.5) + math.log(0.5) + math.log(0.75))
    entropy = network.ranked_cross_entropy(target, found.log())
    assert float(entropy) == pytest.approx(by_hand)
    # It is least at the target itself, and a uniform background costs the more the farther away.
    smooth = 0.9 * torch.eye(10) + 0.01
    entropy = [float(network.ranked_cross_entropy(smooth[4], smooth[k].log())) for k in range(10)]
    assert entropy.index(min(entropy)) == 4
    assert entropy[:5] == sorted(entropy[:5], reverse=True) and entropy[4:] == sorted(entropy[4:])


def test_ranked_cross_entropy_moves_probability_towards_the_value():
    network = BinnedQNetwork(LATENT, ACTIONS, 16, bins=4, least=-2.0, most=4.0)
    logits = torch.zeros(10, requires_grad=True)
    target = torch.eye(10)[7]
    network.ranked_cross_entropy(target, torch.log_softmax(logits, -1)).backward()
    assert logits.grad is not None
    # Below the value the more, the farther away; above it likewise.
    below, above = logits.grad[:8], logits.grad[7:]
    assert (below.diff() < 0).all() and (above.diff() > 0).all() and below[7] < 0 < below[0]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"value_bins": 1}, "value_bins must be at least 2, not 1"),
        ({"value_bins": 2.5}, "value_bins must be a whole number, not 2.5"),
        ({"least_value": float("-inf")}, "least_value must be from -1e+06 to 1e+06, not -inf"),
        ({"least_value": 2.0}, "least_value must be below most_value, not 2 and 1"),
    ],
)
def test_sizes_refuse_bins_that_make_no_sense(wrong, message):
    with pytest.raises(InputError, match=re.escape(message)):
        Sizes(**{"value_bins": 4, "least_value": 0.0, "most_value": 1.0, **wrong})


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


@pytest.mark.parametrize("observations", [1, 6])
def test_evidence_is_that_of_embedded_items(observations):
    """Six views of one observation or of six."""
    network, values, visible = encoder(), symbols(observations), masks(6)
    together = network.combine(network.embed(values), visible)
    torch.testing.assert_close(network.evidence(values, visible), together)


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


@pytest.mark.parametrize("shape", [(3,), (4, 2), (2, 3, 1, 5), (0, 3), (2, 0, 4)])
def test_softmax_of_few_is_that_of_torch(shape, generator):
    logits = 5 * torch.randn(shape, generator=generator).double()
    weights = torch.randn(shape, generator=generator).double()
    ways = [logits, logits.expand(2, *shape)]
    if len(shape) > 1:  # values of an action are next to each other
        ways.append(logits.mT.contiguous().mT)
    for way in ways:
        way = way.detach().requires_grad_()
        found = softmax_of_few(way)
        assert found.shape == way.shape
        torch.testing.assert_close(found, way.softmax(-1))
        (own,) = torch.autograd.grad((found * weights).sum(), way)
        (expected,) = torch.autograd.grad((way.softmax(-1) * weights).sum(), way)
        torch.testing.assert_close(own, expected)


@pytest.mark.parametrize("least", [0.3, 8 * TINY, 2 * TINY, 1e-40, 0.0])
def test_log_softmax_with_lapse_is_the_mixture(least, generator):
    """Four actions, some of which are only done in a lapse."""
    logits = -80 * torch.rand(50, 4, generator=generator)
    logits[0] = torch.tensor([0.0, -500.0, -90.0, -100.0])
    logits.requires_grad_()
    lapse = torch.linspace(0.4, 0.99, 50)[:, None].clone()
    lapse[:2] = least
    lapse.requires_grad_()
    found = log_softmax_with_lapse(logits, lapse)
    aware = torch.log1p(-lapse) + logits.log_softmax(-1)
    expected = torch.logaddexp(aware, torch.log(lapse / 4).expand_as(aware))
    torch.testing.assert_close(found, expected)
    own, others = (torch.autograd.grad(value.sum(), [logits, lapse]) for value in (found, expected))
    torch.testing.assert_close(own[0], others[0])
    some = slice(2 if least == 0 else 0, None)  # the logarithm of 0 has no slope
    torch.testing.assert_close(own[1][some], others[1][some], rtol=1e-5, atol=1e-5)
