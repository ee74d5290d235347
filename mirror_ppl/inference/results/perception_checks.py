"""Checks of perception: do actions fit better if the person missed or forgot something?

For some posterior draws the recorded rounds are perceived once more, otherwise than the draw says.
With ``p_d`` the probabilities of actions then, and ``w_d`` those of the ways to perceive::

    missed    each item that comes into sight is noticed at once (w_0 = 1/2), or 1, 2 or 3 steps
              later (1/4, 1/8, 1/8)
    forgot    at each step all earlier steps are forgotten (w_1 = 1/2), or not

    T = sum_i log sum_d w_d prod_t p_d(a_t) / p(a_t)         i: each such item, or each step

This is the log likelihood ratio of such people to those of the model, as if what happens to one
item did not depend on what happens to others. It is compared with that of replicates, as the
statistics of :mod:`mirror_ppl.inference.results.checks` are; p-values are one-sided.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.inference.results.checks import REPLICATES, more_often
from mirror_ppl.likelihood.combinations import perceived_sites
from mirror_ppl.likelihood.enumeration import acts_on_beliefs, conditioned
from mirror_ppl.likelihood.round_views import Rounds
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.models.belief_tracking import BeliefState, Memory, Transition
from mirror_ppl.models.family.any_kind import OneOfKinds
from mirror_ppl.models.family.several import SeveralBeliefs
from mirror_ppl.models.human import HumanModel, Implants, at_step, has_own_program, messages_at

DRAWS = 4
"""Posterior draws under which rounds are perceived once more."""
DELAYS = {1: 1 / 4, 2: 1 / 8, 3: 1 / 8}
"""Steps after which an item in sight is noticed late, and their probabilities."""
FORGETS = 1 / 2
"""Probability of forgetting at a step."""
EVENTS = 100
"""Largest number of items that come into sight, of each draw; a random subset of more."""


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
        or a likelihood power, or whose percepts affect actions other than through beliefs.
    """
    several = isinstance(human, SeveralBeliefs | OneOfKinds)
    if several or has_own_program(human) or human.has_round_latents:
        return {}
    # With a power below 1, errors of the robot's values count more than what perception changes.
    if human.likelihood_power != 1 or not bool(rounds.mask.any()):
        return {}
    sites = perceived_sites(human)
    if not acts_on_beliefs(human, sites):
        return {}
    held = len(next(iter(draws.values())))
    some = torch.linspace(0, held - 1, min(held, DRAWS)).round().long()
    own = {name: value[some] for name, value in draws.items()}
    again = PerceivedOtherwise(human, tuple(sites), rounds_of(rounds, 0), own)
    replicates = again.replicates(generator)
    found = {"missed": again.missed(replicates, generator), "forgot": again.forgot(replicates)}
    return {name: value for name, value in found.items() if value is not None}


@dataclass(frozen=True)
class PerceivedOtherwise:
    """Recorded rounds of one person, perceived once more.

    n stands for pairs of draw and round, J for items that come into sight.

    Attributes:
        human: the model of people.
        sites: the discrete sites that perception reads.
        rounds: R rounds.
        draws: draws of the implants ``[S, 1, 1, ...]``.
    """

    human: HumanModel
    sites: tuple[str, ...]
    rounds: Rounds
    draws: Mapping[str, Tensor]

    @cached_property
    def number(self) -> int:
        """Number of draws."""
        return len(next(iter(self.draws.values())))

    @cached_property
    def row(self) -> Tensor:
        """Round of each pair ``[n]``."""
        return torch.arange(len(self.rounds), device=self.device).repeat(self.number)

    @cached_property
    def drawn(self) -> Tensor:
        """Draw of each pair ``[n]``."""
        draw = torch.arange(self.number, device=self.device)
        return draw.repeat_interleave(len(self.rounds))

    @property
    def device(self) -> torch.device:
        """The device of the rounds."""
        return self.rounds.actions.device

    @cached_property
    def usual(self) -> tuple[Tensor, dict[int, Visibility]]:
        """Log-probabilities ``[n, T, A]`` of actions as the model has them, and what is seen.

        The items seen at each step are ``[n, K]``; there are none if ``perceive`` does not look.
        """
        seen: dict[int, Visibility] = {}

        def sees(implants: Implants, observation: Observation, step: int) -> Visibility:
            masks = self.human.sees(implants, observation, step)
            own = {name: mask.expand(len(self.row), -1) for name, mask in masks.items()}
            seen.setdefault(step, own)  # later at a step: whether what is expected would be seen
            return masks

        believed = self._believed(_seeing(self.human, sees), self.row, self.drawn)
        return self._acting(*believed, self.drawn), seen

    @property
    def log_probabilities(self) -> Tensor:
        """Log-probabilities ``[n, T, A]`` of actions, as the model has them."""
        return self.usual[0]

    def replicates(self, generator: torch.Generator) -> Tensor:
        """Draw actions ``[n, T, k]`` as the model has them."""
        times = -(-REPLICATES // self.number)
        probabilities = self.log_probabilities.exp().cpu()
        drawn = torch.multinomial(
            probabilities.flatten(0, 1), times, replacement=True, generator=generator
        )
        return drawn.view(*probabilities.shape[:2], times).to(self.device)

    def missed(self, replicates: Tensor, generator: torch.Generator) -> float | None:
        """Return the p-value of a person who notices items late; ``None`` if none are in sight."""
        rows, begins, masks = self._events(generator)
        if not len(rows):
            return None
        each = rows.repeat(len(DELAYS))
        row, drawn = self.row[each], self.drawn[each]
        steps = torch.arange(self.rounds.actions.shape[1], device=self.device)
        late = torch.tensor(list(DELAYS), device=self.device)[:, None, None]
        now = (steps >= begins[:, None]) & (steps < begins[:, None] + late)  # [D, J, T]
        unseen = {
            name: (mask[:, None] & now[..., None]).flatten(0, 1) for name, mask in masks.items()
        }
        believed = self._believed(missing(self.human, unseen), row, drawn)
        ratios = self._ratios(self._acting(*believed, drawn), each)
        ratios = ratios.unflatten(0, (len(DELAYS), -1))
        weights = torch.tensor(list(DELAYS.values()), device=self.device)[:, None, None]

        def statistic(actions: Tensor, own: Tensor) -> Tensor:
            chosen = actions[rows[own]].expand(len(DELAYS), -1, -1, -1)
            found = ratios[:, own].gather(-1, chosen).sum(2)
            return torch.log1p((weights * torch.expm1(found)).sum(0)).sum(0)

        return self._p_value(statistic, self.drawn[rows], replicates)

    def forgot(self, replicates: Tensor) -> float:
        """Return the p-value of a person who forgets earlier steps."""
        ratios = self._ratios(self._acting(*self._forgotten(), self.drawn), slice(None))

        def statistic(actions: Tensor, own: Tensor) -> Tensor:
            chosen = ratios[own].gather(-1, actions[own])
            return torch.log1p(FORGETS * torch.expm1(chosen)).sum((0, 1))

        return self._p_value(statistic, self.drawn, replicates)

    def _events(self, generator: torch.Generator) -> tuple[Tensor, Tensor, Visibility]:
        """Return where items come into sight: pairs ``[J]``, steps ``[J]``, items ``[J, K]``."""
        _, seen = self.usual
        if not seen:
            return self.row[:0], self.row[:0], {}
        sizes = {name: mask.shape[-1] for name, mask in seen[0].items()}
        masks = torch.stack([torch.cat(list(one.values()), -1) for one in seen.values()], 1)
        fresh = masks.clone()
        fresh[:, 1:] &= ~masks[:, :-1]
        fresh &= self.rounds.real[self.row][..., None]
        places = fresh.nonzero()
        order = torch.randperm(len(places), generator=generator)[: EVENTS * self.number]
        rows, steps, items = places[order.sort().values.to(self.device)].unbind(1)
        single = torch.nn.functional.one_hot(items, masks.shape[-1]).bool()
        parts = single.split(list(sizes.values()), -1)
        return rows, steps, dict(zip(sizes, parts, strict=True))

    @cached_property
    def observation(self) -> Observation:
        """Observations before actions, ``[R, T, ...]``."""
        steps = self.rounds.actions.shape[1]
        return {name: value[:, :steps] for name, value in self.rounds.observation.items()}

    def _implants(self, drawn: Tensor) -> dict[str, Tensor]:
        """Return the discrete sites that perception reads, of these draws ``[n]``."""
        return {site: self.draws[site][drawn, 0, 0] for site in self.sites}

    def _step(self, step: int, row: Tensor, implants: Implants, first: bool) -> Transition:
        before = torch.full_like(row, len(self.human.domain.actions))
        if not first:
            before = self.rounds.actions[row, step - 1]
        heard = {name: mask[row] for name, mask in messages_at(self.rounds.told, step).items()}
        return Transition(implants, before, at_step(self.observation, step), heard, row)

    @cached_property
    def memory(self) -> Memory:
        """A memory of no beliefs of these rounds."""
        return Memory.of_rounds(self.human, self.rounds.observation)

    def _begin(self, human: HumanModel, number: int) -> BeliefState:
        return BeliefState.initial(human, number, self.memory)

    def _believed(self, human: HumanModel, row: Tensor, drawn: Tensor) -> tuple[Tensor, Tensor]:
        """Return distinct beliefs ``[m, Z]``, and which each has at each step ``[n, T]``.

        Args:
            human: the model, or one of people who see otherwise.
            row: rounds ``[n]``.
            drawn: their draws ``[n]``.
        """
        implants = self._implants(drawn)
        steps = range(self.rounds.actions.shape[1])
        transitions = [self._step(step, row, implants, step == 0) for step in steps]
        states = self._begin(human, len(row)).through(transitions)
        return states[-1].mean, torch.stack([state.belief for state in states], 1)

    def _forgotten(self) -> tuple[Tensor, Tensor]:
        """Return the same of people who forget all earlier steps, at each."""
        state, which = self._begin(self.human, len(self.row)), []
        implants = self._implants(self.drawn)
        for step in range(self.rounds.actions.shape[1]):
            # With the memory of beliefs inferred so far, but none of them believed.
            fresh = replace(
                self._begin(self.human, len(self.row)),
                mean=state.mean,
                memory=state.memory,
                step=step,
            )
            state = fresh.after(self._step(step, self.row, implants, first=True))
            which.append(state.belief)
        return state.mean, torch.stack(which, 1)

    def _acting(self, beliefs: Tensor, which: Tensor, drawn: Tensor) -> Tensor:
        """Return log-probabilities ``[n, T, A]`` of actions at beliefs, each under its draw."""
        values, actions = self.human.action_values(beliefs), len(self.human.domain.actions)
        found = beliefs.new_zeros(*which.shape, actions)
        for draw in range(self.number):
            own = drawn == draw
            used, place = which[own].unique(return_inverse=True)
            policy = {name: value[[draw]] for name, value in self.draws.items()}
            with conditioned(policy, 1, 1):
                acting = self.human.act(self.human.prior(), beliefs[None, used], values[None, used])
            found[own] = acting.reshape(-1, actions)[place]
        return found

    def _ratios(self, acting: Tensor, rows: Tensor | slice) -> Tensor:
        """Return log ratios ``[J, T, A]`` to the model's probabilities; 0 in padding."""
        usual = self.log_probabilities[rows]
        compared = self.rounds.real[self.row][rows][..., None] & (acting != usual)
        return torch.where(compared, acting - usual, 0.0)

    def _p_value(
        self, statistic: Callable[[Tensor, Tensor], Tensor], drawn: Tensor, replicates: Tensor
    ) -> float:
        """Return the mean p-value over draws.

        Args:
            statistic: of actions ``[n, T, k]``, given those events ``[J]`` that count; ``[k]``.
            drawn: draw of each event ``[J]``.
            replicates: actions ``[n, T, k]``.
        """
        recorded, found = self.rounds.actions[self.row][..., None], []
        for draw in range(self.number):
            own = (drawn == draw).nonzero().squeeze(-1)
            found.append(
                more_often(
                    statistic(replicates, own).double()[None],
                    statistic(recorded, own).double()[None],
                )
            )
        return sum(found) / len(found)


def missing(human: HumanModel, unseen: Visibility) -> HumanModel:
    """Return the same model of n people who do not see some items, ``unseen`` ``[n, T, K]``."""

    def sees(implants: Implants, observation: Observation, step: int) -> Visibility:
        masks = human.sees(implants, observation, step)
        return {name: mask & ~unseen[name][:, step] for name, mask in masks.items()}

    return _seeing(human, sees)


def _seeing(human: HumanModel, sees: Callable[..., Visibility]) -> HumanModel:
    """Return the same model with another method ``sees``."""
    other = copy.copy(human)
    other.sees = sees  # type: ignore[method-assign]
    return other
