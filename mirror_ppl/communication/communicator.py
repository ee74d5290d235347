"""The communicator: plans the message for a person at each step, and explains it.

It is a function of the round so far without state between calls, so any simulator or robot can call
it step by step::

    communicator = Communicator(person, ExpectedUtility(SelfModelWorld(human.self_model)))
    decision = communicator.plan(round_so_far)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from mirror_ppl.checks import real_number, require_kind, require_methods, seed_number
from mirror_ppl.communication.decision import (
    TIE,
    Decision,
    Gain,
    gain_over_silence,
    least_gains,
)
from mirror_ppl.communication.messages import Channels
from mirror_ppl.communication.objectives import Objective, Value, Valued
from mirror_ppl.communication.person import Person, PlanningContext
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.communication.search import Automatic, Found, Search, joined
from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.domains.base import Domain, Observation
from mirror_ppl.errors import InputError
from mirror_ppl.models.world_knowledge import planning_domain
from mirror_ppl.row_hashing import seed_of

NOT_EXPLAINED = "the human model does not explain this person's actions"
"""The reason for silence to a person with the verdict ``unexplained`` of the model check."""


@dataclass(frozen=True, repr=False)
class Communicator:
    """Plans messages for one person.

    Attributes:
        person: posterior draws of the human model.
        objective: what messages maximize.
        search: how candidates are found.
        min_standard_errors: number of standard errors by which a gain has to exceed 0; 0 chooses
            the largest mean gain.
        seed: of everything random; the same seed and round give the same decision.
        silent_because: a reason for which no message is planned; empty for planning.

    Raises:
        InputError: an argument is of another kind, or the objective is of another domain.
    """

    person: Person
    objective: Objective
    search: Search = Automatic()
    min_standard_errors: float = 2.0
    seed: int = 0
    silent_because: str = ""

    def __post_init__(self) -> None:
        require_kind(self.person, Person, "person")
        require_methods(self.objective, ["at"], "objective", "an objective")
        require_methods(self.search, ["__call__"], "search", "a search")
        # The world of the objective, if it has one with a domain.
        world = getattr(getattr(self.objective, "world", None), "domain", None)
        own = self.person.human.domain.name
        if world is not None and world.name != own:
            raise InputError(f"the objective must be of the world {own}, not of {world.name}")
        name = "min_standard_errors"
        object.__setattr__(self, name, real_number(self.min_standard_errors, name, 0.0))
        object.__setattr__(self, "seed", seed_number(self.seed))
        require_kind(self.silent_because, str, "silent_because")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({type(self.objective).__name__}, {self.person.number} draws)"

    @torch.no_grad()
    def plan(self, past: RoundSoFar) -> Decision:
        """Plan the message for now.

        Silence is chosen where no message gains enough, where :attr:`silent_because` gives a
        reason, and when the round is over: after its last step, or after the task is done.

        Raises:
            InputError: the round is impossible at one of its steps, has more steps than rounds of
                the domain, or goes on after the task was done.
        """
        domain = self.person.human.domain
        if isinstance(past, Demonstrations):
            raise InputError(
                "the round so far must be a RoundSoFar, not recordings: RoundSoFar.of(recordings, "
                "person, number, step) is that of a recorded round, RoundSoFar.begin a new one"
            )
        past = require_kind(past, RoundSoFar, "the round so far").to(self.person.device)
        past.check(domain)
        channels = Channels(domain)
        now = past.now
        allowed = channels.join(domain.communicable(now))
        steps_left = domain.horizon - past.time
        over = steps_left < 1 or bool(domain.over(domain.state_behind(now)))
        if over or self.silent_because or not allowed.any():
            return self._silence(now, allowed, over)
        context = PlanningContext.of(self.person, past, self.seed)
        allowed = context.telling(allowed)
        if not allowed.any():
            return self._silence(now, allowed)
        seed = self.seed * (domain.horizon + 1) + past.time
        if domain.random:  # otherwise the same futures would be imagined in every round
            seed = (seed + seed_of(past.observation)) % 2**62
        value = self.objective.at(context, steps_left, seed)
        found = self.search(value, allowed, seed)
        chosen = choose(found.valued, self.min_standard_errors)
        found, chosen = slimmed(value, found, chosen, self.min_standard_errors)
        flags = found.candidates[chosen, 0]
        gain = gain_over_silence(found.valued, chosen)
        message = channels.message(flags)
        return Decision(
            message,
            flags,
            gain,
            domain,
            now,
            found,
            chosen,
            self._world,
            standard_errors=self.min_standard_errors,
        )

    def after(self, past: RoundSoFar) -> Communicator:
        """Return the communicator for the next round of the same person.

        It has learned which channels reach them (:mod:`mirror_ppl.communication.hearing`), so a
        person who does not react to messages soon gets none.

        Args:
            past: the assisted round, with its last action and observation.

        Raises:
            InputError: as for :meth:`plan`.
        """
        past = require_kind(past, RoundSoFar, "the round").to(self.person.device)
        past.check(self.person.human.domain)
        return Communicator(
            self.person.after(past),
            self.objective,
            self.search,
            self.min_standard_errors,
            self.seed,
            self.silent_because,
        )

    def _silence(self, now: Observation, allowed: Tensor, over: bool = False) -> Decision:
        """Return the decision for silence where there is no choice."""
        none = torch.zeros_like(allowed)
        domain = self.person.human.domain
        message = Channels(domain).message(none)
        gain = Gain(0.0, 0.0, 0.0)
        return Decision(
            message,
            none,
            gain,
            domain,
            now,
            None,
            0,
            self._world,
            over,
            because=self.silent_because,
        )

    @cached_property
    def _world(self) -> Domain:
        """World as the robot knows it after learning."""
        return planning_domain(self.person.human, self.person.draws)


def choose(valued: Valued, standard_errors: float) -> int:
    """Return the candidate with the largest lower bound, gain - ``standard_errors`` * SE.

    Returns silence, candidate 0, if no lower bound is positive; the first one among ties.
    """
    least = least_gains(valued, valued.utility - valued.utility[:1], standard_errors)
    best = int(least.argmax())
    return best if float(least[best]) > TIE else 0


def slimmed(value: Value, found: Found, chosen: int, standard_errors: float) -> tuple[Found, int]:
    """Drop items of a plan's present message whose own gain has no positive lower bound.

    A plan can owe its gain to later messages, and a message to one of its items. So the plan is
    compared with itself without each item that it communicates now. The item with the lowest lower
    bound, gain - ``standard_errors`` * SE, is dropped if that is not positive, until all are.

    Returns:
        All candidates, with those added here, and the index of the chosen one.
    """
    while True:
        plan = found.candidates[chosen]
        places = plan[0].nonzero().squeeze(-1)
        if not len(places):
            return found, chosen
        less = plan.repeat(len(places), 1, 1)
        less[torch.arange(len(places)), 0, places] = False
        found, place = joined(found, less, value)
        gain = found.valued.utility[chosen] - found.valued.utility[place]
        least = least_gains(found.valued, gain, standard_errors)
        worst = int(least.argmin())
        if float(least[worst]) > TIE:
            return found, chosen
        chosen = int(place[worst])
