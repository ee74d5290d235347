"""Messages: the items communicated in one step, and their cost.

A message is a set of items of the domain's modalities. Planners handle many at once as *flags*:
boolean ``[..., N]``, one for each item of each modality in the order of the domain; where a
modality has groups, one for each group. Shape letters are those of `mirror_ppl.domains.base`; in
addition, N is the number of all flags.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

import torch
from torch import Tensor

from mirror_ppl.domains.base import Domain, Visibility, require_known
from mirror_ppl.errors import UnknownNameError


@dataclass(frozen=True)
class Message:
    """The items communicated in one step.

    Attributes:
        items: names of the communicated items by modality; every modality is a key.
    """

    items: Mapping[str, tuple[str, ...]]

    def __iter__(self) -> Iterator[tuple[str, str]]:
        """Iterate over pairs of modality and item."""
        return ((name, item) for name, items in self.items.items() for item in items)

    def __len__(self) -> int:
        return sum(map(len, self.items.values()))

    def __bool__(self) -> bool:
        """True if anything is communicated."""
        return len(self) > 0

    def __str__(self) -> str:
        if not self:
            return "silence"
        return "; ".join(
            f"{name}: {', '.join(items)}" for name, items in self.items.items() if items
        )


class Channels:
    """The layout of flags: which flag is which item, or group, of which modality.

    Args:
        domain: whose modalities they are.
    """

    def __init__(self, domain: Domain) -> None:
        self.modalities = domain.modalities
        self.sizes = [len(modality.communicated) for modality in domain.modalities]
        self.pairs = [(m.name, item) for m in domain.modalities for item in m.communicated]

    def __len__(self) -> int:
        """Return the number of all flags N."""
        return len(self.pairs)

    def flag_of(self, modality: str, item: int) -> int:
        """Return the flag of an item of a modality, or of the group to which it belongs."""
        begin = 0
        for own, size in zip(self.modalities, self.sizes, strict=True):
            if own.name == modality:
                groups = [place for place, (_, items) in enumerate(own.groups) if item in items]
                return begin + (groups[0] if groups else item)
            begin += size
        raise UnknownNameError.of("modality", modality, [own.name for own in self.modalities])

    def split(self, flags: Tensor) -> Visibility:
        """Split flags ``[..., N]`` into masks ``[..., K]`` by modality."""
        parts = flags.split(self.sizes, -1)
        return {m.name: m.items_of(part) for m, part in zip(self.modalities, parts, strict=True)}

    def join(self, masks: Visibility) -> Tensor:
        """Join masks ``[..., K]`` by modality into flags ``[..., N]``: groups with all items."""
        return torch.cat([m.groups_in(masks[m.name]) for m in self.modalities], -1)

    def marginal(self, number: int) -> Tensor:
        """Return each item's marginal cost ``[N]`` as the n-th of its modality in a step."""
        count = torch.tensor([number, number - 1])
        added = [m.cost(count)[0] - m.cost(count)[1] for m in self.modalities]
        return torch.stack(added).repeat_interleave(torch.tensor(self.sizes))

    def cost(self, flags: Tensor) -> Tensor:
        """Return costs ``[...]`` in units of reward of flags ``[..., N]`` (supplement, Table I)."""
        parts = flags.split(self.sizes, -1)
        costs = [m.cost(part.sum(-1)) for m, part in zip(self.modalities, parts, strict=True)]
        return torch.stack(costs).sum(0)

    def message(self, flags: Tensor) -> Message:
        """Return the message of flags ``[N]``."""
        chosen = [pair for pair, flag in zip(self.pairs, flags.tolist(), strict=True) if flag]
        return Message(
            {
                modality.name: tuple(item for name, item in chosen if name == modality.name)
                for modality in self.modalities
            }
        )

    def flags(self, items: Mapping[str, tuple[str, ...] | list[str]]) -> Tensor:
        """Return flags ``[N]`` of named items by modality, as in :attr:`Message.items`.

        Raises:
            UnknownNameError: there is no such modality or item.
        """
        flags = torch.zeros(len(self), dtype=torch.bool)
        for name, chosen in items.items():
            require_known(name, "modality", tuple(modality.name for modality in self.modalities))
            known = tuple(item for modality, item in self.pairs if modality == name)
            for item in chosen:
                flags[self.pairs.index((name, require_known(item, f"{name} item", known)))] = True
        return flags


def count_messages(allowed: Tensor, most: int | None = None) -> int:
    """Return the number of messages that :func:`every_message` returns."""
    number = int(allowed.sum())
    most = number if most is None else min(number, most)
    return sum(math.comb(number, size) for size in range(1 + most))


def every_message(allowed: Tensor, most: int | None = None) -> Tensor:
    """Return all messages ``[C, N]`` of at most ``most`` allowed items ``[N]``, silence first."""
    places = allowed.nonzero().squeeze(-1)
    if most is not None and most < len(places):
        sizes = range(1 + most)
        chosen = [few for size in sizes for few in combinations(places.tolist(), size)]
        messages = allowed.new_zeros(len(chosen), len(allowed))
        for message, few in zip(messages, chosen, strict=True):
            message[list(few)] = True
        return messages
    numbers = torch.arange(2 ** len(places), device=allowed.device)
    bits = (numbers[:, None] >> torch.arange(len(places), device=allowed.device)) & 1
    messages = allowed.new_zeros(len(numbers), len(allowed))
    messages[:, places] = bits.bool()
    return messages
