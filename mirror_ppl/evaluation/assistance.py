"""Pairings of communicators with people: how much messages help, at what cost.

Every communicator plays the same rounds with the same random numbers, so that differences between
them are due to their messages.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.communication import rules
from mirror_ppl.communication.communicator import Communicator
from mirror_ppl.communication.decision import Decision
from mirror_ppl.communication.hearing import HearingPerson
from mirror_ppl.communication.messages import Channels
from mirror_ppl.communication.person import Person
from mirror_ppl.communication.planners import PLANNERS, PlannerOptions, planner_of
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.domains.base import FUTURES, Domain, map_state
from mirror_ppl.errors import InputError, UnknownNameError
from mirror_ppl.evaluation.played import Played, Tally
from mirror_ppl.evaluation.reachable_oracle import ReachableOracle
from mirror_ppl.people import draw_starts, people_of
from mirror_ppl.people.base import SimulatedPeople, act
from mirror_ppl.people.recordings import Start
from mirror_ppl.randomness import derived_generator

COMMUNICATORS = (
    *PLANNERS,
    "none",
    "all",
    "random",
    "nearest",
    "oracle",
)
"""Communicators that can be paired with people, in the order in which they are shown."""
NO_ORACLE = (
    "there is an oracle only of people with thresholds of sight of their own (population diverse) "
    "and of people who follow a human model"
)
REFERENCES = ("none", "all", "nearest", "oracle")
"""Communicators that learn nothing of people, as references for those that do."""
RATES_FROM = "mirror"
"""Communicator whose rates of items ``random`` has."""


@dataclass(frozen=True)
class Truth:
    """Observed by an oracle alone: the true state of world and person.

    Attributes:
        step: the number of the step.
        state: of the world, ``[1, R]``.
        memory: of the person after the step before, ``[1, R]``.
    """

    step: int
    state: Any
    memory: Any


Say = Callable[[Sequence[RoundSoFar], Truth], tuple[Tensor, list[Decision] | None]]
"""Chooses messages in each of R rounds: flags ``[R, N]`` and, for planners, the decisions."""


@dataclass(frozen=True)
class Listener:
    """A person who receives messages, and their rounds.

    Attributes:
        domain: the world.
        setting: its setting.
        driver: the true person, P = 1.
        start: initial states of the rounds ``[1, R]``, and the noise of the person's choices.
        person: what was inferred of the person, if anything; planners need it.
        silent_because: a reason for which planners send no messages, see :class:`Communicator`.
    """

    domain: Domain
    setting: str
    driver: SimulatedPeople
    start: Start
    person: Person | None = None
    silent_because: str = ""

    def round(self, number: int) -> Listener:
        """Select one of the person's rounds."""
        return replace(self, start=self.start.round(number))


def listeners(
    everybody: SimulatedPeople, people: int, setting: str, rounds: int, seed: int
) -> list[Listener]:
    """Make listeners of simulated people; their rounds do not depend on the communicator.

    Args:
        everybody: the people.
        people: number of people.
        setting: of their world.
        rounds: number of rounds of each person.
        seed: of initial states and of all noise.
    """
    domain = everybody.domain
    starts = draw_starts(
        people, rounds, seed, "assist", setting, domain=domain, mind_noises=everybody.mind_noises
    )
    return [
        Listener(
            domain, setting, everybody.select([number]), starts.select(slice(number, number + 1))
        )
        for number in range(people)
    ]


def speaker(
    name: str,
    listener: Listener,
    options: PlannerOptions,
    seed: int,
    rates: Mapping[str, float] | None = None,
) -> Say:
    """Make the communicator for one person.

    Args:
        name: one of ``COMMUNICATORS``.
        listener: the person, and their rounds.
        options: settings of the planners.
        seed: of everything random.
        rates: for ``random``, the share of communicable items that it communicates, by modality.

    Raises:
        UnknownNameError: there is no such communicator.
    """
    domain = listener.domain
    if name == "oracle":
        return _oracle(listener, options, seed)
    if name in ("none", "all", "nearest", "random"):
        generator = derived_generator(seed, "random messages")
        rule = {
            "none": lambda past: rules.nothing(domain, past),
            "all": lambda past: rules.everything(domain, past),
            "nearest": lambda past: rules.nearest(domain, past, listener.setting),
            "random": lambda past: rules.at_random(domain, past, rates or {}, generator),
        }[name]
        return lambda rounds, _: (torch.stack([rule(past) for past in rounds]), None)
    if name not in COMMUNICATORS:
        raise UnknownNameError.of("communicator", name, COMMUNICATORS)
    assert listener.person is not None
    planner = planner_of(name, listener.person, options, seed)
    return Planning(replace(planner, silent_because=listener.silent_because))


class Planning:
    """A planner for one person that learns which channels reach them.

    Attributes:
        planner: for the current round.
    """

    def __init__(self, planner: Communicator) -> None:
        self.planner = planner

    def __call__(
        self, rounds: Sequence[RoundSoFar], truth: Truth
    ) -> tuple[Tensor, list[Decision] | None]:
        """Plan messages in each of R rounds."""
        del truth
        decisions = [self.planner.plan(past) for past in rounds]
        return torch.stack([decision.flags for decision in decisions]), decisions

    def learn(self, past: RoundSoFar) -> None:
        """Learn from a finished round, before the next one."""
        self.planner = self.planner.after(past)

    @property
    def hears(self) -> dict[str, float]:
        """Probability that messages of each modality reach the person; empty if it is given."""
        person = self.planner.person
        return person.hears if isinstance(person, HearingPerson) else {}


def _oracle(listener: Listener, options: PlannerOptions, seed: int) -> Say:
    """The oracle: optimal messages, in some worlds greedy ones (`DomainPeople.best_messages`).

    For people who follow the human model, those of a planner with their true implants.
    """
    if (known := listener.driver.modelled()) is not None:
        human, truth = known
        if listener.domain.random:  # a draw for each future
            truth = {name: value.expand(FUTURES, *value.shape[1:]) for name, value in truth.items()}
        return Planning(planner_of("mirror", Person(human, truth), options, seed, known=True))
    own = people_of(listener.domain.name)
    if own is None:
        raise InputError(NO_ORACLE)
    start = map_state(lambda part: part[0], listener.start.state)
    if own.oracle is not None:
        best = own.oracle(listener.driver, start)
        return lambda rounds, _: (best(torch.stack([past.actions for past in rounds])), None)
    if (best_now := own.best_messages) is not None:
        person = listener.driver
        return lambda _, truth: (best_now(person, truth.state, truth.memory), None)
    if listener.domain.random:
        raise InputError(
            f"{listener.domain.name} is random; its people need an oracle of their own"
        )
    knows = ReachableOracle(listener.driver, start)
    return lambda _, truth: (knows.messages(truth.step, truth.state, truth.memory), None)


def play(listener: Listener, say: Say, keep_log: bool = False) -> Played:
    """Play one person's rounds with a communicator; see `play_together`."""
    return play_together([listener], [say], keep_log)[0]


@torch.no_grad()
def play_together(
    listeners: Sequence[Listener], says: Sequence[Say], keep_log: bool = False
) -> list[Played]:
    """Play the rounds of several people, each with a communicator of their own.

    A planner learns from each round before the next one; others play all rounds at once. People do
    not meet, but take their steps together: a step of many takes hardly longer than one of few.

    Args:
        listeners: people of one population, with equally many rounds.
        says: the communicator of each; either all are planners or none is.
        keep_log: True to keep every decision.
    """
    if not any(isinstance(say, Planning) for say in says):
        return [played for played, _ in _play(listeners, says, keep_log)]
    parts: list[list[Played]] = [[] for _ in says]
    for number in range(listeners[0].start.action_noise.shape[1]):
        found = _play([one.round(number) for one in listeners], says, keep_log)
        for own, say, (played, (past,)) in zip(parts, says, found, strict=True):
            assert isinstance(say, Planning)
            say.learn(past)
            own.append(played)
    return [
        replace(Played.joined(own), hears=say.hears)
        for own, say in zip(parts, says, strict=True)
        if isinstance(say, Planning)
    ]


def _play(
    listeners: Sequence[Listener], says: Sequence[Say], keep_log: bool
) -> list[tuple[Played, list[RoundSoFar]]]:
    """Play all rounds at once; also returns the observed rounds of each person."""
    domain = listeners[0].domain
    driver = listeners[0].driver.join([one.driver for one in listeners])
    start = Start.join([one.start for one in listeners])
    channels, (people, number, _) = Channels(domain), start.action_noise.shape
    tallies = [Tally(domain, channels, number) for _ in says]
    seconds, logs = [0.0] * people, [[] for _ in says]
    state, memory = start.state, driver.start(number, mind_noise=start.mind_noise)
    observation = domain.observe(state)
    rounds = [
        [RoundSoFar.begin(domain, _at(observation, person, r)) for r in range(number)]
        for person in range(people)
    ]
    for step in range(domain.horizon):
        under_way = ~domain.over(state)
        playing = under_way.any(-1).nonzero().flatten().tolist()
        if not playing:
            break
        decisions: dict[int, list[Decision] | None] = {}
        flags = torch.zeros(people, number, len(channels), dtype=torch.bool)
        for person in playing:
            truth = Truth(step, _of(state, person), _of(memory, person))
            began = perf_counter()
            flags[person], decisions[person] = says[person](rounds[person], truth)
            seconds[person] += perf_counter() - began
        flags = flags & under_way[..., None]
        messages = channels.split(flags)
        probability, memory = driver.step(memory, observation, messages)
        action = act(probability, start.action_noise[..., step])
        memory = driver.acted(memory, action)
        following = domain.transition(state, action)
        rewards, after = domain.rewards(state, action, following), domain.observe(following)
        for person in playing:
            seen = {name: value[person] for name, value in observation.items()}
            own, going = flags[person], under_way[person]
            tallies[person].add_messages(seen, own, going)
            tallies[person].add_rewards({name: term[person] for name, term in rewards.items()})
            if keep_log:
                decided = decisions[person]
                logs[person] += [
                    {"round": r, "step": step}
                    | _entry(domain, channels, own[r], int(action[person, r]), each)
                    | ({} if decided is None else audit(decided[r]))
                    for r, each in enumerate(probability[person])
                    if going[r]
                ]
            rounds[person] = [
                past.then(_at(messages, person, r), action[person, r], _at(after, person, r))
                for r, past in enumerate(rounds[person])
            ]
        state, observation = following, after
    return [
        (tally.played(took, log), own)
        for tally, took, log, own in zip(tallies, seconds, logs, rounds, strict=True)
    ]


def _of(parts: Any, person: int) -> Any:
    """What one person has of states or memories ``[P, R]``, ``[1, R]``."""
    return map_state(lambda part: part[person : person + 1], parts)


def _at(parts: Mapping[str, Tensor], person: int, number: int) -> dict[str, Tensor]:
    """What one person has of ``[P, R, ...]`` in one round."""
    return {name: part[person, number] for name, part in parts.items()}


def audit(decision: Decision, most: int = 5) -> dict[str, Any]:
    """Convert a planner's decision to data: gain, sentence, what mattered, best alternatives.

    The alternatives always include the chosen one: it has the largest lower bound, gain - k SE, not
    necessarily the largest gain.
    """
    low, high = decision.gain.interval
    columns = ["message", "later", "cost", "gain", "standard_error", "chosen"]
    table = decision.alternatives[columns]
    shown = [row for place, row in enumerate(table.to_numpy().tolist()) if place < most or row[-1]]
    turning = None
    if decision.turning_point is not None:
        step, action, silent, told = decision.turning_point
        named = decision.domain.actions[action]
        turning = {"steps_ahead": step, "action": named, "silent": silent, "told": told}
    return {
        "gain": decision.gain.mean,
        "gain_interval": [low, high],
        "why": decision.why(),
        "advice": decision.advice,
        "plan": [str(message) for message in decision.plan],
        "matters": [[*pair, value] for pair, value in decision.matters.items()],
        "turning_point": turning,
        "alternatives": [dict(zip(columns, row, strict=True)) for row in shown],
    }


def _entry(
    domain: Domain, channels: Channels, flags: Tensor, action: int, probability: Tensor
) -> dict[str, Any]:
    return {
        "message": {name: list(items) for name, items in channels.message(flags).items.items()},
        "cost": float(channels.cost(flags)),
        "action": domain.actions[action],
        "true_probability": dict(zip(domain.actions, probability.tolist(), strict=True)),
    }
