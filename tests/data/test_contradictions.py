"""Recordings held against their world: each action has to lead to the next observation."""

import json
from dataclasses import replace

import pytest
import torch
from example_recordings import loaded
from running import command

from mirror_ppl.commands import fit
from mirror_ppl.data import asset_path, save_demonstrations
from mirror_ppl.data.contradictions import check_observations, check_world
from mirror_ppl.domains import get_domain
from mirror_ppl.errors import DemonstrationsError, MirrorError
from mirror_ppl.inference.online import OnlinePosterior
from mirror_ppl.inference.results.fitting import fit_people
from mirror_ppl.models import HumanModel
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import simulate

SHIPPED = [
    "bomb_defusal_labelled_paper",
    "bomb_defusal_unlabelled_diverse",
    "driving_clear_diverse",
    "driving_fog_paper",
    "search_rescue_clear_paper",
    "search_rescue_smoke_diverse",
]


def recorded(name):
    """Two people's first five rounds."""
    every = loaded(asset_path(f"{name}.nc"))
    return every.select_people([0, 3]).select_rounds(range(5))


def with_actions(rounds, actions):
    return replace(rounds, actions=torch.where(rounds.mask, actions, -1))


def backwards(rounds):
    """Every round reversed in time; all of them are as long."""
    changed = {name: value.flip(2) for name, value in rounds.observations.items()}
    return replace(
        rounds, observations=changed, ego=rounds.ego.flip(2), actions=rounds.actions.flip(2)
    )


def refused(rounds, allowed=0.0):
    with pytest.raises(DemonstrationsError) as error:
        check_world(rounds, allowed)
    assert str(error.value).isprintable()
    return str(error.value)


@pytest.mark.parametrize("name", SHIPPED)
def test_what_the_world_made_never_contradicts(name):
    rounds = recorded(name)
    found = check_world(rounds)
    assert found.steps == dict(zip(rounds.people, rounds.mask.sum((1, 2)).tolist(), strict=True))
    assert found.contradicting == dict.fromkeys(rounds.people, 0)


@pytest.mark.parametrize("name", SHIPPED)
def test_the_first_wrong_action_is_reported_with_what_was_expected(name):
    """One action is changed, at a step at which another one leads elsewhere."""
    rounds = recorded(name)
    domain = get_domain(rounds.domain)
    observation = {key: value[1, 2, 3] for key, value in rounds.observation().items()}
    other = next(
        action
        for action in range(len(domain.actions))
        if not all(
            torch.equal(value, rounds.observation()[key][1, 2, 4])
            for key, value in domain.next_observation(observation, torch.tensor(action)).items()
        )
    )
    actions = rounds.actions.clone()
    actions[1, 2, 3] = other
    message = refused(with_actions(rounds, actions))
    assert message.startswith(
        f"person {rounds.people[1]!r}, round 2, step 3: after action {other} "
        f"({domain.actions[other]}) the ego "
    )
    assert " is expected to be " in message and " at time 4, found " in message
    assert f"; 1 of {int(rounds.mask.sum())} steps (" in message


def test_expected_and_found_by_hand():
    rounds = recorded("driving_fog_paper")
    lane = rounds.ego.clone()
    lane[0, 0] = 0.0
    cars = rounds.observations["visual"].clone()
    cars[0, 0, :, :, 1] = torch.tensor([0.0, 1.0, 0.0, 1.0])
    verbal = torch.cat([cars, rounds.observations["verbal"][..., 2:]], -1)
    actions = rounds.actions.clone()
    actions[0, 0] = 0
    actions[0, 0, 7] = 1
    changed = replace(
        rounds, ego=lane, observations={"visual": cars, "verbal": verbal}, actions=actions
    )
    assert refused(changed).startswith(
        "person 'person-01', round 0, step 7: after action 1 (switch) the ego lane is expected to "
        "be 1 at time 8, found 0; 1 of 150 steps (0.7%) contradict the next observation, 0% may"
    )


@pytest.mark.parametrize("name", SHIPPED)
def test_actions_that_are_all_zero_contradict(name):
    refused(with_actions(recorded(name), torch.zeros_like(recorded(name).actions)))


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize(("by", "word"), [(1, "after"), (-1, "before")])
def test_actions_shifted_by_a_step_are_recognized(name, by, word):
    rounds = recorded(name)
    message = refused(with_actions(rounds, torch.roll(rounds.actions.clamp(min=0), by, -1)))
    assert message.endswith(
        f"fit with the action of the step {word}: the actions look shifted by one step"
    )


@pytest.mark.parametrize("name", ["driving_fog_paper", "driving_clear_diverse"])
def test_rounds_reversed_in_time_contradict(name):
    assert "shifted" not in refused(backwards(recorded(name)))


def test_a_car_that_comes_back_contradicts():
    rounds = recorded("driving_fog_paper")
    speed = rounds.observations["verbal"][..., 2].abs().sum()
    assert speed > 0  # there are cars on the road
    seen = rounds.observations["visual"].clone()
    said = rounds.observations["verbal"].clone()
    for cars in (seen, said):
        cars[0, 0, 4, 0, 0] = 12.0
    said[0, 0, 4, 0, 2] = 0.0
    refused(replace(rounds, observations={"visual": seen, "verbal": said}))


def test_terminals_of_a_new_stage_may_be_anything():
    rounds = recorded("bomb_defusal_unlabelled_diverse")
    domain = get_domain("bomb_defusal")
    now = {name: value[:, :, :-1] for name, value in rounds.observation().items()}
    expected = domain.next_observation(now, rounds.actions.clamp(min=0))
    presses = rounds.mask & (rounds.actions > 0)
    ends = now["ego"][..., 0] == 2
    assert expected["visual"].isnan().all((-1, -2))[presses & ~ends].all()
    assert not expected["visual"].isnan().any((-1, -2))[~presses | ends].any()


def noisy():
    """One of 150 steps of each person is wrong."""
    rounds = recorded("driving_fog_paper")
    rounds = rounds.select_rounds(range(5))
    actions = rounds.actions.clone()
    actions[:, 0, 0] = 1 - actions[:, 0, 0]
    return with_actions(rounds, actions)


@pytest.mark.parametrize("check", [check_world, check_observations])
def test_rounds_longer_than_those_of_the_world_are_refused(check):
    rounds = recorded("driving_fog_paper").select_rounds(range(2))
    last = {name: value[:, :, -1:] for name, value in rounds.observations.items()}
    long = replace(
        rounds,
        ego=torch.cat([rounds.ego, rounds.ego[:, :, -1:]], 2),
        observations={
            name: torch.cat([value, last[name]], 2) for name, value in rounds.observations.items()
        },
        actions=torch.cat([rounds.actions, rounds.actions[:, :, -1:]], 2),
        lengths=rounds.lengths + 1,
        told={},
        rewards=None,
        action_entropy=None,
    )
    text = "round 0: 16 steps, expected at most 15, as long as rounds of driving are"
    with pytest.raises(DemonstrationsError, match=f"person '{rounds.people[0]}', {text}"):
        check(long)


def going_on(rounds, more):
    """Rounds in which people take the first action after the task was done."""
    lengths = (rounds.lengths + more).clamp(max=rounds.actions.shape[2])
    times = torch.arange(rounds.actions.shape[2] + 1)
    mask = times[:-1] < lengths[..., None]

    def held(value):
        last = value.gather(
            2, _at(rounds.lengths, value).expand(*value.shape[:2], 1, *value.shape[3:])
        )
        late = (times > rounds.lengths[..., None]) & (times <= lengths[..., None])
        return torch.where(late.view(*late.shape, *(1,) * (value.dim() - 3)), last, value)

    return replace(
        rounds,
        lengths=lengths,
        actions=torch.where(mask & (rounds.actions < 0), 0, rounds.actions),
        ego=held(rounds.ego),
        observations={name: held(value) for name, value in rounds.observations.items()},
        told={},
        rewards=None,
        action_entropy=None,
    )


def _at(lengths, value):
    return lengths.view(*lengths.shape, 1, *(1,) * (value.dim() - 3))


@pytest.mark.parametrize("check", [check_world, check_observations])
@pytest.mark.parametrize("name", ["bomb_defusal_unlabelled_diverse", "search_rescue_smoke_diverse"])
def test_actions_after_the_task_is_done_are_refused(check, name):
    rounds = recorded(name)
    domain = get_domain(rounds.domain)
    done = domain.ended(rounds.observation())
    real = torch.arange(done.shape[2]) < rounds.lengths[..., None]
    assert not (done & real).any()
    person, number = (rounds.lengths <= domain.horizon - 2).nonzero()[0].tolist()
    time = int(rounds.lengths[person, number])
    with pytest.raises(DemonstrationsError) as error:
        check(going_on(rounds.select_people([person]), 2))
    assert str(error.value) == (
        f"person '{rounds.people[person]}', round {number}: the task is done at time {time}, but 2 "
        "more actions follow; length has to be the number of actions until then"
    )


def test_a_round_on_the_highway_ends_with_an_accident():
    rounds = recorded("highway_fog_diverse").select_people([0])
    assert check_world(rounds)
    ego = rounds.ego.clone()
    ego[0, 1, 40, -1] = 1.0
    text = "round 1: the task is done at time 40, but 8 more actions follow"
    assert text in refused(replace(rounds, ego=ego))


def with_rewards(rounds, rewards):
    return replace(rounds, rewards=torch.where(rounds.mask, rewards, torch.nan))


@pytest.mark.parametrize(
    ("presses", "reward", "expected"),
    [(True, -1.0, "-6 or 4"), (True, 5.0, "-6 or 4"), (False, 0.0, "-1"), (False, 4.0, "-1")],
)
def test_rewards_that_bomb_defusal_cannot_give_are_refused(presses, reward, expected):
    rounds = recorded("bomb_defusal_labelled_paper")
    fitting = rounds.mask[1] & ((rounds.actions[1] > 0) == presses)
    number, step = fitting.nonzero()[0].tolist()
    action = int(rounds.actions[1, number, step])
    rewards = rounds.rewards.clone()
    rewards[1, number, step] += 5e-4  # a rounding error
    check_world(with_rewards(rounds, rewards), 0.0)
    rewards[1, number, step] = reward
    assert refused(with_rewards(rounds, rewards), 1.0) == (
        f"person {rounds.people[1]!r}, round {number}, step {step}: the reward of action {action} "
        f"({get_domain('bomb_defusal').actions[action]}) is expected to be {expected}, found "
        f"{reward:g}; 1 of {int(rounds.mask.sum())} steps have impossible rewards"
    )


@pytest.mark.parametrize(("by", "word"), [(1, "after"), (-1, "before")])
def test_rewards_shifted_by_a_step_are_recognized(by, word):
    rounds = recorded("bomb_defusal_unlabelled_diverse")
    shifted = torch.roll(rounds.rewards.nan_to_num(-1.0), by, -1)
    message = refused(with_rewards(rounds, shifted))
    assert message.endswith(
        f"fit with the reward of the step {word}: the rewards look shifted by one step"
    )


def test_rewards_of_a_laboratory_are_accepted_where_inference_does_not_read_them():
    rounds = recorded("driving_fog_paper")
    assert check_world(with_rewards(rounds, torch.full(rounds.actions.shape, 7.0))).share == 0
    bomb = replace(recorded("bomb_defusal_labelled_paper"), rewards=None)
    assert check_world(bomb).share == 0


def test_a_share_of_contradictions_may_be_allowed():
    rounds = noisy()
    assert int(rounds.mask.sum()) == 150
    assert "2 of 150 steps (1.3%) contradict the next observation, 1% may" in refused(rounds, 0.01)
    found = check_world(rounds, 0.02)
    assert found.share == pytest.approx(2 / 150)
    assert set(found.contradicting.values()) == {1}


def test_fits_refuse_contradictions_and_count_those_allowed(tmp_path, capsys):
    save_demonstrations(tmp_path / "noisy.nc", noisy())
    out = tmp_path / "out"
    args = ("--demos", tmp_path / "noisy.nc", "--out", out, "--draws", 5, "--explore", 0)
    args += ("--human-model", "one-radius")  # which is quick
    assert command(fit, *args) == 2
    assert "round 0, step 0: after action" in capsys.readouterr().err
    assert not out.exists()
    assert command(fit, *args, "--allow-contradictions", "2%") == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["contradictions"] == {
        "steps": 150,
        "contradicting": 2,
        "by_person": {"person-01": 1, "person-04": 1},
    }
    assert "2 of 150 steps contradict the next observation" in capsys.readouterr().out


@pytest.mark.parametrize("share", ["101%", "-1%", "nan", "x"])
def test_what_is_no_share_is_refused(tmp_path, capsys, share):
    assert command(fit, "--out", tmp_path / "out", f"--allow-contradictions={share}") == 2
    assert "--allow-contradictions must be from 0% to 100%" in capsys.readouterr().err


def test_every_door_from_python_refuses_contradictions():
    human = HumanModel(load_self_model(shipped_weights("driving"))[0])
    rounds = noisy()
    with pytest.raises(DemonstrationsError, match="contradict"):
        fit_people(human, rounds)
    online = OnlinePosterior(human)
    with pytest.raises(DemonstrationsError, match="contradict"):
        online.add(rounds.select_people([0]))
    assert online.rounds == 0
    OnlinePosterior(human, allow_contradictions=0.02).add(rounds.select_people([0]))
    with pytest.raises(MirrorError, match="allow_contradictions must be from 0 to 1"):
        OnlinePosterior(human, allow_contradictions=2)


@pytest.mark.parametrize("domain", ["driving", "search_rescue", "bomb_defusal"])
def test_rounds_with_messages_never_contradict(domain, seed):
    rounds = simulate(domain, people=2, rounds=2, seed=seed, told=0.2)
    assert not sum(check_world(rounds).contradicting.values())
