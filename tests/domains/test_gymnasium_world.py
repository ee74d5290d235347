"""Gymnasium environments as worlds: tables that are the environment, and what is refused."""

import inspect
import pickle
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from paths import ROOT

from mirror_ppl.domains import Modality, add_domain
from mirror_ppl.domains.checking import faults_of
from mirror_ppl.domains.gymnasium_world import GymnasiumWorld, Place
from mirror_ppl.domains.registry import load_world
from mirror_ppl.errors import DomainError, InputError, UnknownNameError
from mirror_ppl.workers import run_tasks

UNLOCKING = f"{ROOT / 'docs' / 'examples' / 'unlocking.py'}:Unlocking"


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


class Row(gym.Env):
    """A row of five places; the prize is at one end of it."""

    observation_space = gym.spaces.Discrete(5)
    action_space = gym.spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.prize = 2, int(self.np_random.integers(2)) * 4
        self.taken = 0
        return self.place, {}

    def step(self, action):
        self.taken += 1
        self.place = min(max(self.place + (-1, 0, 1)[action], 0), 4)
        end = self.place == self.prize
        return self.place, 3.0 * end - 0.1, end, False, {}


class Shelf(GymnasiumWorld):
    modalities = (Modality("visual", ("prize",), ("offset",), ("places",), (4.0,), 0.01),)
    ego_features = ("place",)
    actions = ("left", "wait", "right")
    horizon = 6
    positions = ("offset",)
    layouts = 8

    def make(self):
        return Row()

    def look(self, env):
        return {"ego": [env.place], "visual": [[env.prize - env.place]]}


def test_one_observation_without_a_batch_is_one_state():
    world = type("Few", (type(load_world(UNLOCKING)),), {"layouts": 1})()
    place = world.initial(1, torch.Generator().manual_seed(0))
    one = {name: value[0] for name, value in world.observe(place).items()}
    assert int(world.state_behind(one).number) == int(place.number)
    following = world.next_observation(one, torch.tensor(2))
    assert {n: v.shape for n, v in following.items()} == {n: v.shape for n, v in one.items()}


def test_every_state_is_visited_once():
    shelf = Shelf()
    assert faults_of(shelf) == []
    # Five places with the prize at either end; rounds begin in the middle.
    assert len(shelf.tables.over) == 10
    assert int(shelf.tables.over.sum()) == int(shelf.tables.begins.sum()) == 2
    assert shelf.observe(shelf.initial(50, torch.Generator().manual_seed(0)))["ego"].eq(2).all()


def test_values_are_exact():
    shelf = Shelf()
    state = shelf.state_behind({"ego": torch.tensor([[2.0]]), "visual": torch.tensor([[[2.0]]])})
    # Two steps to the prize: .9 goes to 2.9 one step later; others lose steps.
    assert shelf.reference_values(state, 0.5).tolist()[0] == pytest.approx(
        [-0.1 + 0.5 * (-0.1 + 0.5 * 1.35), -0.1 + 0.5 * 1.35, 1.35]
    )
    tables, reward = shelf.tables, sum(shelf.tables.terms.values())
    values = shelf.reference_values(Place(torch.arange(10)), 0.9)
    after = values.amax(-1).masked_fill(tables.over, 0.0)[tables.following]
    assert torch.allclose(values, reward + 0.9 * after, atol=1e-5)


class Free(Row):
    """Waiting costs nothing, and nor does going."""

    def step(self, action):
        place, reward, *rest = super().step(action)
        return place, reward + 0.1, *rest


def test_an_item_is_relevant_where_another_value_would_change_what_is_best():
    """The prize decides everywhere but where all is done; its end of the row alone is in view."""
    world = Shelf()
    where = world.tables.observation
    told = world.relevance(where)["decisive"]["visual"][:, 0]
    # One cannot be at the prize with another prize and go on: two states differ, where not over.
    assert torch.equal(told, ~world.tables.over & (where["ego"][:, 0] % 4 != 0))
    one = {name: value[0] for name, value in where.items()}
    assert world.relevance(one)["decisive"]["visual"].shape == (1,)


def test_in_two_rooms_the_key_matters_only_where_the_door_is_in_the_way():
    world = type("Fewer", (type(load_world(UNLOCKING)),), {"layouts": 40})()
    tables, column = world.tables, world.tables.observation["ego"][:, 1]
    key, goal = world.relevance(tables.observation)["decisive"]["visual"].unbind(-1)
    beyond = world.distance(tables.observation)[0][:, 1] == 1
    taken = tables.observation["ego"][:, 3] == 1
    left = (column < 4) & ~tables.over
    # With the goal at hand a key is at most in the way.
    assert key[left & ~beyond].float().mean() < 0.1
    assert not key[taken & left].any(), "the key is in their hands"
    # Of most states there is one with the key elsewhere; 40 layouts do not have them all.
    assert key[left & beyond & ~taken].float().mean() > 0.3
    assert goal[left].float().mean() > 0.5


def test_who_may_wait_for_nothing_still_goes():
    world = type("Idle", (Shelf,), {"make": lambda self: Free()})()
    place = world.initial(20, torch.Generator().manual_seed(0))
    earned = 0.0
    for _ in range(world.horizon):
        action = world.reference_values(place, 1.0).argmax(-1)
        following = world.transition(place, action)
        earned += sum(world.rewards(place, action, following).values())
        place = following
    assert torch.allclose(earned, torch.tensor(3.0), atol=1e-3)


def unknown(*args):
    raise OSError


def test_tables_are_kept_for_the_next_time(tmp_path):
    first = Shelf().tables
    (file,) = (tmp_path / "mirror_ppl").iterdir()
    made = file.stat().st_mtime_ns
    assert torch.equal(Shelf().tables.following, first.following)
    assert file.stat().st_mtime_ns == made
    sent = pickle.loads(pickle.dumps(Shelf()))
    assert "tables" not in vars(sent)
    with pytest.MonkeyPatch.context() as patch:
        # Another process has neither the source of a class that was sent by value, nor its module.
        patch.setattr("inspect.getsource", unknown)
        patch.setattr(Shelf, "make", unknown)
        assert torch.equal(sent.tables.following, first.following)
    file.write_bytes(b"damaged")
    assert torch.equal(Shelf().tables.following, first.following)
    assert file.stat().st_size > 100


def test_the_nearest_state_stands_for_what_cannot_be():
    shelf = Shelf()
    decoded = {"ego": torch.tensor([[1.9]]), "visual": torch.tensor([[[2.2]]])}
    near = shelf.nearest(decoded)
    assert near["ego"].tolist() == [[2.0]]
    assert near["visual"].tolist() == [[[2.0]]]
    assert shelf.state_behind(decoded).number == shelf.state_behind(near).number


class Hidden(Row):
    """The way is barred every third time."""

    def step(self, action):
        return super().step(1 if self.taken % 3 == 2 else action)


class Late(Row):
    """The prize is worth less the later it is reached."""

    def step(self, action):
        place, reward, *rest = super().step(action)
        return place, reward - 0.05 * self.taken, *rest


class Walled(Row):
    """There is a wall in some layouts, which cannot be observed."""

    def reset(self, *, seed=None, options=None):
        found = super().reset(seed=seed)
        self.wall = seed is not None and seed >= 4
        return found

    def step(self, action):
        return super().step(1 if self.wall and self.place == 2 else action)


class Steered(Row):
    action_space = gym.spaces.Box(-1.0, 1.0)


class Broken(Row):
    def step(self, action):
        raise RuntimeError("the motor is off")


class Chance(Row):
    def step(self, action):
        return super().step(int(self.np_random.integers(3)))


@pytest.mark.parametrize(
    ("env", "changes", "message"),
    [
        (Hidden, {}, "something that matters cannot be observed"),
        (Chance, {}, "something that matters cannot be observed"),
        (Late, {}, "something that matters cannot be observed"),
        (Walled, {}, "something that matters cannot be observed"),
        (Steered, {}, "expected actions that are numbered (Discrete), found Box"),
        (Broken, {}, "the motor is off"),
        (Row, {"most_states": 3}, "more than 3 states"),
        (Row, {"moves": (0, 1)}, "3 actions, but 2 moves"),
        (Row, {"moves": (0, 1, 3)}, "the environment has 3 actions, from 0 on, and no 3"),
    ],
)
def test_what_cannot_be_tabulated_is_refused(env, changes, message):
    kind = type("Other", (Shelf,), {"make": lambda self: env(), **changes})
    (fault,) = faults_of(kind())
    assert message in fault
    with pytest.raises((DomainError, RuntimeError)):
        _ = kind().tables


def test_minigrid_is_as_it_is_when_it_is_stepped():
    kind = type("Few", (type(load_world(UNLOCKING)),), {"layouts": 2})
    world = kind()
    chooser = np.random.default_rng(0)
    for seed in range(2):
        env = world.make()
        env.reset(seed=seed)
        seen = world.look(env)
        state = world.state_behind({n: torch.tensor(v).float()[None] for n, v in seen.items()})
        for _ in range(200):
            action = int(chooser.integers(len(world.actions)))
            _, reward, terminated, _, _ = env.step(world.moves[action])
            following = world.transition(state, torch.tensor([action]))
            terms = world.rewards(state, torch.tensor([action]), following)
            wanted = world.terms(env, action, float(reward), terminated)
            assert {n: float(v) for n, v in terms.items()} == pytest.approx(wanted)
            for name, value in world.look(env).items():
                assert torch.equal(world.observe(following)[name][0], torch.tensor(value).float())
            assert bool(world.over(following)) == terminated
            if terminated:
                break
            state = following


def test_what_is_played_is_recorded(tmp_path):
    from mirror_ppl.data import load_demonstrations, save_demonstrations
    from mirror_ppl.data.recorder import Recorder

    shelf = add_domain(Shelf)
    env = Recorder(Row(), shelf, person="ada")
    with pytest.raises(InputError, match="no round was played"):
        env.recordings()
    with pytest.raises(InputError, match="call reset"):
        env.step(0)
    env.reset()
    env.reset(seed=3)
    toward = 0 if env.env.prize == 0 else 2
    env.tell("visual", "prize")
    env.step(1)
    env.step(toward)
    assert env.step(toward)[2]
    with pytest.raises(InputError, match="the round is over"):
        env.step(0)
    env.person = "ben"
    for _ in range(2):
        env.reset(seed=4)
        for step in range(6):
            assert env.step(1)[3] == (step == 5)
    with pytest.raises(UnknownNameError, match='unknown item "pot"'):
        env.tell("visual", "pot")
    env.reset()
    with pytest.raises(InputError, match="has to be one of"):
        env.step(7)
    save_demonstrations(tmp_path / "played.nc", env.recordings())
    played = load_demonstrations(tmp_path / "played.nc")
    assert played.people == ("ada", "ben")
    assert played.round_counts.tolist() == [1, 2]
    assert played.lengths.tolist() == [[3, 0], [6, 6]]
    assert played.actions[0, 0, :3].tolist() == [1, toward, toward]
    assert played.told["visual"][0, 0, :, 0].tolist() == [True, False, False, False, False, False]
    # What follows from each action is what was recorded.
    shelf_now = {n: v[1, 0, :-1] for n, v in played.observation().items()}
    following = shelf.next_observation(shelf_now, played.actions[1, 0])
    assert torch.equal(following["visual"], played.observation()["visual"][1, 0, 1:])


def test_only_worlds_of_environments_are_recorded_so():
    from mirror_ppl.data.recorder import Recorder
    from mirror_ppl.domains import get_domain

    with pytest.raises(InputError, match="GymnasiumWorld"):
        Recorder(Row(), get_domain("driving"))


def number_of_states(name):
    """What another process finds of a world: how many states, and whether it has its class."""
    from mirror_ppl.domains import get_domain
    from mirror_ppl.domains.registry import code_of

    return len(get_domain(name).tables.over), len(code_of(get_domain(name)))


def test_other_processes_read_the_tables_of_a_users_file(tmp_path):
    file = tmp_path / "shelf.py"
    imports = (
        "import gymnasium as gym\nfrom mirror_ppl.domains import Modality\n"
        "from mirror_ppl.domains.gymnasium_world import GymnasiumWorld\n\n\n"
    )
    file.write_text(imports + "\n\n".join(map(inspect.getsource, (Row, Shelf))))
    world = add_domain(f"{file}:Shelf")
    tasks = [partial(number_of_states, "shelf")] * 2
    assert list(run_tasks(tasks, 2)) == [(len(world.tables.over), 64)] * 2
