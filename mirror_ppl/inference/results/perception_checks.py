"""Checks of perception: do actions fit better if the person missed or forgot something?

For some posterior draws the recorded rounds are perceived once more, otherwise than the draw says.
With ``p`` the probabilities of actions as the draw says, and ``p_d`` those after perceiving
otherwise::

    missed    T = sum_i log(1/2 + sum_d w_d prod_t p_d(a_t) / p(a_t))
    forgot    T = sum_t log(1/2 + 1/2 p_1(a_t) / p(a_t))

Each item i that comes into sight is noticed at once with probability 1/2, and d = 1, 2 or 3 steps
later with ``w_d``; at each step all earlier ones are forgotten with probability 1/2. T is the log
likelihood ratio of such people to those of the model, as if what happens to one item, or at one
step, did not depend on others. It is compared with that of replicates, as the statistics of
:mod:`mirror_ppl.inference.results.checks` are; p-values are one-sided.

n stands for pairs of draw and round, J for items that come into sight, D for delays, K for items of
all modalities, m for distinct beliefs, and k for courses of actions.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.inference.results.checks import REPLICATES, more_often
from mirror_ppl.likelihood.combinations import perceived_names
from mirror_ppl.likelihood.enumeration import acts_on_beliefs, conditioned
from mirror_ppl.likelihood.round_views import Rounds
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.models.belief_tracking import BeliefState, Memory, Transition
from mirror_ppl.models.family.any_kind import OneOfKinds
from mirror_ppl.models.family.several import SeveralBeliefs
from mirror_ppl.models.human import HumanModel, Implants, at_step, has_own_program, messages_at
from mirror_ppl.models.prior import checked_draws

DRAWS = 8
"""Posterior draws under which rounds are perceived once more. Averages over fewer depend on them,
and those of one draw are not conservative."""
DELAYS = {1: 1 / 4, 2: 1 / 8, 3: 1 / 8}
"""Steps after which an item in sight is noticed late, and their probabilities."""
FORGETS = 1 / 2
"""Probability of forgetting at a step."""
EVENTS = 100
"""Largest number of items that come into sight, on average of a draw; a random subset of more."""


@torch.no_grad()
def perception_p_values(
    human: HumanModel,
    rounds: Demonstrations,
    draws: Mapping[str, Tensor],
    generator: torch.Generator,
) -> dict[str, float]:
    """Return the p-values of ``missed`` and ``forgot``; near 0 if such people fit better.

    Args:
        human: the model of people.
        rounds: rounds of one person.
        draws: posterior draws of this person's implants ``[S, 1, 1, ...]``.
        generator: source of replicates.

    Returns:
        The p-values; none for models with round latents, several beliefs, a program of their own
        or a likelihood power, or whose percepts affect actions other than through beliefs; not
        ``missed`` if nothing comes into sight.
    """
    several = isinstance(human, SeveralBeliefs | OneOfKinds)
    if several or has_own_program(human) or human.has_round_latents:
        return {}
    # With a power below 1, errors of the robot's values count more than what perception changes.
    if human.likelihood_power != 1 or not bool(rounds.mask.any()):
        return {}
    sites = perceived_names(human)
    if not acts_on_beliefs(human, sites):
        return {}
    draws = checked_draws(human, draws, 1)
    held = len(next(iter(draws.values())))
    some = torch.linspace(0, held - 1, min(held, DRAWS)).round().long()
    own = {name: value[some] for name, value in draws.items()}
    perceived = PerceivedAgain(human, tuple(sites), rounds_of(rounds, 0), own)
    # Of a draw that holds the record impossible, ratios are undefined.
    possible = perceived.possible
    if not possible.any():
        return {}
    replicates, recorded = perceived.replicates(generator), perceived.recorded
    events = perceived.events(generator)
    statistics = {"missed": perceived.missed(events)} if len(events.pair) else {}
    found = {}
    for name, statistic in (statistics | {"forgot": perceived.forgot}).items():
        each = zip(statistic(replicates), statistic(recorded), strict=True)
        p_values = [more_often(one[None], own[None]) for one, own in each]
        found[name] = float(torch.tensor(p_values).double()[possible.cpu()].mean())
    return found


@dataclass(frozen=True)
class Events:
    """J items that come into sight.

    Attributes:
        pair: of draw and round ``[J]``.
        step: ``[J]``.
        item: its mask, by modality ``[J, K]``.
    """

    pair: Tensor
    step: Tensor
    item: Visibility


@dataclass(frozen=True)
class PerceivedAgain:
    """Recorded rounds of one person, perceived once more.

    Attributes:
        human: the model of people.
        sites: the sites that perception reads.
        rounds: R rounds.
        draws: draws of the implants ``[S, 1, 1, ...]``.
    """

    human: HumanModel
    sites: tuple[str, ...]
    rounds: Rounds
    draws: Mapping[str, Tensor]

    @cached_property
    def number(self) -> int:
        """Number of draws S."""
        return len(next(iter(self.draws.values())))

    @property
    def device(self) -> torch.device:
        """The device of the rounds."""
        return self.rounds.actions.device

    @cached_property
    def round(self) -> Tensor:
        """Round of each pair ``[n]``."""
        return torch.arange(len(self.rounds), device=self.device).repeat(self.number)

    @cached_property
    def draw(self) -> Tensor:
        """Draw of each pair ``[n]``."""
        draw = torch.arange(self.number, device=self.device)
        return draw.repeat_interleave(len(self.rounds))

    @property
    def real(self) -> Tensor:
        """False in padding, ``[n, T]``."""
        return self.rounds.real[self.round]

    @property
    def recorded(self) -> Tensor:
        """The recorded actions ``[n, T, 1]``."""
        return self.rounds.actions[self.round][..., None]

    @cached_property
    def usual(self) -> tuple[Tensor, Tensor, dict[str, int]]:
        """Log-probabilities ``[n, T, A]`` as the draws say, and what is seen then ``[n, T, K]``.

        Also the number of items of each modality. What ``perceive`` does not look at is not seen.
        """
        number, steps = self.real.shape
        looks: dict[int, Visibility] = {}

        def look(step: int, masks: Visibility) -> Visibility:
            # Later looks of a step are at what is expected.
            looks.setdefault(step, masks)
            return masks

        believed = self.believed(_looking(self.human, look), self.round, self.draw)
        acting = self.acting(*believed, self.draw)
        sizes = {name: mask.shape[-1] for one in looks.values() for name, mask in one.items()}
        seen = torch.zeros(number, steps, sum(sizes.values()), dtype=torch.bool, device=self.device)
        parts = dict(zip(sizes, seen.split(list(sizes.values()), -1), strict=True)) if sizes else {}
        for step, masks in looks.items():
            for name, mask in masks.items():
                if mask.dim() <= 2 and _fits(mask, number, sizes[name]):  # noqa: PLR2004
                    parts[name][:, step] = mask
        # Beliefs in padding may be anything.
        acting = torch.where(self.real[..., None], acting, -math.log(acting.shape[-1]))
        return acting, seen, sizes

    @property
    def log_probabilities(self) -> Tensor:
        """Log-probabilities ``[n, T, A]`` of actions as the draws say; equal ones in padding."""
        return self.usual[0]

    @property
    def possible(self) -> Tensor:
        """Draws ``[S]`` under which the recorded actions are possible."""
        each = self.log_probabilities.gather(-1, self.recorded).isfinite().all((1, 2))
        return each.view(self.number, -1).all(1)

    def replicates(self, generator: torch.Generator) -> Tensor:
        """Draw actions ``[n, T, k]`` as the model has them."""
        times = -(-REPLICATES // self.number)
        probabilities = self.log_probabilities.exp().cpu()
        drawn = torch.multinomial(
            probabilities.flatten(0, 1), times, replacement=True, generator=generator
        )
        return drawn.view(*probabilities.shape[:2], times).to(self.device)

    def events(self, generator: torch.Generator) -> Events:
        """Find items that come into sight."""
        _, seen, sizes = self.usual
        fresh = seen & self.real[..., None]
        fresh[:, 1:] &= ~seen[:, :-1]
        places = fresh.nonzero()
        order = torch.randperm(len(places), generator=generator)[: EVENTS * self.number]
        pair, step, item = places[order.sort().values.to(self.device)].unbind(1)
        single = item[:, None] == torch.arange(seen.shape[-1], device=self.device)
        parts = single.split(list(sizes.values()), -1) if sizes else ()
        return Events(pair, step, dict(zip(sizes, parts, strict=True)))

    def missed(self, events: Events) -> Callable[[Tensor], Tensor]:
        """Return the statistic ``[S, k]`` of noticing items late, of actions ``[n, T, k]``."""
        delays = torch.tensor(list(DELAYS), device=self.device)[:, None, None]
        weights = torch.tensor(list(DELAYS.values()), device=self.device)[:, None, None]
        steps = torch.arange(self.real.shape[1], device=self.device) - events.step[:, None]
        now = (steps >= 0) & (steps < delays)  # [D, J, T]
        unseen = {
            name: (mask[:, None] & now[..., None]).flatten(0, 1)
            for name, mask in events.item.items()
        }
        pair = events.pair.repeat(len(DELAYS))
        human = missing(self.human, unseen)
        believed = self.believed(human, self.round[pair], self.draw[pair])
        acting = self.acting(*believed, self.draw[pair])
        ratios = self._ratios(acting, pair).unflatten(0, (len(DELAYS), -1))

        def statistic(actions: Tensor) -> Tensor:
            found = []
            for draw in range(self.number):  # one by one, since all take much memory
                own = self.draw[events.pair] == draw
                chosen = actions[events.pair[own]].expand(len(DELAYS), -1, -1, -1)
                late = ratios[:, own].gather(-1, chosen).double().sum(2)
                found.append(torch.log1p((weights * torch.expm1(late)).sum(0)).sum(0))
            return torch.stack(found)

        return statistic

    @property
    def forgot(self) -> Callable[[Tensor], Tensor]:
        """The statistic ``[S, k]`` of forgetting all earlier steps, of actions ``[n, T, k]``."""
        ratios = self._ratios(self.acting(*self.forgotten(), self.draw), slice(None))

        def statistic(actions: Tensor) -> Tensor:
            each = torch.log1p(FORGETS * torch.expm1(ratios.gather(-1, actions).double()))
            return each.sum(1).view(self.number, -1, actions.shape[-1]).sum(1)

        return statistic

    @cached_property
    def observation(self) -> Observation:
        """Observations before actions, ``[R, T, ...]``."""
        steps = self.rounds.actions.shape[1]
        return {name: value[:, :steps] for name, value in self.rounds.observation.items()}

    @cached_property
    def memory(self) -> Memory:
        """A memory of no beliefs of these rounds."""
        return Memory.of_rounds(self.human, self.rounds.observation)

    def _begin(self, human: HumanModel, number: int) -> BeliefState:
        return BeliefState.initial(human, number, self.memory)

    def _implants(self, draw: Tensor) -> dict[str, Tensor]:
        """Return the sites that perception reads, of these draws ``[n, ...]``."""
        return {site: self.draws[site][draw, 0, 0] for site in self.sites}

    def _transition(self, step: int, place: Tensor, implants: Implants, first: bool) -> Transition:
        before = torch.full_like(place, len(self.human.domain.actions))
        if not first:
            before = self.rounds.actions[place, step - 1]
        heard = {name: mask[place] for name, mask in messages_at(self.rounds.told, step).items()}
        return Transition(implants, before, at_step(self.observation, step), heard, place)

    def believed(self, human: HumanModel, place: Tensor, draw: Tensor) -> tuple[Tensor, Tensor]:
        """Return distinct beliefs ``[m, Z]``, and which each pair has at each step ``[n, T]``.

        Args:
            human: the model, or one of people who see otherwise.
            place: rounds ``[n]``.
            draw: their draws ``[n]``.
        """
        implants = self._implants(draw)
        steps = range(self.rounds.actions.shape[1])
        transitions = [self._transition(step, place, implants, step == 0) for step in steps]
        states = self._begin(human, len(place)).through(transitions)
        return states[-1].mean, torch.stack([state.belief for state in states], 1)

    def forgotten(self) -> tuple[Tensor, Tensor]:
        """Return the same of people who forget all earlier steps, at each step."""
        state, which = self._begin(self.human, len(self.round)), []
        implants = self._implants(self.draw)
        for step in range(self.rounds.actions.shape[1]):
            # With the memory of beliefs inferred so far, but none of them believed.
            fresh = replace(
                self._begin(self.human, len(self.round)),
                mean=state.mean,
                memory=state.memory,
                step=step,
            )
            state = fresh.after(self._transition(step, self.round, implants, first=True))
            which.append(state.belief)
        return state.mean, torch.stack(which, 1)

    def acting(self, beliefs: Tensor, which: Tensor, draw: Tensor) -> Tensor:
        """Return log-probabilities ``[n, T, A]`` of actions at beliefs, each under its draw."""
        values, actions = self.human.action_values(beliefs), len(self.human.domain.actions)
        found = beliefs.new_zeros(*which.shape, actions)
        for number in range(self.number):
            own = draw == number
            used, place = which[own].unique(return_inverse=True)
            policy = {name: value[[number]] for name, value in self.draws.items()}
            with conditioned(policy, 1, 1):
                acting = self.human.act(self.human.prior(), beliefs[None, used], values[None, used])
            found[own] = acting.expand(1, 1, len(used), actions)[0, 0, place]
        return found

    def _ratios(self, acting: Tensor, pair: Tensor | slice) -> Tensor:
        """Return log ratios ``[J, T, A]`` to the usual probabilities; 0 in padding."""
        usual = self.log_probabilities[pair]
        compared = self.real[pair][..., None] & (acting != usual)
        return torch.where(compared, acting - usual, 0.0)


def missing(human: HumanModel, unseen: Visibility) -> HumanModel:
    """Return the same model of n people who do not see some items, ``unseen`` ``[n, T, K]``."""

    def look(step: int, masks: Visibility) -> Visibility:
        found = dict(masks)
        for name, mask in unseen.items():
            number, _, items = mask.shape
            if name in masks and _fits(masks[name], number, items):
                found[name] = masks[name] & ~mask[:, step]
        return found

    return _looking(human, look)


def _fits(mask: Tensor, number: int, items: int) -> bool:
    """True if a mask is one of people's items, ``[..., n, K]`` or fewer dimensions."""
    return mask.shape[-1] == items and (mask.dim() == 1 or mask.shape[-2] in (1, number))


def _looking(human: HumanModel, look: Callable[[int, Visibility], Visibility]) -> HumanModel:
    """Return the same model, with all that ``sees`` returns at a step passed through a function."""
    other, now = copy.copy(human), [0]
    perceive, sees = other.perceive, other.sees

    def perceiving(*given: Any) -> Any:
        now[0] = given[-1]
        return perceive(*given)

    def seeing(*given: Any, **named: Any) -> Visibility:
        return look(now[0], sees(*given, **named))

    other.perceive, other.sees = perceiving, seeing  # type: ignore[method-assign]
    return other
