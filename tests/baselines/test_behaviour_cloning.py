from dataclasses import replace

import pytest
import torch
from example_rounds import alternate, anything, avoid, ragged, rounds_of

from mirror_ppl.baselines import (
    BehaviourCloneOptions,
    SoftQOptions,
    fit_behaviour_clone,
    held_out_nll,
    input_size,
)
from mirror_ppl.baselines.recurrent import initial_weights
from mirror_ppl.data import concatenate
from mirror_ppl.domains import get_domain
from mirror_ppl.domains.driving import FOG_REACH, ROAD_END, SWITCH, Driving
from mirror_ppl.errors import DemonstrationsError, UnknownNameError

BRIEF = BehaviourCloneOptions(epochs=6)


@pytest.fixture
def random_clone(generator):
    """A clone with weights that all matter, unlike those of a fresh one, and rounds to feed it."""
    data = rounds_of(anything, generator, 8)
    clone = fit_behaviour_clone(data, data, BRIEF, seed=1)
    return randomized(clone, generator), data


def randomized(clone, generator):
    with torch.no_grad():
        for value in clone.weights.values():
            value.copy_(0.5 * torch.randn(value.shape, generator=generator))
    return clone


@pytest.mark.parametrize("rule", [avoid, alternate])
@pytest.mark.parametrize(
    "options",
    [
        BehaviourCloneOptions(epochs=120),
        BehaviourCloneOptions(epochs=120, batch=10, weight_decay=3.0),
    ],
)
def test_solves_a_task_that_it_must(rule, options, generator):
    data = rounds_of(rule, generator, 80)
    train, validation, test = (
        data.select_rounds(slice(*ends)) for ends in ((0, 40), (40, 50), (50, 80))
    )
    clone = fit_behaviour_clone(train, validation, options, seed=0)
    rate = (train.actions == SWITCH).float().mean()
    knowing_nothing = float(torch.special.entr(torch.stack([rate, 1 - rate])).sum())
    # The weight decay that is good for people, who are not deterministic, keeps it from nothing.
    assert held_out_nll(clone, test).item() < 0.25 * knowing_nothing
    right = clone.log_probabilities(test).argmax(-1) == test.actions
    assert right.float().mean() > 0.98


def test_is_the_gru_of_torch(random_clone):
    clone, data = random_clone
    inputs = clone.inputs(data).steps
    assert inputs.shape[-1] == input_size(Driving())
    gru = torch.nn.GRU(inputs.shape[-1], clone.hidden, batch_first=True)
    with torch.no_grad():
        for ours, theirs in (
            ("input", gru.weight_ih_l0),
            ("recurrent", gru.weight_hh_l0),
            ("input_bias", gru.bias_ih_l0),
            ("recurrent_bias", gru.bias_hh_l0),
        ):
            theirs.copy_(clone.weights[ours][0].T.reshape(theirs.shape))
        states = gru(inputs[0])[0]
        expected = clone.act(states.flatten(0, 1)[None]).reshape(1, *states.shape[:2], 2)
    torch.testing.assert_close(clone.log_probabilities(data), expected, atol=1e-4, rtol=1e-4)


def test_step_by_step_is_the_same_as_all_at_once(random_clone):
    clone, data = random_clone
    inputs, hidden, steps = clone.inputs(data).steps, clone.start(8), []
    for now in inputs.unbind(2):
        hidden = clone.step(hidden, now)
        steps.append(clone.act(hidden))
    torch.testing.assert_close(
        clone.log_probabilities(data), torch.stack(steps, 2), atol=1e-5, rtol=1e-4
    )


def test_predicts_normalized_probabilities(random_clone):
    clone, data = random_clone
    total = clone.log_probabilities(data).exp().sum(-1)
    torch.testing.assert_close(total, torch.ones_like(total))


def test_an_action_is_no_input_to_its_own_prediction(random_clone):
    clone, data = random_clone
    actions = data.actions.clone()
    actions[:, :, 6] = 1 - actions[:, :, 6]
    before = clone.log_probabilities(data)
    after = clone.log_probabilities(replace(data, actions=actions))
    assert torch.equal(before[:, :, :7], after[:, :, :7])
    assert (before[:, :, 7] != after[:, :, 7]).any(-1).all()


def test_cannot_see_what_is_not_visible(random_clone):
    clone, data = random_clone
    hidden = ~Driving().visibility("fog", data.observations)["visual"]
    moved = {name: value.clone() for name, value in data.observations.items()}
    for value in moved.values():
        ahead = value[..., 0]
        # From 3...12 to 12...3 ahead, from 1...12 to 12...1 behind.
        elsewhere = torch.where(ahead > 0, FOG_REACH + 1 + ROAD_END, -1 - ROAD_END) - ahead
        value[..., 0] = torch.where(hidden, elsewhere, ahead)
        value[..., 1] = torch.where(hidden, -value[..., 1], value[..., 1])
    moved["verbal"][..., 2] *= -1
    changed = replace(data, observations=moved)
    still_hidden = ~Driving().visibility("fog", changed.observations)["visual"]
    assert torch.equal(hidden, still_hidden)
    assert (moved["visual"] != data.observations["visual"]).any()
    assert torch.equal(clone.log_probabilities(data), clone.log_probabilities(changed))
    clone.sight = "everything"
    assert not torch.allclose(clone.log_probabilities(data), clone.log_probabilities(changed))


@pytest.mark.parametrize("modality", ["visual", "verbal"])
def test_reads_messages(modality, random_clone):
    clone, data = random_clone
    told = {name: value.clone() for name, value in data.told.items()}
    # A car behind, which nobody sees in fog.
    told[modality][:, :, 5, 2] = True
    changed = replace(data, told=told)
    behind = data.observations["visual"][:, :, 5, 2, 0] < 0
    before, after = clone.log_probabilities(data), clone.log_probabilities(changed)
    assert torch.equal(before[:, :, :5], after[:, :, :5])
    assert (before[:, :, 5] != after[:, :, 5]).any(-1)[behind].all()
    added = (clone.inputs(changed).steps - clone.inputs(data).steps)[:, :, 5][behind]
    # The symbols of that car in that modality, that it is visible, and that it was told.
    symbols = Driving().symbols(data.observation())[modality][:, :, 5, 2][behind]
    assert torch.equal(added.sum(-1), symbols.sum(-1) + 2)


def test_words_that_training_lacked_change_nothing(generator):
    data = rounds_of(avoid, generator, 20)
    clone = fit_behaviour_clone(data, data, BRIEF, seed=0)
    told = {**data.told, "verbal": torch.ones_like(data.told["verbal"])}
    heard = clone.log_probabilities(replace(data, told=told))
    torch.testing.assert_close(heard, clone.log_probabilities(data))


def test_padding_is_ignored_in_prediction(random_clone, generator):
    clone, _ = random_clone
    data = ragged(generator, "a", 12)
    together = clone.log_probabilities(data)
    for number, length in enumerate(data.lengths[0].tolist()):
        alone = data.select_rounds([number])
        assert alone.shape == (1, 1, length)
        torch.testing.assert_close(
            clone.log_probabilities(alone)[0, 0], together[0, number, :length], atol=1e-5, rtol=1e-4
        )
    own = together.gather(-1, data.actions.clamp(min=0)[..., None])[..., 0][data.mask]
    torch.testing.assert_close(held_out_nll(clone, data), -own.mean()[None])


@pytest.mark.parametrize("batch", [50, 6])
def test_each_person_is_fitted_as_if_alone(batch, generator):
    few, many = ragged(generator, "few", 4), ragged(generator, "many", 30)
    options = replace(BRIEF, batch=batch, check_every=2, full_decay_rounds=10)
    test = concatenate([few, many])
    clone = fit_behaviour_clone(test, test, options, seed=3)
    for person, part in (("few", few), ("many", many)):
        alone = fit_behaviour_clone(part, part, options, seed=3)
        torch.testing.assert_close(
            alone.log_probabilities(part),
            clone.log_probabilities(test.select_people([person])),
            atol=1e-3,
            rtol=1e-3,
        )
    order = ["many", "few"]
    swapped = held_out_nll(clone, test.select_people(order))
    torch.testing.assert_close(swapped, held_out_nll(clone, test).flip(0))


def test_stops_early_and_keeps_the_best(generator):
    train, validation = rounds_of(anything, generator, 3), rounds_of(anything, generator, 20)
    reports = []
    options = BehaviourCloneOptions(weight_decay=0.0, patience=3, check_every=2, epochs=200)
    clone = fit_behaviour_clone(
        train, validation, options, 0, lambda done, message: reports.append((done, message))
    )
    # Three coin-tossed rounds can only be learned by heart.
    assert len(reports) < 50
    assert reports[0][0] == 0 and reports[-1][0] == options.epochs
    best = float(reports[-1][1].split()[1])
    assert held_out_nll(clone, validation).item() == pytest.approx(best, abs=1e-3)
    assert best < 0.75


def test_a_seed_determines_the_clone(generator):
    data = ragged(generator, "a", 8)
    options = replace(BRIEF, batch=5)
    before = torch.get_rng_state()
    one, same, other = (fit_behaviour_clone(data, data, options, seed) for seed in (0, 0, 1))
    assert torch.equal(before, torch.get_rng_state())
    assert torch.equal(one.log_probabilities(data), same.log_probabilities(data))
    assert not torch.equal(one.log_probabilities(data), other.log_probabilities(data))


def test_rounds_are_needed(generator):
    data = concatenate([ragged(generator, "a", 2), ragged(generator, "b", 5)])
    none_of_a = data.select_rounds(slice(2, None))
    with pytest.raises(DemonstrationsError, match="person 'a' has no training round"):
        fit_behaviour_clone(none_of_a, data, BRIEF, 0)
    with pytest.raises(DemonstrationsError, match="person 'a' has no validation round"):
        fit_behaviour_clone(data, none_of_a, BRIEF, 0)
    with pytest.raises(DemonstrationsError, match="expected those of training: driving, a, b"):
        fit_behaviour_clone(data, data.select_people(["b"]), BRIEF, 0)
    clone = fit_behaviour_clone(data, data, BRIEF, 0)
    assert held_out_nll(clone, none_of_a).isnan().tolist() == [True, False]


def test_refuses_people_that_it_does_not_know(random_clone, generator):
    clone, _ = random_clone
    with pytest.raises(UnknownNameError, match='unknown person "b"; known: a'):
        clone.log_probabilities(ragged(generator, "b", 2))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"epochs": 0}, "epochs must be at least 1"),
        ({"patience": 0}, "patience must be at least 1"),
        ({"layers": (32, 0)}, r"layers must have at least 1 unit each, not \(32, 0\)"),
        ({"learning_rate": 0.0}, "learning_rate must be positive"),
        ({"weight_decay": -1.0}, "weight_decay must not be negative"),
        ({"weight_decay": float("nan")}, "weight_decay must not be negative"),
        ({"weight_decay": 20.0, "learning_rate": 0.05}, "below 1 / learning_rate"),
    ],
)
def test_options_refuse_impossible_values(wrong, message):
    with pytest.raises(ValueError, match=message):
        BehaviourCloneOptions(**wrong)


@pytest.mark.parametrize(
    ("domain", "options", "units"),
    [
        ("driving", BehaviourCloneOptions, [48, 32]),
        ("driving", SoftQOptions, [48, 32, 32, 32]),
        ("highway", BehaviourCloneOptions, [128, 128, 128, 128]),
        ("highway", SoftQOptions, [128, 128, 128, 128]),
    ],
)
def test_networks_have_the_sizes_of_the_supplement(domain, options, units, generator):
    """Section D: the GRU's units, then those of each layer."""
    chosen, world = options.of(domain), get_domain(domain)
    weights = initial_weights(world, chosen.hidden, chosen.layers, [generator])
    before = [weights[name].shape[1] for name in weights if name.startswith("layer_")][::2]
    assert [*before, weights["output"].shape[1]] == units
    assert weights["recurrent"].shape[1] == units[0]


def test_options_refuse_unknown_sights():
    with pytest.raises(UnknownNameError, match='unknown sight "all"'):
        BehaviourCloneOptions(sight="all")
