"""Implants of people: how they act on what they believe, and that every implant matters."""

import math
from dataclasses import replace

import pyro
import pytest
import torch
from exact import log_joint
from example_implants import ACTIONS, ASSUMED, LATENT, SIGHTS, policy
from pyro.infer import TraceEnum_ELBO, config_enumerate

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.inference.svi import continuous_guide
from mirror_ppl.likelihood.compiled import ViewTables
from mirror_ppl.likelihood.table_program import log_likelihoods
from mirror_ppl.likelihood.tables import build_view_table
from mirror_ppl.models import HumanModel
from mirror_ppl.models.implants import RESIDUAL_HIDDEN, residual
from mirror_ppl.models.weights import load_self_model, shipped_weights


@pytest.fixture(scope="module")
def human():
    return HumanModel(load_self_model(shipped_weights("driving"))[0])


@pytest.fixture(scope="module")
def recordings():
    """Two people in fog, two rounds each."""
    every = load_demonstrations(asset_path("driving_fog_paper.nc"))
    return every.select_people([0, 3]).select_rounds(slice(0, 2))


@pytest.fixture(scope="module")
def table(human, recordings):
    """All 9604 combinations of the first round."""
    return build_view_table(human, recordings.select_rounds([0]))


# --- act --------------------------------------------------------------------------------------


def random_policy(*batch):
    return {
        "consistency": torch.rand(*batch, 1) * 5,
        "lapse": torch.rand(*batch, 1) * 0.2,
        "residual_in": torch.randn(*batch, 1, LATENT + 1, RESIDUAL_HIDDEN),
        "residual_out": torch.randn(*batch, 1, RESIDUAL_HIDDEN + 1, ACTIONS),
    }


def act_by_hand(one, belief, values):
    """Probabilities ``[B, A]`` of one person's actions under one draw of their implants."""
    hidden = torch.tanh(belief @ one["residual_in"][:-1] + one["residual_in"][-1])
    delta = hidden @ one["residual_out"][:-1] + one["residual_out"][-1]
    chosen = torch.softmax(one["consistency"] * values + delta, -1)
    return (1 - one["lapse"]) * chosen + one["lapse"] / ACTIONS


@pytest.mark.parametrize(("draws", "people"), [(1, 3), (2, 3), (2, 1)])
def test_act_is_a_distribution_and_each_person_their_own(human, draws, people):
    belief, values = torch.randn(3, 75, LATENT), torch.randn(3, 75, ACTIONS)
    implants = random_policy(draws, people)
    result = human.act(implants, belief, values)
    assert result.shape == (draws, 3, 75, ACTIONS)
    torch.testing.assert_close(result.exp().sum(-1), torch.ones(result.shape[:-1]))
    for draw in range(draws):
        alone = human.act({name: value[draw] for name, value in implants.items()}, belief, values)
        torch.testing.assert_close(alone, result[draw], rtol=1e-4, atol=1e-5)
        for person in range(3):
            own = person if people > 1 else 0
            one = {name: value[draw, own, 0] for name, value in implants.items()}
            expected = act_by_hand(one, belief[person], values[person])
            found = result[draw, person].exp()
            torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_prior_keeps_the_residual_small(human):
    with pyro.plate("draw", 500, dim=-3), pyro.plate("person", 1, dim=-2):
        implants = human.prior()
    spread = residual(implants, torch.randn(1, 4, LATENT)).std()
    # Each weight out has standard deviation 0.1; at most 8 units and a bias feed on them.
    assert 0.1 < spread < 0.1 * math.sqrt(1 + RESIDUAL_HIDDEN)


# --- every implant matters --------------------------------------------------------------------


def test_every_continuous_implant_gets_a_gradient_from_the_likelihood(human, table):
    implants = {name: value.requires_grad_() for name, value in random_policy(2).items()}
    likelihood = log_likelihoods(human, implants, table)
    likelihood[:, 0].sum().backward()
    for name, value in implants.items():
        assert (value.grad.flatten(1).abs().amax(1) > 0).all(), name


def test_every_continuous_implant_gets_a_gradient_from_the_elbo(human, table):
    """The gradient of the guide differs from what it would be without recordings."""

    def gradients(table):
        torch.manual_seed(0)
        compiled = ViewTables(human, table)
        guide = continuous_guide(compiled)
        torch.manual_seed(1)
        model = config_enumerate(compiled.program, "parallel")
        TraceEnum_ELBO(max_plate_nesting=2)(model, guide)().backward()
        return {name: value.grad for name, value in guide.named_parameters()}

    with pyro.settings.context(module_local_params=True):
        learned = gradients(table)
        alone = gradients(replace(table, steps=torch.zeros_like(table.steps)))
    assert len(learned) == 2 * len(policy(human))
    for name, value in learned.items():
        assert (value - alone[name]).abs().max() > 1e-3, name


def test_every_discrete_implant_changes_the_likelihood(human, recordings):
    # In the released MIRROR code latent states were drawn without reparameterization, so what a
    # person sees had a gradient of exactly zero: whatever they did, sight stayed where it began.
    table = build_view_table(human, recordings)
    joint = log_joint(human, table, policy(human, 2)).unflatten(-1, table.sizes)
    assert table.sites == (*SIGHTS, *ASSUMED)
    for axis, site in enumerate(table.sites, start=1):
        spread = joint.amax(axis) - joint.amin(axis)
        assert spread.flatten(1).amax(1).min() > 0.5, site


@pytest.mark.parametrize("draws", [(), (0,), (3,)])
@pytest.mark.parametrize(("people", "rounds"), [(1, 1), (1, 5), (2, 1), (2, 5)])
@pytest.mark.parametrize("own", [False, True])
def test_the_residual_is_a_network_of_two_layers(draws, people, rounds, own, generator):
    """By hand, with beliefs that draws share or of their own, and its gradients."""

    def drawn(*shape):
        return torch.randn(shape, generator=generator, dtype=torch.float64).requires_grad_()

    weights = {
        "residual_in": drawn(*draws, people, 1, LATENT + 1, RESIDUAL_HIDDEN),
        "residual_out": drawn(*draws, people, 1, RESIDUAL_HIDDEN + 1, ACTIONS),
    }
    belief = drawn(*(draws if own else ()), people, rounds, LATENT)

    def layer(weight, inputs):
        weight = weight.squeeze(-3)
        product = torch.einsum("...pbi,...pio->...pbo", inputs, weight[..., :-1, :])
        return product + weight[..., -1:, :]

    expected = layer(weights["residual_out"], torch.tanh(layer(weights["residual_in"], belief)))
    found = residual(weights, belief)
    torch.testing.assert_close(found, expected)
    inputs = [belief, *weights.values()]
    some = torch.randn(found.shape, generator=generator, dtype=torch.float64)
    for one, other in zip(
        torch.autograd.grad((found * some).sum(), inputs),
        torch.autograd.grad((expected * some).sum(), inputs),
        strict=True,
    ):
        torch.testing.assert_close(one, other)
