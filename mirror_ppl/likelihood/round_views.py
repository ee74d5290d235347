"""Distinct views of one round."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from mirror_ppl.domains import Observation, Visibility
from mirror_ppl.likelihood.chain import Chain
from mirror_ppl.likelihood.view_table import NO_VIEW
from mirror_ppl.models.belief_tracking import CHUNK, BeliefState, Memory, Transition
from mirror_ppl.models.human import HumanModel, at_step, messages_at
from mirror_ppl.row_hashing import distinct_rows


@dataclass(frozen=True)
class RoundViews:
    """V distinct views of one round, and the moments that they share; see :class:`ViewTable`.

    Attributes:
        moments: ``[V, T]``.
        belief: ``[N, Z]``.
        values: ``[N, A]``.
        acted: ``[N]``.
        sights: the view under each value of attention, ``[U, G]``; ``None`` if a sight is a view.
        rounds: of each sight ``[U]``, if there is more than one round.
        chain: attention that is summed out exactly, of one person; views are of its spans.
    """

    moments: Tensor
    belief: Tensor
    values: Tensor
    acted: Tensor
    sights: Tensor | None = None
    rounds: Tensor | None = None
    chain: Chain | None = None

    def __len__(self) -> int:
        """The number of sights U."""
        if self.chain is not None:
            return self.chain.sights
        return len(self.moments if self.sights is None else self.sights)

    def lengthened(self, steps: int) -> RoundViews:
        """The same with padding at the end, as part of a table of longer rounds."""
        more = steps - self.moments.shape[1]
        if not more:
            return self
        return replace(self, moments=pad(self.moments, [0, more], value=NO_VIEW))

    def kept(self, sights: Tensor) -> RoundViews:
        """Only some sights, and the views and moments that they have."""
        if self.chain is not None:
            chain, views = self.chain.kept(sights)
            return replace(replace(self, chain=None).kept(views), chain=chain)
        if self.sights is not None:
            views, place = torch.unique(self.sights[sights], return_inverse=True)
            rounds = None if self.rounds is None else self.rounds[sights]
            alone = replace(self, sights=None, rounds=None)
            return replace(alone.kept(views), sights=place, rounds=rounds)
        moments = self.moments[sights]
        real = moments != NO_VIEW
        used, place = torch.unique(moments[real], return_inverse=True)
        moments = moments.clone()
        moments[real] = place
        if not len(used):  # of padding alone; act() is asked about something all the same
            used = used.new_zeros(1)
        return RoundViews(moments, self.belief[used], self.values[used], self.acted[used])


@torch.no_grad()
def round_views(
    human: HumanModel,
    implants: Mapping[str, Tensor],
    number: int,
    observation: Observation,
    told: Visibility,
    actions: Tensor,
    steps: int,
) -> tuple[RoundViews, Tensor]:
    """Distinct views of one round, and which of them each combination has.

    Args:
        human: the model of people.
        implants: combinations of values ``[M]`` of the discrete sites that perception reads.
        number: M.
        observation: ``[1, T, ...]``.
        told: ``[1, T, K]``.
        actions: ``[1, T]``.
        steps: how many of the T steps are no padding.
    """
    state = BeliefState.initial(human, number, Memory.of_round(human, observation))
    state, numbers = moments_along(state, implants, observation, told, actions, range(steps))
    return views_of_moments(state, numbers)


def moments_along(
    state: BeliefState,
    implants: Mapping[str, Tensor],
    observation: Observation,
    told: Visibility,
    actions: Tensor,
    steps: range,
) -> tuple[BeliefState, Tensor]:
    """Track beliefs through some steps of a round; arguments as of :func:`round_views`.

    Returns:
        The state after these steps, and the number of the moment at each, ``[n, T]``, ``NO_VIEW``
        outside of them: a belief of the state and what was done there.
    """
    number, action_count = len(state.belief), len(state.human.domain.actions)
    moments = state.belief.new_full((number, actions.shape[1]), NO_VIEW)
    transitions = []
    for step in steps:
        before = actions[0, step - 1] if step else actions.new_tensor(action_count)
        now, heard = at_step(observation, step), messages_at(told, step)
        transitions.append(Transition(implants, before.expand(number), now, heard))
    states = state.through(transitions) if steps else []
    for step, now in zip(steps, states, strict=True):
        moments[:, step] = now.belief * action_count + actions[0, step]
    return [state, *states][-1], moments


def views_of_moments(state: BeliefState, numbers: Tensor) -> tuple[RoundViews, Tensor]:
    """Distinct rows of the moments ``[n, T]`` of a round, and which of them each row is ``[n]``."""
    human = state.human
    first, which = distinct_rows(numbers)
    moments = numbers[first]
    real = moments != NO_VIEW
    used, place = moments[real].unique(return_inverse=True)
    moments[real] = place
    if not len(used):  # of padding alone; act() is asked about something all the same
        used = used.new_zeros(1)
    action_count = len(human.domain.actions)
    belief = state.mean[used // action_count]
    values = torch.cat([human.action_values(some) for some in belief.split(CHUNK)])
    return RoundViews(moments, belief, values, used % action_count), which
