"""Search and rescue's Gymnasium face: Gymnasium's own checks, and parity with the domain."""

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import check_env, data_equivalence

import mirror_ppl  # noqa: F401  registers the environment
from mirror_ppl.domains.base import total_reward
from mirror_ppl.domains.search_rescue import SearchRescue
from mirror_ppl.errors import UnknownNameError

NAME = "mirror_ppl/SearchRescue-v0"
WORLD = SearchRescue()
UP, DOWN, LEFT, RIGHT = range(4)
THERE = [UP, UP, LEFT, LEFT, LEFT, UP, UP, UP, UP, UP]
"""From the entrance through the left corridor to the victim at the top left."""
BACK = [DOWN] * 5 + [RIGHT] * 3 + [DOWN] * 2


@pytest.mark.parametrize("setting", WORLD.settings)
def test_gymnasium_s_checker_has_nothing_to_say(setting):
    env = gymnasium.make(NAME, setting=setting)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_twins_with_one_seed_play_alike(seed, rng):
    first, second = (gymnasium.make(NAME, setting="smoke") for _ in range(2))
    for number in (seed, None):
        actions = rng.integers(4, size=20)
        one, other = (
            [env.reset(seed=number), *(env.step(action) for action in actions)]
            for env in (first, second)
        )
        assert data_equivalence(one, other)


@pytest.mark.parametrize("setting", WORLD.settings)
def test_rounds_are_those_of_the_domain(setting, rng):
    env = gymnasium.make(NAME, setting=setting)
    observation, info = env.reset(seed=5)
    number = torch.tensor([WORLD.scenarios.index(info["scenario"])])
    state = WORLD.initial(1, torch.Generator(), number)
    for action in rng.integers(4, size=30):
        everything = WORLD.observe(state)
        masks = WORLD.visibility(setting, everything)
        for name, mask in masks.items():
            shown = torch.where(mask[..., None], everything[name], 0.0)[0]
            np.testing.assert_array_equal(observation[name], shown.numpy())
            np.testing.assert_array_equal(observation[f"{name}_mask"], mask[0].numpy())
        np.testing.assert_array_equal(observation["ego"], everything["ego"][0].numpy())
        chosen = torch.tensor([int(action)])
        following = WORLD.transition(state, chosen)
        terms = WORLD.rewards(state, chosen, following)
        observation, reward, _, _, info = env.step(action)
        assert reward == pytest.approx(float(total_reward(terms)))
        assert info["rewards"] == {n: pytest.approx(float(v)) for n, v in terms.items()}
        assert info["state"]["place"].tolist() == following.place[0].tolist()
        assert info["state"]["found"] == bool(following.found)
        state = following


def test_a_round_ends_with_the_victim_at_the_entrance():
    env = gymnasium.make(NAME, scenario="victim top-left, no corridor blocked")
    env.reset(seed=0)
    total = 0.0
    for number, action in enumerate(THERE + BACK):
        observation, reward, terminated, truncated, info = env.step(action)
        total += reward
        assert (terminated, truncated) == (number == 19, False)
        assert info["state"]["found"] == (number >= 9)
    assert total == pytest.approx(1 + 15 - 20 * 0.1)
    assert observation["ego"].tolist() == [8.0, 4.0, 1.0]
    with pytest.raises(ResetNeeded):
        env.unwrapped.step(UP)


def test_a_round_is_cut_off_after_its_steps():
    env = gymnasium.make(NAME)
    env.reset(seed=0)
    ends = [env.step(DOWN)[2:4] for _ in range(WORLD.horizon)]
    assert ends == [(False, False)] * 47 + [(False, True)]
    with pytest.raises(ResetNeeded):
        env.unwrapped.step(UP)


def test_what_cannot_be_is_refused():
    with pytest.raises(
        UnknownNameError, match='unknown setting "fog" in search_rescue; known: clear, smoke'
    ):
        gymnasium.make(NAME, setting="fog")
    with pytest.raises(UnknownNameError, match='unknown scenario "victim"'):
        gymnasium.make(NAME, scenario="victim")
    env = gymnasium.make(NAME, render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    with pytest.raises(InvalidAction, match=r"Discrete\(4\)"):
        env.step(4)
    picture = env.render()
    assert picture.shape == (108, 108, 3) and picture.dtype == np.uint8
