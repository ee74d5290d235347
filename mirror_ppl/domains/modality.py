"""Channels through which items are observed and communicated."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.errors import InputError, UnknownNameError


@dataclass(frozen=True)
class Modality:
    """A channel through which items can be observed and communicated.

    Args:
        name: name of the channel, a key of observations and visibilities.
        items: names of its K items.
        features: names of the F features of an item.
        units: unit of each feature.
        scales: typical size of each feature, by which decoders normalize.
        cost_coefficient: communicating n items in one step costs ``cost_coefficient * n**2``
            units of reward (supplement, Table I).
        image: rows, columns and colours of an item that is an image; its features are the pixels
            in that order.
        utterances: for spoken items, the sentences about each by the value of its one feature: U
            sentences per item, all different, for the values 0 to U - 1.
        groups: names of sets of items that are communicated together, with the indices of their
            items; each item is in one of them. Unless given, each item is communicated alone.
    """

    name: str
    items: tuple[str, ...]
    features: tuple[str, ...]
    units: tuple[str, ...]
    scales: tuple[float, ...]
    cost_coefficient: float
    image: tuple[int, int, int] | None = None
    utterances: tuple[tuple[str, ...], ...] = ()
    groups: tuple[tuple[str, tuple[int, ...]], ...] = ()

    def __post_init__(self) -> None:
        if not (math.isfinite(self.cost_coefficient) and self.cost_coefficient >= 0):
            raise InputError(
                f"modality {self.name!r}: cost_coefficient must be a number of at least 0, not "
                f"{self.cost_coefficient}"
            )
        if not len(self.features) == len(self.units) == len(self.scales):
            raise InputError(f"modality {self.name!r}: each feature needs a unit and a scale")
        if self.image is not None and math.prod(self.image) != len(self.features):
            raise InputError(f"modality {self.name!r}: an image's features are its pixels")
        if self.utterances and len(self.utterances) != len(self.items):
            raise InputError(
                f"modality {self.name!r}: each item needs a tuple of its utterances, expected "
                f"{len(self.items)}, found {len(self.utterances)}"
            )
        known = [_heard(sentence) for about in self.utterances for sentence in about]
        if len({len(about) for about in self.utterances}) > 1 or len(set(known)) < len(known):
            raise InputError(
                f"modality {self.name!r}: all items need equally many utterances, all different"
            )
        grouped = sorted(place for _, places in self.groups for place in places)
        if self.groups and grouped != list(range(len(self.items))):
            raise InputError(f"modality {self.name!r}: each item belongs in exactly one group")
        if len({name for name, _ in self.groups}) < len(self.groups):
            raise InputError(f"modality {self.name!r}: groups need different names")

    @property
    def communicated(self) -> tuple[str, ...]:
        """Names of what can be communicated: of groups, or else of items."""
        return tuple(name for name, _ in self.groups) or self.items

    def items_of(self, communicated: Tensor) -> Tensor:
        """Return masks of items ``[..., K]`` from those of what is communicated ``[..., N]``."""
        if not self.groups:
            return communicated
        owner = torch.empty(len(self.items), dtype=torch.long, device=communicated.device)
        for group, (_, places) in enumerate(self.groups):
            owner[list(places)] = group
        return communicated[..., owner]

    def groups_in(self, mask: Tensor) -> Tensor:
        """Return which groups ``[..., N]`` have all their items in a mask ``[..., K]``."""
        if not self.groups:
            return mask
        return torch.stack([mask[..., list(places)].all(-1) for _, places in self.groups], -1)

    def cost(self, number: Tensor) -> Tensor:
        """Return the cost in units of reward of communicating ``number`` items (or groups)."""
        return self.cost_coefficient * number.to(torch.get_default_dtype()) ** 2

    def understand(self, utterance: str) -> tuple[int, int]:
        """Return the index of an utterance's item, and its index among that item's utterances.

        Args:
            utterance: one of ``utterances``, in any case.

        Raises:
            UnknownNameError: it is none of them; lists them.
            TypeError: it is not a string.
        """
        if not isinstance(utterance, str):
            raise TypeError(f"an utterance is a string, not {utterance!r}")
        known = [sentence for about in self.utterances for sentence in about]
        places = {_heard(sentence): place for place, sentence in enumerate(known)}
        if _heard(utterance) not in places:
            raise UnknownNameError.of("utterance", utterance, known)
        return divmod(places[_heard(utterance)], len(self.utterances[0]))


def _heard(sentence: str) -> str:
    """A sentence in lower case and with single spaces."""
    return " ".join(sentence.lower().split())
