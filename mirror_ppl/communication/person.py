"""The person in planning: posterior draws of a human model, tracked through a round.

Beliefs depend on perceptual implants alone, and draws of these repeat; so beliefs are tracked once
for each distinct *percept*, the values of the sites that perception reads (:class:`BeliefState`).
U is the number of distinct percepts.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import pyro
import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.checks import require_kind
from mirror_ppl.communication.messages import Channels
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.communication.tracking import RunningSum, Tracks
from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.attention import AttentionValues, Proposal
from mirror_ppl.likelihood.combinations import perceived_names, unread_sites
from mirror_ppl.likelihood.densities import choices, log_weighted_latents
from mirror_ppl.models.belief_tracking import BeliefState, Transition
from mirror_ppl.models.human import HumanModel, require_standard_program
from mirror_ppl.models.prior import checked_draws
from mirror_ppl.models.sites import OnlyRead
from mirror_ppl.randomness import forked, seed_everything
from mirror_ppl.row_hashing import distinct_rows, joint_rows

COUNTED = 3
"""An item is dropped if an equivalent item costs no more, even as this number in a message."""
ATTENTION_VALUES = 512
"""Number of proposed values of attention in a round, of which each draw gets one."""


class Person:
    """A human model with posterior draws of one person's implants.

    Args:
        human: the model of people.
        draws: values ``[S, 1, 1, ...]`` of all its sites, tensors or convertible to tensors.

    Attributes:
        percepts: values ``[U, ...]`` of the sites that perception reads, each joint value in the
            draws once; in a round including attention.
        percept: index of each draw's combination, ``[S]``.
        cycle: number D of draws that repeat: draw s is draw s mod D; 1 if they do not.

    Raises:
        HumanModelError: there are no draws, or their sites are not the model's.
        InputError: the draws are of several people, of another shape or kind, or have values
            outside the support of the sites.
    """

    def __init__(self, human: HumanModel, draws: Mapping[str, Tensor]) -> None:
        self.human = require_kind(human, HumanModel, "human")
        require_standard_program(human, "be planned with")
        none = isinstance(draws, Mapping) and not draws
        self.draws = {} if none else checked_draws(human, draws, 1)
        self.number = len(next(iter(self.draws.values()), ()))
        if self.number == 0:
            raise HumanModelError("planning needs at least one posterior draw")
        with torch.no_grad():
            with self._conditioned():
                self.implants = human.prior()
            read = perceived_names(human)
        self.cycle = _cycle(self.draws, self.number)
        self._perceived = {name: self.draws[name][:, 0, 0] for name in read}
        self.device = next(iter(self.draws.values())).device
        self.percepts, self.percept = self._distinct_percepts(self._perceived, self.number)
        self.percept_count = int(self.percept.max()) + 1
        self._tracks = Tracks()
        self._log_likelihood = RunningSum()

    def _distinct_percepts(
        self, values: Mapping[str, Tensor], number: int
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Return distinct joint values ``[number, ...]``, and the index of each value."""
        none = torch.zeros(number, 1, dtype=torch.long, device=self.device)
        first, which = distinct_rows(joint_rows(values, none))
        return {name: value[first] for name, value in values.items()}, which

    @torch.no_grad()
    def in_round(self, past: RoundSoFar, seed: int = 0) -> Person:
        """Return the person in this round, with attention drawn given their actions so far.

        Each draw gets one value of attention from ``p(m | psi, actions so far)``, among all values
        or a weighted sample of them (:mod:`mirror_ppl.likelihood.attention`). A model without
        round latents is returned unchanged.
        """
        if not self.human.has_round_latents:
            return self
        values, log_prior = self._attending(past)
        log_probabilities = self._log_probabilities(values, past) + log_prior
        with forked():
            seed_everything(seed * 1_000_003 + past.time)
            chosen = torch.multinomial(log_probabilities.softmax(-1), 1).squeeze(-1)
        own = {name: value[chosen] for name, value in values.items()}
        person = copy(self)
        person.percepts, person.percept = self._distinct_percepts(
            {**self._perceived, **own}, self.number
        )
        person.percept_count = int(person.percept.max()) + 1
        return person

    def after(self, past: RoundSoFar) -> Person:
        """Return the person after an assisted round; here nothing is learned from it."""
        del past
        return self

    def _attending(self, past: RoundSoFar) -> tuple[dict[str, Tensor], Tensor]:
        """Return proposed values of attention ``[G]`` in a round, and log priors ``[S, G]``."""
        so_far = {name: value[: past.time] for name, value in past.observation.items()}
        facts = {
            name: fact.view(1, 1) for name, fact in self.human.covariates(past.observation).items()
        }
        explanations = self.human.log_proposal(so_far, past.actions)
        values = self._attention_of_any_round
        if facts or explanations:
            values = self._attention.values(None, 0, facts, explanations)
        with self._conditioned():
            log_prior = log_weighted_latents(
                self.human,
                self.implants,
                {name: value[None, None] for name, value in values.values.items()},
                values.log_weights[None, None],
                facts,
            ).view(-1, len(values))
        return values.values, log_prior

    @cached_property
    def _attention(self) -> Proposal:
        """Proposal distribution of this person's attention."""
        return Proposal(self.human, self.draws, self.draws, ATTENTION_VALUES)

    @cached_property
    def _attention_of_any_round(self) -> AttentionValues:
        """Proposed values that do not depend on the round; computed once."""
        return self._attention.values(None, 0)

    def _log_probabilities(self, attention: Mapping[str, Tensor], past: RoundSoFar) -> Tensor:
        """Return log-probabilities ``[S, G]`` of actions so far, given attention ``[G]``."""
        number = len(next(iter(attention.values())))
        known, total = self._log_likelihood.before(attention, past)
        if total is None:
            total = torch.zeros(self.number, number, device=self.device)
        everybody = copy(self)
        everybody.percepts = {
            **{name: value.repeat_interleave(number, 0) for name, value in self.percepts.items()},
            **{name: value.repeat(self.percept_count) for name, value in attention.items()},
        }
        everybody.percept_count = self.percept_count * number
        percept = self.percept[:, None] * number + torch.arange(
            number, device=self.device
        )  # [S, G]
        for time, state in enumerate(everybody.states(past)[known:], known):
            mean = state.mean[None]
            acted = past.actions[time].expand(1, mean.shape[1])
            with self._conditioned():
                _, found = choices(
                    self.human, self.implants, mean, self.human.action_values(mean), acted
                )
            found = found.expand(self.number, *found.shape[-2:])[:, 0]
            total = total + found.gather(-1, state.belief[percept])
        self._log_likelihood.keep(attention, past, total)
        return total

    def _conditioned(self) -> ExitStack:
        stack = ExitStack()
        stack.enter_context(poutine.block())
        stack.enter_context(poutine.condition(data=self.draws))
        stack.enter_context(pyro.plate("draw", self.number, dim=-3))
        stack.enter_context(pyro.plate("person", 1, dim=-2))
        return stack

    def transition(
        self,
        percept: Tensor,
        action: Tensor,
        observation: Observation,
        told: Visibility,
        row: Tensor | None = None,
    ) -> Transition:
        """Return the transition of percepts ``[n]`` to their next step."""
        known = {name: value[percept] for name, value in self.percepts.items()}
        implants = OnlyRead(known, unread_sites(self.human))
        return Transition(implants, action, observation, told, row)

    def last_action(self, past: RoundSoFar, time: int) -> int:
        """Return the action before a step of a round; the number of actions before the first."""
        return int(past.actions[time - 1]) if time else len(self.human.domain.actions)

    @torch.no_grad()
    def states(self, past: RoundSoFar) -> list[BeliefState]:
        """Return beliefs of every percept after each step of a round, before its present step.

        Beliefs of the steps before are kept from one call to the next; the parameters of the human
        model must not change in between.
        """
        initial = BeliefState.initial(self.human, self.percept_count)
        return self._tracks.through(
            self.percepts, past, initial, lambda first: transitions(self, past, first)
        )

    def act(self, belief: Tensor, values: Tensor) -> Tensor:
        """Return log-probabilities ``[S, M, A]`` of actions at M beliefs of each draw.

        Args:
            belief: ``[S, M, Z]``, or ``[1, M, Z]`` where draws share them.
            values: the self-model's action values there, ``[S, M, A]``.
        """
        with self._conditioned(), pyro.plate("round", belief.shape[1], dim=-1):
            result = self.human.act(self.implants, belief[:, None], values[:, None])
        return result.expand(self.number, *result.shape[1:])[:, 0]


def transitions(person: Person, past: RoundSoFar, first: int = 0) -> list[Transition]:
    """Return the transitions of every percept through a round from a step on, up to its present."""
    every = torch.arange(person.percept_count, device=person.device)
    return [
        person.transition(
            every,
            torch.full_like(every, person.last_action(past, time)),
            {name: value[time, None] for name, value in past.observation.items()},
            {name: mask[time, None] for name, mask in past.told.items()},
        )
        for time in range(first, past.time)
    ]


@dataclass(frozen=True)
class PlanningContext:
    """A person in the middle of a round, before they perceive the present step.

    Attributes:
        person: posterior draws of the human model.
        past: the round so far.
        before: distinct beliefs before the present step.
        own: index of each percept's belief, ``[U]``.
    """

    person: Person
    past: RoundSoFar
    before: BeliefState
    own: Tensor

    @classmethod
    def of(cls, person: Person, past: RoundSoFar, seed: int = 0) -> PlanningContext:
        """Return the context of a person at this point of a round; the seed is of attention."""
        person = person.in_round(past, seed)
        states = person.states(past)
        state = states[-1] if states else BeliefState.initial(person.human, person.percept_count)
        return cls(person, past, *state.distinct())

    @property
    def last_action(self) -> int:
        """Last action; the number of actions at the start of a round."""
        return self.person.last_action(self.past, self.past.time)

    def told(self, messages: Tensor) -> tuple[BeliefState, Tensor]:
        """Return beliefs after messages ``[M, N]`` for now, and each percept's index ``[M, U]``."""
        percepts, number = self.person.percept_count, len(messages)
        percept = torch.arange(percepts, device=messages.device).repeat(number)
        transition = self.person.transition(
            percept,
            torch.full_like(percept, self.last_action),
            {name: value[None] for name, value in self.past.now.items()},
            Channels(self.person.human.domain).split(messages.repeat_interleave(percepts, 0)),
        )
        state, index = self.before.at(self.own[percept]).after(transition).distinct()
        return state, index.view(number, percepts)

    @torch.no_grad()
    def telling(self, allowed: Tensor) -> Tensor:
        """Return which allowed items ``[N]`` change a belief now in at least one posterior draw.

        An item that is seen or known in all draws changes no belief, so no message with it is worth
        its cost. Items are tested one by one: an item without effect alone has none with others.
        """
        places = allowed.nonzero().squeeze(-1)
        messages = allowed.new_zeros(len(places) + 1, len(allowed))
        messages[torch.arange(1, len(messages)), places] = True
        _, index = self.told(messages)
        result = torch.zeros_like(allowed)
        result[places] = (index[1:] != index[:1]).any(1)
        result[places[self._dearer(places, index[1:])]] = False
        return result

    def _dearer(self, places: Tensor, index: Tensor) -> Tensor:
        """Return items ``[n]`` for which others lead to equal beliefs at no more cost.

        The others have to cost no more even as number `COUNTED` of their modality. Of items that
        replace each other, as those that cost nothing do, the first is kept.

        Args:
            places: flag indices of the items, ``[n]``.
            index: beliefs after each, ``[n, U]``.
        """
        channels = Channels(self.person.human.domain)
        alone, third = (channels.marginal(count).to(places.device) for count in (1, COUNTED))
        same = (index[:, None] == index).all(-1)
        dearer = alone[places][:, None] >= third[places] - 1e-6  # of rounding
        mutual = dearer & dearer.T
        return (same & dearer & ~(mutual & torch.ones_like(mutual).triu())).any(1)


def _cycle(draws: Mapping[str, Tensor], number: int) -> int:
    """Number of draws after which they begin anew; 1 if they do not, or are all the same."""

    def again(later: slice, earlier: slice) -> Tensor:
        same = [(value[later] == value[earlier]).flatten(1).all(-1) for value in draws.values()]
        return torch.stack(same).all(0)

    begins = again(slice(1, None), slice(0, 1)).nonzero()
    if not len(begins):
        return 1
    cycle = 1 + int(begins[0])
    return cycle if again(slice(cycle, None), slice(0, number - cycle)).all() else 1
