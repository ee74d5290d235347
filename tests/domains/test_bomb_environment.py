"""Bomb defusal's Gymnasium face: Gymnasium's own checks, and parity with the domain."""

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import check_env, data_equivalence

import mirror_ppl  # noqa: F401  registers the environment
from mirror_ppl.domains.bomb_defusal import BombDefusal
from mirror_ppl.errors import UnknownNameError

NAME = "mirror_ppl/BombDefusal-v0"
WORLD = BombDefusal()
WAIT = 0


@pytest.mark.parametrize("setting", WORLD.settings)
def test_gymnasium_s_checker_has_nothing_to_say(setting):
    env = gymnasium.make(NAME, setting=setting)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_twins_with_one_seed_play_alike(seed, rng):
    first, second = (gymnasium.make(NAME, setting="unlabelled") for _ in range(2))
    for number in (seed, None):
        actions = [0, 0, *rng.integers(1, 5, size=2)]
        one, other = (
            [env.reset(seed=number), *(env.step(action) for action in actions)]
            for env in (first, second)
        )
        assert data_equivalence(one, other)


@pytest.mark.parametrize("setting", WORLD.settings)
def test_rounds_are_those_of_the_domain(setting, rng):
    env = gymnasium.make(NAME, setting=setting)
    _, info = env.reset(seed=5)
    state = type(WORLD.initial(1, torch.Generator()))(
        **{name: torch.as_tensor(value) for name, value in info["state"].items()}
    )
    for action in (WAIT, 2, WAIT, WAIT, 4, 1):
        chosen = torch.tensor(action)
        following = WORLD.transition(state, chosen)
        terms = WORLD.rewards(state, chosen, following)
        observation, reward, terminated, truncated, info = env.step(action)
        everything = WORLD.observe(following)
        for name, mask in WORLD.visibility(setting, everything).items():
            shown = torch.where(mask[..., None], everything[name], 0.0)
            np.testing.assert_array_equal(observation[name], shown.numpy())
            np.testing.assert_array_equal(observation[f"{name}_mask"], mask.numpy())
        np.testing.assert_array_equal(observation["ego"], everything["ego"].numpy())
        assert reward == pytest.approx(sum(float(value) for value in terms.values()))
        assert info["rewards"] == {n: pytest.approx(float(v)) for n, v in terms.items()}
        assert (terminated, truncated) == (int(following.stage) == 3, False)
        state = following
    with pytest.raises(ResetNeeded):
        env.unwrapped.step(WAIT)


def test_a_round_is_cut_off_after_its_steps():
    env = gymnasium.make(NAME, scenario="Type B bomb")
    _, info = env.reset(seed=0)
    assert info["state"]["kind"] == 1
    ends = [env.step(WAIT)[2:4] for _ in range(WORLD.horizon)]
    assert ends == [(False, False)] * 59 + [(False, True)]


def test_what_cannot_be_is_refused():
    with pytest.raises(UnknownNameError, match="known: labelled, unlabelled"):
        gymnasium.make(NAME, setting="clear")
    with pytest.raises(UnknownNameError, match='unknown scenario "Type C bomb"'):
        gymnasium.make(NAME, scenario="Type C bomb")
    env = gymnasium.make(NAME, render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    with pytest.raises(InvalidAction, match=r"Discrete\(5\)"):
        env.step(5)
    assert env.render().dtype == np.uint8
