"""The highway as a Gymnasium environment on highway-env: Gymnasium's checks, ends, and parity."""

import copy
import re
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
import torch

pytest.importorskip("highway_env", reason="highway-env is not installed (mirror_ppl[highway])")

from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import check_env, data_equivalence
from paths import DOCS

from mirror_ppl.data import load_demonstrations
from mirror_ppl.data.contradictions import check_world
from mirror_ppl.domains.highway import DirectHighway, HighwayState
from mirror_ppl.domains.highway.environment import HighwayEnv
from mirror_ppl.domains.highway.lidar import RANGE
from mirror_ppl.domains.highway.road import TICKS
from mirror_ppl.errors import UnknownNameError

NAME = "mirror_ppl/Highway-v0"
STILL = np.zeros(2, np.float32)
RIGHT, BRAKE = np.array([1, 0], np.float32), np.array([0, -1], np.float32)


def play(env, actions, seed=None):
    """Everything that reset and the steps of a round return."""
    return [env.reset(seed=seed), *(env.step(action) for action in actions)]


def as_state(parts):
    return HighwayState(**{name: torch.as_tensor(part) for name, part in parts.items()})


# --- Gymnasium's contract -----------------------------------------------------------------------


@pytest.mark.parametrize("setting", DirectHighway.settings)
def test_gymnasium_s_checker_has_nothing_to_say(setting):
    env = gymnasium.make(NAME, setting=setting, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


WITHOUT_AND_WITH = f"""
import sys
sys.modules["highway_env"] = None
import gymnasium, torch
from mirror_ppl.domains.highway import DirectHighway
state = DirectHighway().initial(2, torch.Generator())
print(DirectHighway().transition(state, torch.zeros(2, 2)).tick.tolist())
try:
    gymnasium.make("{NAME}")
except ImportError as error:
    print(error)
del sys.modules["highway_env"]
print(gymnasium.make("{NAME}").reset(seed=1)[1]["scenario"] in DirectHighway.scenarios)
"""


def test_the_world_does_without_highway_env_and_the_environment_says_what_it_needs():
    command = [sys.executable, "-W", "error", "-c", WITHOUT_AND_WITH]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    ticks, missing, made = done.stdout.splitlines()
    assert (ticks, made) == (f"[{TICKS}, {TICKS}]", "True")
    assert missing == "the environment needs highway-env: pip install 'mirror_ppl[highway]'"


def test_twins_with_one_seed_play_alike(seed, rng):
    first, second = HighwayEnv("fog"), HighwayEnv("fog")
    for number in (seed, None):
        actions = (rng.uniform(-1, 1, (8, 2)) * [0.1, 1.0]).astype(np.float32)
        assert data_equivalence(play(first, actions, number), play(second, actions, number))


def test_seeds_and_rounds_differ():
    env = HighwayEnv()
    starts = [env.reset(seed=seed)[1] for seed in range(10)]
    env.reset(seed=0)
    starts += [env.reset()[1] for _ in range(10)]
    assert len({tuple(start["state"]["x"]) for start in starts}) == 20
    assert len({start["scenario"] for start in starts}) > 3


def test_a_copy_made_within_a_round_goes_on_alike():
    env = HighwayEnv("fog", render_mode="rgb_array")
    play(env, [STILL, BRAKE], seed=5)
    twin = copy.deepcopy(env)
    assert np.array_equal(env.render(), twin.render())
    for action in (STILL, RIGHT, BRAKE):
        assert data_equivalence(env.step(action), twin.step(action))
    assert data_equivalence(env.reset(), twin.reset())


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"setting": "snow"}, 'unknown setting "snow" in highway; known: clear, fog'),
        ({"scenario": "calm trafic"}, 'perhaps you meant "calm traffic"'),
        ({"render_mode": "human"}, 'unknown render mode "human"; known: rgb_array'),
    ],
)
def test_unknown_options_are_named(options, told):
    with pytest.raises(UnknownNameError, match=re.escape(told)):
        HighwayEnv(**options)


def test_steps_outside_a_round_and_other_actions_are_refused():
    env = HighwayEnv(render_mode="rgb_array")
    for call in (lambda: env.step(STILL), env.render):
        with pytest.raises(ResetNeeded):
            call()
    env.reset(seed=0)
    for action in (0, np.zeros(3), np.array([0.0, 1.1]), np.array([np.nan, 0.0]), "left"):
        with pytest.raises(InvalidAction, match="Box"):
            env.step(action)


# --- ends ---------------------------------------------------------------------------------------


def test_leaving_the_road_terminates():
    env = HighwayEnv(scenario="calm traffic")
    env.reset(seed=2)
    for count in range(1, 60):
        _, _, terminated, truncated, info = env.step(RIGHT if count < 20 else STILL)
        assert not truncated
        if terminated:
            break
        assert info["rewards"]["accident"] == 0
    assert terminated and info["rewards"]["accident"] == -100 and not info["state"]["crashed"]
    assert info["rewards"]["shoulder"] == -4
    assert info["state"]["y"][0] > 12
    with pytest.raises(ResetNeeded):
        env.step(STILL)


def test_a_collision_terminates():
    """Who speeds up behind a crawling car."""
    env = HighwayEnv("fog", scenario="car ahead crawls")
    env.reset(seed=1)
    for _ in range(env.domain.horizon):
        _, _, terminated, truncated, info = env.step(np.array([0, 0.2], np.float32))
        if terminated:
            break
    assert terminated and not truncated and info["state"]["crashed"]
    assert info["rewards"]["accident"] == -100
    with pytest.raises(ResetNeeded):
        env.step(STILL)


def test_a_round_is_truncated_after_120_steps():
    """Whoever keeps lane and speed in calm traffic, in the first round without a collision."""
    env = HighwayEnv(scenario="calm traffic")
    for seed in range(5):
        env.reset(seed=seed)
        ends = []
        for _ in range(env.domain.horizon):
            *_, terminated, truncated, info = env.step(STILL)
            ends.append((terminated, truncated))
            if terminated:
                break
        if not terminated:
            break
    assert ends == [(False, False)] * 119 + [(False, True)]
    assert info["state"]["tick"] == 120 * TICKS
    with pytest.raises(ResetNeeded):
        env.step(STILL)


# --- parity with the domain ---------------------------------------------------------------------


@pytest.mark.parametrize("setting", DirectHighway.settings)
def test_what_is_seen_is_the_domain_s(setting, rng):
    domain, env = DirectHighway(), HighwayEnv(setting)
    hidden = 0
    observed, info = env.reset(seed=7)
    for action in (rng.uniform(-1, 1, (10, 2)) * [0.1, 1.0]).astype(np.float32):
        now = as_state(info["state"])
        values = domain.observe(now)
        for name, mask in domain.visibility(setting, values).items():
            assert observed[f"{name}_mask"].tolist() == mask.int().tolist()
            shown = torch.where(mask[:, None], values[name], 0.0)
            assert np.array_equal(observed[name], shown.numpy())
            hidden += int((~mask).sum()) if name == "visual" else 0
        assert observed["ego"].tolist() == values["ego"].tolist()
        observed, reward, _, _, info = env.step(action)
        after = as_state(info["state"])
        terms = domain.rewards(now, torch.from_numpy(action), after)
        assert info["rewards"] == {name: term.item() + 0.0 for name, term in terms.items()}
        assert reward == pytest.approx(sum(info["rewards"].values()), abs=1e-4)
        # The domain's own physics leads there, too.
        expected = domain.transition(now, torch.from_numpy(action))
        for name in ("x", "y", "heading", "speed"):
            assert torch.allclose(getattr(expected, name), getattr(after, name), atol=1e-2), name
    assert (hidden > 0) == (setting == "fog")


def test_fog_hides_by_distance():
    """A crawling car far ahead is hidden in fog until it is 15 m away."""
    clear, fog = (HighwayEnv(s, scenario="car ahead crawls") for s in DirectHighway.settings)
    for env in (clear, fog):
        env.reset(seed=3)
    shown = []
    for _ in range(45):
        full, *_, over, _, _ = clear.step(STILL)
        seen, *_ = fog.step(STILL)
        if over:
            break
        distance = full["visual"][0, 0]
        assert full["visual_mask"].all()
        assert seen["visual_mask"][0] == (distance <= 15)
        assert seen["visual"][0, 0] == (distance if distance <= 15 else 0)
        shown.append(distance)
    assert min(shown) < 15 < max(shown) <= RANGE


@pytest.mark.parametrize("scenario", DirectHighway.scenarios)
def test_a_given_scenario_is_kept_in_every_round(scenario):
    env = HighwayEnv(scenario=scenario)
    assert {env.reset(seed=seed)[1]["scenario"] for seed in range(3)} == {scenario}


def test_what_is_returned_stays_the_user_s():
    env = HighwayEnv()
    observed, info = env.reset(seed=1)
    kept = copy.deepcopy((observed, info))
    env.step(RIGHT)
    assert data_equivalence((observed, info), kept)


def test_pictures():
    env = HighwayEnv("fog", render_mode="rgb_array")
    env.reset(seed=4)
    state = env.state
    assert np.array_equal(env.render(), DirectHighway().render(state, "fog"))
    assert not np.array_equal(env.render(), DirectHighway().render(state, "clear"))
    silent = HighwayEnv()
    silent.reset(seed=4)
    with pytest.warns(UserWarning, match="render_mode"):
        assert silent.render() is None


# --- documentation ------------------------------------------------------------------------------


def test_the_examples_of_the_page_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"^```python\n(.*?)^```", (DOCS / "highway.md").read_text(), re.M | re.S)
    assert len(blocks) == 3
    scope = {}
    for block in blocks:
        exec(compile(block, "highway.md", "exec"), scope)
    assert scope["seen"].shape == (3, 36) and scope["info"]["scenario"] in DirectHighway.scenarios
    ada = load_demonstrations("ada.nc")
    check_world(ada)
    assert ada.people == ("ada",) and ada.shape[:2] == (1, 2)


def test_the_page_has_every_scenario_and_term():
    page = (DOCS / "highway.md").read_text()
    rows = [line.split(" | ")[0].strip("| `") for line in page.splitlines() if line.startswith("|")]
    assert set(DirectHighway.scenarios) <= set(rows) and set(DirectHighway.reward_terms) <= set(
        rows
    )
