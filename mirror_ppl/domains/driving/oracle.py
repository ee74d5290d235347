"""The oracle: optimal messages to a person who is known exactly, in a known world.

If the person and the world are known exactly, the choice of messages is a Markov decision process:
its state is the world and the person's knowledge, its actions are messages, and its transitions are
random through the person's actions. It is solved exactly, by backward induction over every state
that can be reached under any messages. Its expected return is an upper bound for communicators that
have to infer the person.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.communication.messages import Channels, every_message
from mirror_ppl.domains.base import Observation, map_state, total_reward
from mirror_ppl.domains.driving.cars import DrivingState
from mirror_ppl.domains.driving.people import Memory, SimulatedDrivers, remember
from mirror_ppl.domains.driving.world import Driving
from mirror_ppl.row_hashing import distinct_rows

CHUNK = 2000
"""Number of the person's decisions that are computed at once; bounds memory."""


@dataclass(frozen=True)
class _Step:
    """All choices and outcomes at one step of R rounds.

    Attributes:
        state: index of the state of each choice ``[N]``; a choice is a state with a message.
        message: flags ``[N, items]``.
        outcome: index of the outcome of each choice ``[N]``, the person's knowledge after it.
        probability: of actions ``[outcomes, A]``.
        reward: of actions ``[outcomes, A]``.
        following: state at the next step ``[outcomes, A]``.
        states: number of states.
    """

    state: Tensor
    message: Tensor
    outcome: Tensor
    probability: Tensor
    reward: Tensor
    following: Tensor
    states: int


class Oracle:
    """The best messages for one driver in given rounds.

    Args:
        driver: one person.
        start: states ``[R]`` in which the rounds begin.

    Attributes:
        value: expected return of each round, net of costs of messages, ``[R]``.
    """

    def __init__(self, driver: SimulatedDrivers, start: DrivingState) -> None:
        self._steps = _everything(driver, start)
        value = torch.zeros(int(self._steps[-1].following.max()) + 1)
        self._best: list[Tensor] = []
        self._lost: list[Tensor] = []
        channels = Channels(Driving())
        for step in reversed(self._steps):
            chance = (step.probability * (step.reward + value[step.following])).sum(-1)
            worth = chance[step.outcome] - channels.cost(step.message)
            value = torch.full((step.states,), -torch.inf)
            value = value.scatter_reduce(0, step.state, worth, "amax")
            self._lost.append(value[step.state] - worth)
            # Choices of a state are in the order of messages, silence first: it wins ties.
            number = torch.arange(len(worth))
            good = worth >= value[step.state] - 1e-6
            first = torch.full((step.states,), len(worth))
            self._best.append(first.scatter_reduce(0, step.state[good], number[good], "amin"))
        self._best.reverse()
        self._lost.reverse()
        self.value = value

    def messages(self, actions: Tensor) -> Tensor:
        """Return flags ``[R, items]`` of the best messages after ``actions`` ``[R, t]``.

        The oracle's own messages have to have been sent at all earlier steps.
        """
        state = torch.arange(len(actions))
        for time, action in enumerate(actions.unbind(1)):
            step = self._steps[time]
            outcome = step.outcome[self._best[time][state]]
            state = step.following[outcome, action]
        time = actions.shape[1]
        return self._steps[time].message[self._best[time][state]]

    def losses(self, flags: Tensor, actions: Tensor) -> Tensor:
        """Return the loss of each of a communicator's messages, ``[R, T]``.

        The loss is the expected net reward of the rest of the round with the best message now,
        minus that with the given one, each followed by the best messages. The losses of a round
        add up to its expected total loss.

        Args:
            flags: messages ``[R, T, items]``, each of them allowed.
            actions: the person's action after each, ``[R, T]``.
        """
        state = torch.arange(len(actions))
        places = 2 ** torch.arange(flags.shape[-1])
        lost = []
        for time, (said, action) in enumerate(zip(flags.unbind(1), actions.unbind(1), strict=True)):
            step = self._steps[time]
            names = step.state * 2 ** len(places) + (step.message * places).sum(-1)
            order = names.argsort()
            wanted = state * 2 ** len(places) + (said * places).sum(-1)
            choice = order[torch.searchsorted(names[order], wanted)]
            lost.append(self._lost[time][choice])
            state = step.following[step.outcome[choice], action]
        return torch.stack(lost, 1)


def _everything(driver: SimulatedDrivers, start: DrivingState) -> list[_Step]:
    domain = Driving()
    channels = Channels(domain)
    messages = every_message(torch.ones(len(channels), dtype=torch.bool))
    reach = driver.reach[0]
    world, rounds = start, torch.arange(len(start.lane))
    lane, memory = start.lane, Memory.empty((len(start.lane),))
    steps = []
    for _ in range(domain.horizon):
        here = _at(world, rounds, lane)
        observation = domain.observe(here)
        allowed = channels.join(domain.communicable(observation))
        state, number = (messages <= allowed[:, None]).all(-1).nonzero(as_tuple=True)
        message = messages[number]
        seen: Observation = {name: value[state] for name, value in observation.items()}
        sight = driver.sees({name: value[None] for name, value in observation.items()})["visual"][0]
        known = remember(
            _memory(memory, state),
            seen,
            sight[state],
            channels.split(message),
            reach.expand(len(state), -1),
        ).canonical()
        place = torch.stack([rounds[state], lane[state]], -1)
        first, outcome = distinct_rows(torch.cat([place, known.rows()], -1))
        known, place = _memory(known, first), place[first]
        probability = _choices(driver, known, place[:, 1])
        own = _at(world, *place.T)
        rewards, lanes = [], []
        for action in range(len(domain.actions)):
            done = torch.full_like(place[:, 1], action)
            following = domain.transition(own, done)
            rewards.append(total_reward(domain.rewards(own, done, following)))
            lanes.append(following.lane)
        lanes = torch.stack(lanes, 1)
        after = torch.arange(len(first)).repeat_interleave(len(domain.actions))
        next_place = torch.stack([place[after, 0], lanes.flatten()], -1)
        kept, following = distinct_rows(torch.cat([next_place, _memory(known, after).rows()], -1))
        steps.append(
            _Step(
                state,
                message,
                outcome,
                probability,
                torch.stack(rewards, 1),
                following.view(-1, len(domain.actions)),
                len(rounds),
            )
        )
        world = _moved(domain, world)
        rounds, lane = next_place[kept].T
        memory = _memory(known, after[kept])
    return steps


def _at(world: DrivingState, rounds: Tensor, lane: Tensor) -> DrivingState:
    """Return the states of some rounds with the ego in given lanes."""
    return DrivingState(lane, world.position[rounds], world.speed[rounds])


def _moved(domain: Driving, world: DrivingState) -> DrivingState:
    return domain.transition(world, torch.zeros_like(world.lane))


def _memory(memory: Memory, rows: Tensor) -> Memory:
    return map_state(lambda part: part[rows], memory)


def _choices(driver: SimulatedDrivers, known: Memory, lane: Tensor) -> Tensor:
    """Return action probabilities ``[M, A]``, computed once for equal knowledge."""
    first, which = distinct_rows(torch.cat([lane[:, None], known.rows()], -1))
    parts = [
        (driver.consistency * driver.values(_memory(known, rows), lane[rows])).softmax(-1)
        for rows in first.split(CHUNK)
    ]
    return torch.cat(parts)[which]
