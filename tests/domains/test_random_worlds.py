"""Worlds in which something happens by chance: seeds of states, futures of plans."""

import pickle
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import torch
from stepped_worlds import Way, Windy

from mirror_ppl.communication import Communicator, ExpectedUtility, Person
from mirror_ppl.communication.objectives import Valued
from mirror_ppl.communication.planners import PlannerOptions
from mirror_ppl.communication.rollouts import SimulatorWorld
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.domains import Modality, add_domain
from mirror_ppl.domains.checking import faults_of
from mirror_ppl.domains.gymnasium_world import GymnasiumWorld
from mirror_ppl.domains.stepped_world import SteppedWorld
from mirror_ppl.evaluation.assistance import Listener, speaker
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.sizes import Sizes
from mirror_ppl.models.variants import PerceptualOnly


def test_chance_is_drawn_from_the_seed_of_the_state():
    windy, number = Windy(), 3000
    state = windy.initial(number, torch.Generator().manual_seed(0))
    state = windy.state_behind(
        {n: p[:1].expand(number, *p.shape[1:]) for n, p in windy.observe(state).items()}
    )
    assert not bool(state.seed.diff().any())
    assert bool(windy.next_observation(windy.observe(state), state.seed * 0)["ego"].isnan().all())
    state = windy.redrawn(state, torch.Generator().manual_seed(0))
    go = torch.ones(number, dtype=torch.long)
    following = windy.transition(state, go)
    farther = (windy.observe(following)["ego"] - windy.observe(state)["ego"]).squeeze(-1)
    # Shares of 1, 2 and 3 steps are a third each, within four standard errors.
    shares = torch.stack([(farther == steps).float().mean() for steps in (1, 2, 3)])
    assert (shares - 1 / 3).abs().max() < 4 * (2 / 9 / number) ** 0.5
    assert torch.equal(windy.transition(state, go).values, following.values)
    # The second step is independent of the first: correlations are within four standard errors.
    later = windy.transition(following, go)
    again = (windy.observe(later)["ego"] - windy.observe(following)["ego"]).squeeze(-1)
    goes_on = ~windy.over(following)
    pair = torch.stack([farther[goes_on], again[goes_on]])
    assert abs(float(torch.corrcoef(pair)[0, 1])) < 4 / int(goes_on.sum()) ** 0.5


def test_what_happens_by_chance_is_predicted_in_several_futures():
    windy = Windy()
    start = windy.observe(windy.initial(1, torch.Generator().manual_seed(1)))
    past = RoundSoFar(start, [], {"visual": torch.zeros(0, 1, dtype=torch.bool)})
    simulator = SimulatorWorld(windy)
    rollouts = simulator.rollouts(past, 2, torch.Generator().manual_seed(0))
    path = rollouts.follow(0, torch.arange(8), torch.ones(8, dtype=torch.long))
    places = rollouts.observation(1)["ego"][0, path, 0]
    assert simulator.draws == 8 and len(places.unique()) > 1
    assert SimulatorWorld(Way()).draws == 1


class Coin(gym.Env):
    """Who goes wins or loses a thousand."""

    observation_space = gym.spaces.Box(0, 1, (1,))
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.bright = int(self.np_random.integers(2))
        return np.array([self.bright]), {}

    def step(self, action):
        won = 1000 * (2 * self.np_random.integers(2) - 1)
        return np.array([self.bright]), float(action * won), False, False, {}


class Toss(SteppedWorld):
    random = True
    modalities = (Modality("visual", ("lamp",), ("bright",), ("",), (1.0,), 0.01),)
    ego_features = ("nothing",)
    actions = ("stay", "go")
    horizon = 2

    def make(self):
        return Coin()

    def look(self, env):
        return {"ego": [0.0], "visual": [[env.bright]]}

    def restore(self, env, observation):
        env.bright = int(observation["visual"][0, 0])


def test_chance_that_draws_share_counts_once_in_standard_errors(seed):
    """Gains by chance are as large as standard errors say, though 200 draws share 8 futures."""
    toss = add_domain(Toss)
    torch.manual_seed(seed)
    human = PerceptualOnly(SelfModel(toss, Sizes()).eval())
    values = {"sight_around": 0, "consistency": 5.0, "lapse": 0.01}
    draws = {name: torch.full((200, 1, 1), value) for name, value in values.items()}
    person = Person(human, draws)
    start = toss.observe(toss.initial(1, torch.Generator().manual_seed(0)))
    past = RoundSoFar(start, [], {"visual": torch.zeros(0, 1, dtype=torch.bool)})
    objective, errors, gains = ExpectedUtility(SimulatorWorld(toss), 1), [], []
    for number in range(100):
        found = Communicator(person, objective, seed=number).plan(past).alternatives
        errors.append(found["standard_error"].max())
        gains.append(found["gain"][found["message"] != "silence"].iloc[0])
    # The mean squared error of gains is the mean squared standard error, within 4 errors of 100.
    claimed, actual = np.square(errors).mean(), np.square(gains).mean()
    assert abs(actual / claimed - 1) < 4 * (2 / 100 + 2 / 7 / 100) ** 0.5


def test_each_round_has_imagined_futures_of_its_own():
    """The same in a round that is planned again."""
    toss = add_domain(Toss)
    human, seeds = PerceptualOnly(SelfModel(toss, Sizes()).eval()), []

    class Spy(ExpectedUtility):
        def at(self, context, steps_left, seed):
            seeds.append(seed)
            return super().at(context, steps_left, seed)

    values = {"sight_around": 0, "consistency": 5.0, "lapse": 0.01}
    person = Person(human, {name: torch.full((9, 1, 1), value) for name, value in values.items()})
    planner = Communicator(person, Spy(SimulatorWorld(toss), 1))
    for bright in (0.0, 1.0, 1.0):
        start = {"ego": torch.zeros(1, 1), "visual": torch.full((1, 1, 1), bright)}
        planner.plan(RoundSoFar(start, [], {"visual": torch.zeros(0, 1, dtype=torch.bool)}))
    assert seeds[0] != seeds[1] == seeds[2] and 0 <= min(seeds) <= max(seeds) < 2**62


def test_the_oracle_of_a_random_world_has_a_draw_for_each_future():
    toss = add_domain(Toss)
    human = PerceptualOnly(SelfModel(toss, Sizes()).eval())
    values = {"sight_around": 0, "consistency": 5.0, "lapse": 0.01}
    truth = {name: torch.full((1, 1, 1), value) for name, value in values.items()}
    driver = SimpleNamespace(modelled=lambda: (human, truth))
    say = speaker("oracle", Listener(toss, "everyday", driver, None), PlannerOptions(), 0)
    assert say.planner.person.number == SimulatorWorld(toss).draws == 8


def test_means_by_draw_of_the_world_are_independent():
    valued = Valued(torch.zeros(1, 5), None, worlds=2)
    gain = torch.tensor([1.0, 10.0, 3.0, 20.0, 5.0])
    assert valued.independent(gain).tolist() == [3.0, 15.0]
    assert Valued(torch.zeros(1, 5), None, worlds=5).independent(gain) is gain
    assert Valued(torch.zeros(1, 5), None).independent(gain) is gain


def test_random_worlds_are_the_same_in_other_processes():
    windy, go = Windy(), torch.ones(9, dtype=torch.long)
    again, state = (
        pickle.loads(pickle.dumps(windy)),
        windy.initial(9, torch.Generator().manual_seed(0)),
    )
    assert torch.equal(again.transition(state, go).values, windy.transition(state, go).values)


def test_tables_have_no_chance():
    kind = type("Tabled", (GymnasiumWorld,), {**vars(Way), "random": True, "layouts": 8})
    assert "a random world has to be a SteppedWorld" in faults_of(kind())[0]
