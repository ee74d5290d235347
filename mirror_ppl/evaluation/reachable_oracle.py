"""The oracle for worlds of few states: optimal messages by backward induction.

Like `mirror_ppl.domains.driving.oracle`, for domains whose joint states of world and mind are few
enough to be listed. The states that are reachable under any messages and actions are listed once,
whatever the time, and backward induction over the steps of a round runs over that list. A person's
next state of mind may be random; the oracle knows their present one and the probabilities of the
next.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.communication.messages import Channels
from mirror_ppl.domains.base import Domain, map_state, total_reward
from mirror_ppl.people.base import SimulatedPeople
from mirror_ppl.row_hashing import as_whole_numbers, distinct_rows, row_numbers

MOST_ITEMS = 2
"""Items of the largest messages considered: later steps can communicate more."""
CHUNK = 256
"""States that are expanded at once; bounds memory."""


@dataclass(frozen=True)
class _Wave:
    """Choices in some states; a choice is a state with a message. C choices, G minds, A actions.

    Attributes:
        node: the state of each choice ``[C]``, from 0 within the wave.
        message: flags ``[C, items]``.
        chance: probability of each state of mind then ``[C, G]``.
        probability: of the person's actions ``[C, G, A]``.
        reward: of the actions in each state ``[n, A]``.
        following: names of the next states, ``[C, G, A]``.
        name: of each distinct next state ``[m]``; ``state`` and ``memory`` ``[m]`` hold them.
    """

    node: Tensor
    message: Tensor
    chance: Tensor
    probability: Tensor
    reward: Tensor
    following: Tensor
    name: Tensor
    state: Any
    memory: Any


class ReachableOracle:
    """Optimal messages for one person in given rounds.

    Args:
        person: the true person, P = 1.
        start: states ``[R]`` in which rounds begin.

    Attributes:
        value: expected return of each round, costs of messages taken off, ``[R]``.
    """

    def __init__(self, person: SimulatedPeople, start: Any) -> None:
        self.person, self.domain = person, person.domain
        self.channels = Channels(self.domain)
        self._messages = _small_messages(self.domain)
        rounds = len(next(iter(vars(start).values())))
        memory = map_state(lambda part: part[0], person.start(rounds))
        begin = _names(person, start, memory)
        names, waves = self._everything(start, memory, begin)
        self._sorted, self._order = names.sort()
        self._solve(waves)
        self.value = self._value[self._place(begin)]

    def messages(self, step: int, state: Any, memory: Any) -> Tensor:
        """Flags ``[R, items]`` of the optimal messages in states ``[1, R]`` at a step."""
        names = _names(self.person, *(map_state(lambda p: p[0], part) for part in (state, memory)))
        return self._flags[self._best[step, self._place(names)]]

    def _place(self, names: Tensor) -> Tensor:
        return self._order[torch.searchsorted(self._sorted, names)]

    def _everything(self, state: Any, memory: Any, names: Tensor) -> tuple[Tensor, list[_Wave]]:
        """Names of all reachable states, and the choices in each, in that order."""
        first, _ = distinct_rows(names[:, None])
        waiting = [(names[first], _at(state, first), _at(memory, first))]
        order, waves = [names[first]], []
        known = names[first].sort().values
        while waiting:
            names, state, memory = waiting.pop(0)
            for rows in torch.arange(len(names)).split(CHUNK):
                wave = self._look(_at(state, rows), _at(memory, rows))
                fresh = (~_within(known, wave.name)).nonzero().squeeze(-1)
                name = wave.name[fresh]
                if len(fresh):
                    waiting.append((name, _at(wave.state, fresh), _at(wave.memory, fresh)))
                    known = torch.cat([known, name]).sort().values
                    order.append(name)
                waves.append(replace(wave, state=None, memory=None))
        return torch.cat(order), waves

    def _look(self, state: Any, memory: Any) -> _Wave:
        """Expand states ``[n]``: their choices and the next states."""
        domain, person, number = self.domain, self.person, len(self.domain.actions)
        observation = domain.observe(state)
        over = domain.over(state)
        allowed = self.channels.join(domain.communicable(observation)) & ~over[:, None]
        node, which = (self._messages <= allowed[:, None]).all(-1).nonzero(as_tuple=True)
        message = self._messages[which]
        seen = {name: value[None, node] for name, value in observation.items()}
        told = {name: mask[None] for name, mask in self.channels.split(message).items()}
        before = map_state(lambda part: part[None, node], memory)
        chance, after, probability = (
            part[0] if isinstance(part, Tensor) else map_state(lambda each: each[0], part)
            for part in person.branches(before, seen, told)
        )
        # Of messages with the same effect on the person's mind, the cheapest is enough.
        minds = _numbers(person.kept(after), 1)
        effect = torch.cat([node[:, None], minds, as_whole_numbers(chance)], -1)
        order = self.channels.cost(message).argsort(stable=True)
        first, _ = distinct_rows(effect[order])
        choice = order[first].sort().values
        node, message, chance = node[choice], message[choice], chance[choice]
        probability, after = probability[choice], _at(after, choice)

        action = torch.arange(number).expand(len(allowed), -1)
        own = map_state(lambda part: part[:, None].expand(-1, number, *part.shape[1:]), state)
        following = domain.transition(own, action)
        reward = total_reward(domain.rewards(own, action, following))
        minds = chance.shape[1]
        next_state = map_state(
            lambda part: part[node][:, None].expand(-1, minds, *part.shape[1:]).flatten(0, 2),
            following,
        )
        next_memory = map_state(
            lambda part: part[:, :, None].expand(-1, -1, number, *part.shape[2:]).flatten(0, 2),
            after,
        )
        done = torch.arange(number).repeat(len(node) * minds)
        next_memory = _at(person.acted(map_state(_one_person, next_memory), done[None]), 0)
        names = _names(person, next_state, next_memory)
        real = (chance > 0)[..., None].expand(-1, -1, number).flatten()
        place = real.nonzero().squeeze(-1)
        first, _ = distinct_rows(names[place][:, None])
        first = place[first]
        return _Wave(
            node,
            message,
            chance,
            probability,
            reward,
            names.masked_fill(~real, int(names[first[0]])).view(-1, minds, number),
            names[first],
            _at(next_state, first),
            _at(next_memory, first),
        )

    def _solve(self, waves: list[_Wave]) -> None:
        """Backward induction over the steps of a round."""
        sizes = torch.tensor([len(wave.reward) for wave in waves])
        offset = sizes.cumsum(0) - sizes
        node = torch.cat([wave.node + first for wave, first in zip(waves, offset, strict=True)])
        self._flags = torch.cat([wave.message for wave in waves])
        chance = torch.cat([wave.chance for wave in waves])
        reward = torch.cat([wave.reward for wave in waves])
        weight = chance[..., None] * torch.cat([wave.probability for wave in waves])
        following = self._place(torch.cat([wave.following for wave in waves]))
        now = (weight * reward[node][:, None]).sum((1, 2)) - self.channels.cost(self._flags)
        value = torch.zeros(len(reward))
        best = []
        number = torch.arange(len(node))
        for _ in range(self.domain.horizon):
            worth = now + (weight * value[following]).sum((1, 2))
            value = torch.full((len(reward),), -torch.inf)
            value = value.scatter_reduce(0, node, worth, "amax")
            # Silence comes first among the choices of a state, and wins ties.
            good = worth >= value[node] - 1e-6  # noqa: PLR2004 - of rounding
            first = torch.full((len(reward),), len(node))
            best.append(first.scatter_reduce(0, node[good], number[good], "amin"))
        self._best = torch.stack(best[::-1])
        self._value = value


def _small_messages(domain: Domain) -> Tensor:
    """Messages of few items, flags ``[M, items]``, silence first; no items that all people know."""
    channels = Channels(domain)
    known = channels.join(domain.known(domain.nothing_known()))
    single = torch.eye(len(channels), dtype=torch.bool)[~known]
    messages = [torch.zeros_like(single[:1])]
    for _ in range(MOST_ITEMS):
        more = (messages[-1][:, None] | single).flatten(0, 1)
        messages.append(more)
    every = torch.cat(messages)
    first, _ = distinct_rows(every.long())
    return every[first.sort().values]


def _one_person(part: Tensor) -> Tensor:
    return part[None]


def _at(parts: Any, rows: Tensor | int) -> Any:
    return map_state(lambda part: part[rows], parts)


def _within(known: Tensor, names: Tensor) -> Tensor:
    """True for names that are among the sorted ones."""
    place = torch.searchsorted(known, names).clamp(max=len(known) - 1)
    return known[place] == names


def _numbers(parts: Any, dimensions: int) -> Tensor:
    """Flatten all tensors to whole numbers ``[..., N]``, but for their leading dimensions."""
    rows = [as_whole_numbers(part[..., None]).flatten(dimensions) for part in vars(parts).values()]
    return torch.cat(rows, -1)


def _names(person: SimulatedPeople, state: Any, memory: Any) -> Tensor:
    """A whole number ``[n]`` for each state of world and mind, equal for equal states."""
    rows = torch.cat([_numbers(state, 1), _numbers(person.kept(memory), 1)], -1)
    return row_numbers(rows, 2)
