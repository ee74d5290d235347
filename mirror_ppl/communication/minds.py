"""What the person may believe: posterior draws of a human model, carried through a round.

Beliefs depend on perceptual implants alone, and draws of these repeat; so a belief is worked out
once for each distinct *eye*, the values of the discrete sites, and once for each distinct thing
that such an eye may have seen. U stands for distinct eyes, n for beliefs that are tracked.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from copy import copy
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import pyro
import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.checks import require_kind
from mirror_ppl.communication.messages import Channels
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.domains.base import Observation, Visibility, map_state
from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.attention import AttentionValues, Proposal
from mirror_ppl.likelihood.densities import choices, log_weighted_latents
from mirror_ppl.models.course import perceived
from mirror_ppl.models.human import HumanModel, require_standard_program
from mirror_ppl.models.networks import Gaussian
from mirror_ppl.models.prior import checked_draws
from mirror_ppl.models.view import View
from mirror_ppl.row_hashing import as_whole_numbers, distinct_rows

COUNTED = 3
"""Up to how many items of a message have to be cheaper than others that tell the same."""
ATTENTION_VALUES = 512
"""Values that stand for all that somebody may attend to in a round, of which each draw gets one."""


class Person:
    """A human model with posterior draws of one person's implants.

    Args:
        human: the model of people.
        draws: values ``[S, 1, 1, ...]`` of all its sites, tensors or what becomes one.

    Attributes:
        eyes: values ``[U]`` of the discrete sites, each combination that occurs in the draws once;
            in a round those of attention, too.
        eye: which of them each draw has, ``[S]``.

    Raises:
        HumanModelError: there are no draws, or they are not those of the model's sites.
        InputError: the draws are of several people, of another shape or kind, or have values that
            the human model rules out.
    """

    def __init__(self, human: HumanModel, draws: Mapping[str, Tensor]) -> None:
        self.human = require_kind(human, HumanModel, "human")
        require_standard_program(human, "be planned with")
        none = isinstance(draws, Mapping) and not draws
        self.draws = {} if none else checked_draws(human, draws, 1)
        self.number = len(next(iter(self.draws.values()), ()))
        if self.number == 0:
            raise HumanModelError("planning needs at least one posterior draw")
        with torch.no_grad(), self._conditioned(), poutine.trace() as trace:
            self.implants = human.prior()
        self._discrete = {
            name: self.draws[name].reshape(self.number)
            for name, site in trace.trace.nodes.items()
            if name in self.draws and site["fn"].has_enumerate_support
        }
        self.device = next(iter(self.draws.values())).device
        self.eyes, self.eye = self._distinct_eyes(self._discrete, self.number)
        self.eye_count = int(self.eye.max()) + 1

    def _distinct_eyes(
        self, values: Mapping[str, Tensor], number: int
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Each combination of values ``[number]`` once, and which of them each is."""
        none = [torch.zeros(number, dtype=torch.long, device=self.device)]
        rows = torch.stack([value.long() for value in values.values()] or none, -1)
        first, which = distinct_rows(rows)
        return {name: value[first] for name, value in values.items()}, which

    @torch.no_grad()
    def in_round(self, past: RoundSoFar) -> Person:
        """The person in a round under way, with what they attend to as their actions tell it.

        Each draw gets one value of attention from ``p(m | psi, what was done so far)``, of all
        there are or of some that stand for them (:mod:`mirror_ppl.likelihood.attention`). Nothing
        changes if no attention differs from round to round.
        """
        if not self.human.has_round_latents:
            return self
        so_far = {name: value[: past.time] for name, value in past.observation.items()}
        facts = {
            name: fact.view(1, 1) for name, fact in self.human.covariates(past.observation).items()
        }
        explanations = self.human.log_proposal(so_far, past.actions)
        values = self._attention_of_any_round
        if facts or explanations:
            values = self._attention.values(None, 0, facts, explanations)
        log_chances = self._log_chances(values.values, past)
        with self._conditioned():
            log_chances = log_chances + log_weighted_latents(
                self.human,
                self.implants,
                {name: value[None, None] for name, value in values.values.items()},
                values.log_weights[None, None],
                facts,
            ).view(-1, len(values))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(past.time)
            chosen = torch.multinomial(log_chances.softmax(-1), 1).squeeze(-1)
        own = {name: value[chosen] for name, value in values.values.items()}
        person = copy(self)
        person.eyes, person.eye = self._distinct_eyes({**self._discrete, **own}, self.number)
        person.eye_count = int(person.eye.max()) + 1
        return person

    @cached_property
    def _attention(self) -> Proposal:
        """Proposes values of attention that stand for all that this person may attend to."""
        return Proposal(self.human, self.draws, self.draws, ATTENTION_VALUES)

    @cached_property
    def _attention_of_any_round(self) -> AttentionValues:
        """These values where nothing is known of the round; always the same."""
        return self._attention.values(None, 0)

    def _log_chances(self, attention: Mapping[str, Tensor], past: RoundSoFar) -> Tensor:
        """Log-probability ``[S, G]`` of what was done so far under values of attention ``[G]``."""
        number = len(next(iter(attention.values())))
        total = torch.zeros(self.number, number, device=self.device)
        everybody = copy(self)
        everybody.eyes = {
            **{name: value.repeat_interleave(number) for name, value in self.eyes.items()},
            **{name: value.repeat(self.eye_count) for name, value in attention.items()},
        }
        everybody.eye_count = self.eye_count * number
        eye = self.eye[:, None] * number + torch.arange(number, device=self.device)  # [S, G]
        for time, (beliefs, own) in enumerate(through(everybody, past)):
            mean = beliefs.mean[None]
            acted = past.actions[time].expand(1, mean.shape[1])
            with self._conditioned():
                _, found = choices(
                    self.human, self.implants, mean, self.human.action_values(mean), acted
                )
            found = found.expand(self.number, *found.shape[-2:])[:, 0]
            total = total + found.gather(-1, own[eye])
        return total

    def _conditioned(self) -> ExitStack:
        stack = ExitStack()
        stack.enter_context(poutine.block())
        stack.enter_context(poutine.condition(data=self.draws))
        stack.enter_context(pyro.plate("draw", self.number, dim=-3))
        stack.enter_context(pyro.plate("person", 1, dim=-2))
        return stack

    def see(self, eye: Tensor, observation: Observation, told: Visibility) -> View:
        """What eyes ``[n]`` see of rounds ``[n, T, ...]``."""
        implants = {name: value[eye] for name, value in self.eyes.items()}
        view = perceived(self.human, implants, observation, told)
        return view.map(lambda part: part.expand(len(eye), *part.shape[1:]))

    def perceive(
        self,
        eye: Tensor,
        knowledge: Any,
        observation: Observation,
        told: Visibility,
        step: int,
    ) -> tuple[View, Any]:
        """One step of eyes ``[n]`` with knowledge ``[n]``; see `HumanModel.perceive`."""
        implants = {name: value[eye] for name, value in self.eyes.items()}
        view, knowledge = self.human.perceive(implants, knowledge, observation, told, step)
        return view.map(lambda part: part.expand(len(eye), *part.shape[1:])), knowledge

    def act(self, belief: Tensor, values: Tensor) -> Tensor:
        """Log-probabilities ``[S, M, A]`` of actions at M beliefs of each draw.

        Args:
            belief: ``[S, M, Z]``, or ``[1, M, Z]`` where draws share them.
            values: the self-model's action values there, ``[S, M, A]``.
        """
        with self._conditioned(), pyro.plate("round", belief.shape[1], dim=-1):
            result = self.human.act(self.implants, belief[:, None], values[:, None])
        return result.expand(self.number, *result.shape[1:])[:, 0]


@dataclass(frozen=True)
class Looks:
    """What g looks at the world are: whose, at what, after what.

    Attributes:
        parent: the belief before, ``[g]``, an index into those of the step before.
        eye: ``[g]``.
        action: what was done since, ``[g]``; the number of actions at the start of a round.
        row: which of the observations is looked at, ``[g]``.
        observation: the observations, ``[rows, ...]``.
        told: what is communicated, ``[g, K]`` by modality.
    """

    parent: Tensor
    eye: Tensor
    action: Tensor
    row: Tensor
    observation: Observation
    told: Visibility


@dataclass(frozen=True)
class Beliefs:
    """What may be believed at one step, each belief once.

    Attributes:
        person: whose they are.
        mean: the beliefs ``[n, Z]``.
        scale: of their densities ``[n, Z]``; ``None`` before the first step, or if they have none.
        knowledge: the domain's, ``[n]``.
        step: the number of the next step.
    """

    person: Person
    mean: Tensor
    scale: Tensor | None
    knowledge: Any
    step: int

    @classmethod
    def at_first(cls, person: Person) -> tuple[Beliefs, Tensor]:
        """Before the first step: one belief, and that it is everybody's, ``[U]``."""
        human = person.human
        zero = next(human.parameters()).new_zeros(1, human.belief_size)
        nothing = human.domain.nothing_known(1, device=zero.device)
        own = torch.zeros(person.eye_count, dtype=torch.long, device=zero.device)
        return cls(person, zero, None, nothing, 0), own

    def after(self, looks: Looks) -> tuple[Beliefs, Tensor]:
        """Beliefs of the next step, and which of them each look leads to ``[g]``.

        Looks that show the same after the same lead to one belief.
        """
        human = self.person.human
        seen = {name: value[looks.row] for name, value in looks.observation.items()}
        before = _rows(self.knowledge, looks.parent)
        view, knowledge = self.person.perceive(looks.eye, before, seen, looks.told, self.step)
        told_by, which = distinct_rows(torch.stack([looks.row, view.numbers()], -1))
        rows = looks.row[told_by]
        evidence = human.evidence(
            view.map(lambda part: part[told_by]),
            {name: value[rows] for name, value in looks.observation.items()},
        )
        known = _whole_numbers(knowledge)
        first, index = distinct_rows(
            torch.cat([torch.stack([looks.parent, looks.action, which], -1), *known], -1)
        )
        state = human.infer(
            self.mean[looks.parent[first]],
            evidence[which[first]],
            looks.action[first],
            None if view.still is None else view.still[first],
        )
        mean, scale = state if isinstance(state, Gaussian) else (state, None)
        knowledge = _rows(knowledge, first)
        if view.still is not None:
            # Beliefs that stay as they are, are the same ones however long ago they were formed.
            same, which = distinct_rows(
                torch.cat([as_whole_numbers(mean), *_whole_numbers(knowledge)], -1)
            )
            mean, scale = mean[same], None if scale is None else scale[same]
            knowledge, index = _rows(knowledge, same), which[index]
        return Beliefs(self.person, mean, scale, knowledge, self.step + 1), index


def through(person: Person, past: RoundSoFar) -> Iterator[tuple[Beliefs, Tensor]]:
    """Beliefs at each step of a round so far, and which of them each eye has ``[U]``."""
    beliefs, own = Beliefs.at_first(person)
    eyes = torch.arange(person.eye_count, device=own.device)
    none = len(person.human.domain.actions)
    for time in range(past.time):
        action = past.actions[time - 1] if time else none
        looks = Looks(
            parent=own,
            eye=eyes,
            action=torch.full_like(eyes, int(action)),
            row=torch.zeros_like(eyes),
            observation={name: value[time, None] for name, value in past.observation.items()},
            told={name: mask[time].expand(len(eyes), -1) for name, mask in past.told.items()},
        )
        beliefs, own = beliefs.after(looks)
        yield beliefs, own


@dataclass(frozen=True)
class Standing:
    """A person in the middle of a round, about to look at the present step.

    Attributes:
        person: posterior draws of the human model.
        past: the round so far.
        before: what may be believed before that look.
        own: which of these beliefs each eye has, ``[U]``.
    """

    person: Person
    past: RoundSoFar
    before: Beliefs
    own: Tensor

    @classmethod
    def of(cls, person: Person, past: RoundSoFar) -> Standing:
        """The person at this point of a round."""
        person = person.in_round(past)
        *_, (before, own) = Beliefs.at_first(person), *through(person, past)
        return cls(person, past, before, own)

    @property
    def last_action(self) -> int:
        """What was done last; the number of actions at the start of a round."""
        past = self.past
        return int(past.actions[-1]) if past.time else len(self.person.human.domain.actions)

    def told(self, messages: Tensor) -> tuple[Beliefs, Tensor]:
        """Beliefs after messages ``[M, N]`` for now, and which of them each eye has ``[M, U]``."""
        eyes, number = self.person.eye_count, len(messages)
        eye = torch.arange(eyes, device=messages.device).repeat(number)
        looks = Looks(
            parent=self.own[eye],
            eye=eye,
            action=torch.full_like(eye, self.last_action),
            row=torch.zeros_like(eye),
            observation={name: value[None] for name, value in self.past.now.items()},
            told=Channels(self.person.human.domain).split(messages.repeat_interleave(eyes, 0)),
        )
        beliefs, index = self.before.after(looks)
        return beliefs, index.view(number, eyes)

    @torch.no_grad()
    def telling(self, allowed: Tensor) -> Tensor:
        """Which of the allowed items ``[N]`` tell anything now, in at least one posterior draw.

        What everybody sees or knows already leads to the same beliefs if it is told besides, so no
        message with it is worth its cost. Items tell something each by itself or not at all.
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
        """Items ``[n]`` that tell just what others do at less cost, even as the third of those.

        Args:
            places: of the items, ``[n]``.
            index: beliefs after each, ``[n, U]``.
        """
        channels = Channels(self.person.human.domain)
        alone, third = (channels.marginal(count).to(places.device) for count in (1, COUNTED))
        same = (index[:, None] == index).all(-1)
        dearer = alone[places][:, None] >= third[places] - 1e-6  # of rounding
        return (same & dearer).any(1)


def _whole_numbers(knowledge: Any) -> list[Tensor]:
    """A domain's knowledge ``[n]`` as whole numbers, equal where it is equal."""
    return [as_whole_numbers(getattr(knowledge, part.name)) for part in fields(knowledge)]


def _rows(knowledge: Any, rows: Tensor) -> Any:
    """Some rows of a domain's knowledge."""
    return map_state(lambda part: part[rows], knowledge)
