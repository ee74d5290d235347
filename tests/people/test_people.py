"""Simulated drivers: their populations, and the recordings of them."""

from dataclasses import fields, replace

import pytest
import torch

from mirror_ppl.commands.simulate import DESCRIPTION, PROGRAM, Options, main
from mirror_ppl.console import run
from mirror_ppl.data import load_demonstrations
from mirror_ppl.domains import DOMAINS, get_domain
from mirror_ppl.domains.driving import FOG_REACH, Driving
from mirror_ppl.domains.driving.participants import learned_reward, simulated_drivers
from mirror_ppl.domains.driving.populations import (
    CONSISTENCY_MEDIAN,
    CONSISTENCY_SPREAD,
    REACHES_AHEAD,
    REACHES_BEHIND,
    consistencies,
    reaches,
)
from mirror_ppl.domains.highway import Highway
from mirror_ppl.errors import UnknownNameError
from mirror_ppl.people import populations_of, simulate
from mirror_ppl.people.recordings import draw_starts, record
from mirror_ppl.randomness import derived_generator

DOMAIN = Driving()


# --- populations ------------------------------------------------------------------------------


def test_generators_differ_by_seed_and_purpose():
    draws = {
        torch.rand(2, generator=derived_generator(*key)).sum().item()
        for key in [(0,), (1,), (0, "a"), (0, "b"), (1, "a"), (0, "a", 1), (0, "a", 2)]
    }
    assert len(draws) == 7


def test_consistencies_are_log_normal():
    number = 2000
    logs = consistencies(number, 0).log()
    mean, spread = torch.tensor(CONSISTENCY_MEDIAN).log(), CONSISTENCY_SPREAD
    # Four standard errors of a mean and of a standard deviation.
    assert abs(logs.mean() - mean) < 4 * spread / number**0.5
    assert abs(logs.std() - spread) < 4 * spread / (2 * number) ** 0.5


def test_reaches_of_the_populations():
    assert reaches("paper", "fog", 2, 0).tolist() == [[FOG_REACH, FOG_REACH, 0, 0]] * 2
    assert reaches("paper", "clear", 2, 0).tolist() == [[12, 12, 12, 12]] * 2
    diverse = reaches("diverse", "fog", 300, 0)
    assert torch.equal(diverse, reaches("diverse", "clear", 300, 0))
    assert torch.equal(diverse[:, 0], diverse[:, 1])
    assert torch.equal(diverse[:, 2], diverse[:, 3])
    # The chance that one of five options is missing among 300 draws is 5 * 0.8**300 < 1e-27.
    assert set(diverse[:, 0].tolist()) == set(REACHES_AHEAD)
    assert set(diverse[:, 2].tolist()) == set(REACHES_BEHIND)
    # Every reach that occurs is the lower edge of a bin, so that it can be told from the others.
    assert set(diverse.flatten().tolist()) <= set(DOMAIN.reach_bins)


def test_the_first_people_are_the_same_however_many_there_are():
    assert torch.equal(consistencies(20, 3)[:7], consistencies(7, 3))
    assert torch.equal(reaches("diverse", "fog", 20, 3)[:7], reaches("diverse", "fog", 7, 3))
    few, many = simulate(people=2, rounds=3), simulate(people=4, rounds=3)
    assert torch.equal(few.actions, many.actions[:2])


# --- recordings -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fog():
    return simulate("driving", "fog", "paper", people=10, rounds=20, seed=0)


def test_shapes_and_truths(fog):
    assert fog.shape == (10, 20, 15)
    assert len(set(fog.people)) == 10
    truth = {name: value.tolist() for name, value in fog.truth.items()}
    assert torch.equal(fog.truth["consistency"], consistencies(10, 0))
    del truth["consistency"]
    assert truth == {
        "sight_front_own": [2.0] * 10,
        "sight_front_other": [2.0] * 10,
        "sight_back_own": [0.0] * 10,
        "sight_back_other": [0.0] * 10,
        "assumes_clear": [1.0] * 10,
        "assumes_closing": [1.0] * 10,
    }
    assert fog.provenance["population"] == "paper"
    assert fog.provenance["seed"] == 0
    diverse = simulate("driving", "fog", "diverse", people=3, rounds=1, seed=5)
    for index, name in enumerate(DOMAIN.directions):
        expected = reaches("diverse", "fog", 3, 5)[:, index]
        assert torch.equal(diverse.truth[f"sight_{name}"], expected)


def test_recordings_obey_the_world(fog):
    lane = fog.ego[..., 0].long()
    assert torch.equal(lane[:, :, 1:], lane[:, :, :-1] ^ fog.actions)
    place, said = fog.observations["visual"][..., 0], fog.observations["verbal"][..., 0]
    assert torch.equal(place, said)
    near = (place.abs() <= 2) & (fog.observations["visual"][..., 1] == 0)
    hit = (place == 0) & near
    expected = -2.0 * near.sum(-1) - 5.0 * hit.sum(-1)
    assert torch.equal(fog.rewards, expected[:, :, 1:] - fog.actions)
    assert not any(mask.any() for mask in fog.told.values())


@pytest.fixture(scope="module")
def recording(request):
    """Rounds with the probabilities of what was done."""
    seed = request.config.getoption("--seed")
    drivers = simulated_drivers("fog", "paper", 10, 0)
    return record(drivers, draw_starts(10, 60, seed, "a test of actions"))


def test_actions_are_drawn_with_their_probabilities(recording):
    switch = recording.probabilities[..., 1]
    surplus = (recording.actions - switch).sum()
    assert abs(surplus) < 4 * (switch * (1 - switch)).sum().sqrt()
    # The same for those 1,000 choices about which drivers were least sure.
    unsure = (switch - 0.5).abs().flatten().argsort()[:1000]
    chosen = switch.flatten()[unsure]
    surplus = (recording.actions.flatten()[unsure] - chosen).sum()
    assert abs(surplus) < 4 * (chosen * (1 - chosen)).sum().sqrt()


def test_the_entropy_is_the_expected_surprise(fog, recording):
    assert (fog.action_entropy >= 0).all()
    assert (fog.action_entropy <= torch.tensor(2.0).log() + 1e-6).all()
    log = recording.probabilities.clamp(min=1e-30).log()
    surprise = -log.gather(-1, recording.actions[..., None])[..., 0]
    difference = surprise - torch.special.entr(recording.probabilities).sum(-1)
    spread = (log - log.flip(-1)).abs()[..., 0] * recording.probabilities.prod(-1).sqrt()
    assert abs(difference.sum()) < 4 * spread.square().sum().sqrt()


def test_fog_costs_reward():
    returns = {
        setting: simulate("driving", setting, rounds=20).rewards.sum(-1).flatten()
        for setting in DOMAIN.settings
    }
    gain = returns["clear"].mean() - returns["fog"].mean()
    error = sum(value.var() / len(value) for value in returns.values()) ** 0.5
    # Measured over five seeds: 3.5, with a standard error of 0.7 at 200 rounds each.
    assert gain > 2 * error


def test_the_same_call_gives_the_same_recordings(fog):
    learned_reward.cache_clear()
    assert simulate("driving", "fog", "paper", people=10, rounds=20, seed=0).equals(fog)


@pytest.mark.parametrize("domain", list(DOMAINS))
def test_messages_are_recorded_and_as_frequent_as_asked_for(domain, monkeypatch):
    """Messages are 10% of the items that can be communicated; people and starts stay the same."""
    monkeypatch.setattr(Highway, "horizon", 8)
    number = 4 if domain == "highway" else 20  # of many steps
    quiet = simulate(domain, people=2, rounds=number, seed=0)
    spoken_to = simulate(domain, people=2, rounds=number, seed=0, told=0.1)
    assert not any(mask.any() for mask in quiet.told.values())
    assert torch.equal(spoken_to.ego[:, :, 0], quiet.ego[:, :, 0])
    assert not torch.equal(spoken_to.actions, quiet.actions)
    can_be = get_domain(domain).communicable(
        {name: value[:, :, :-1] for name, value in spoken_to.observation().items()}
    )
    probabilities = sum(int((can_be[n] & spoken_to.mask[..., None]).sum()) for n in can_be)
    told = sum(int(mask.sum()) for mask in spoken_to.told.values())
    assert not any((mask & ~can_be[name]).any() for name, mask in spoken_to.told.items())
    assert abs(told - 0.1 * probabilities) < 4.5 * (0.09 * probabilities) ** 0.5
    assert spoken_to.provenance["told"] == 0.1 and "told" not in quiet.provenance


def test_the_rate_of_messages_is_a_probability():
    with pytest.raises(ValueError, match="told must be from 0 to 1, not 2"):
        simulate(people=1, rounds=1, told=2.0)


def test_another_seed_gives_other_people_and_rounds(fog):
    other = simulate("driving", "fog", "paper", people=10, rounds=1, seed=1)
    assert not torch.equal(other.truth["consistency"], fog.truth["consistency"])
    assert not torch.equal(other.observations["visual"], fog.observations["visual"][:, :1])


def test_people_are_the_same_in_every_setting_and_rounds_are_not(fog):
    clear = simulate("driving", "clear", "paper", people=10, rounds=20, seed=0)
    assert torch.equal(clear.truth["consistency"], fog.truth["consistency"])
    assert not torch.equal(
        clear.observations["visual"][:, :, 0], fog.observations["visual"][:, :, 0]
    )


def test_global_randomness_is_neither_used_nor_touched(fog):
    torch.manual_seed(1)
    before = torch.random.get_rng_state()
    again = simulate("driving", "fog", "paper", people=10, rounds=20, seed=0)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert again.equals(fog)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"domain": "drivin"}, 'domain "drivin".*perhaps you meant "driving"'),
        ({"setting": "frog"}, 'setting "frog".*perhaps you meant "fog"'),
        ({"population": "papers"}, 'population "papers".*perhaps you meant "paper"'),
    ],
)
def test_unknown_names_are_refused(wrong, message):
    with pytest.raises(UnknownNameError, match=message):
        simulate(**wrong)


@pytest.mark.parametrize("name", ["people", "rounds"])
def test_nobody_and_no_rounds_are_refused(name):
    with pytest.raises(ValueError, match=f"{name} must be at least 1, not 0"):
        simulate(**{name: 0})


# --- the command ------------------------------------------------------------------------------


def command(*args):
    return run(Options, main, prog=PROGRAM, description=DESCRIPTION, args=args)


@pytest.mark.parametrize("rate", [0.0, 0.2])
def test_command_writes_what_simulate_returns(rate, tmp_path, capsys):
    path = tmp_path / "made" / "people.nc"
    args = ["--people", "2", "--rounds", "3", "--population", "diverse", "--setting", "clear"]
    args += ["--told", str(rate)] if rate else []
    assert command("--out", str(path), "--seed", "4", *args) == 0
    loaded = load_demonstrations(path)
    made = simulate("driving", "clear", "diverse", 2, 3, 4, told=rate)
    assert replace(loaded, provenance=made.provenance).equals(made)
    # What is written makes the same recordings again, wherever to.
    told = loaded.provenance["command"]
    again = tmp_path / "again.nc"
    assert command(*told.removeprefix(PROGRAM).split(), "--out", str(again)) == 0
    assert load_demonstrations(again).equals(loaded)
    printed = capsys.readouterr().out
    assert str(path) in printed
    assert "people 2, rounds of each 3" in printed
    assert f"{made.rewards.sum(-1).mean().item():.3f}" in printed
    assert f"{made.action_entropy.mean().item():.4f} nats" in printed


@pytest.mark.parametrize(
    "wrong",
    [
        ("--domain", "drivin"),
        ("--setting", "frog"),
        ("--population", "papers"),
        ("--device", "toaster"),
        ("--people", "0"),
        ("--told", "1.5"),
        ("--rounds", "-1"),
        ("--rounds", "many"),
    ],
)
def test_command_refuses_bad_options_and_writes_nothing(wrong, tmp_path, capsys):
    path = tmp_path / "people.nc"
    assert command("--out", str(path), *wrong) == 2
    assert wrong[1] in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_command_that_cannot_write(tmp_path, capsys):
    blocked = tmp_path / "file"
    blocked.touch()
    assert command("--people", "1", "--rounds", "1", "--out", str(blocked / "people.nc")) == 2
    assert "cannot" in capsys.readouterr().err


def test_help_names_every_choice(capsys):
    assert command("--help") == 0
    text = " ".join(capsys.readouterr().out.split())
    for name in (*DOMAINS, *DOMAIN.settings, *populations_of("driving")):
        assert name in text
    for option in fields(Options):
        assert f"--{option.name.replace('_', '-')}" in text
