"""The view: what a person sees, hears, remembers and assumes at each step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.row_hashing import as_whole_numbers, exact_keys, random_keys
from mirror_ppl.shapes import broadcast_shapes


@dataclass(frozen=True)
class View:
    """The inputs of a belief: masks ``[..., K]`` and imagined items for each modality.

    Attributes:
        visible: items that are seen, communicated or remembered.
        taken: items that are not, but are taken for granted; empty if there are none.
        imagined: the observation ``[..., K, F]`` in which the taken items are as the person assumes
            them, for modalities with such items.
        still: where nothing is new since the step before ``[...]``, so that the belief does not
            change; ``None`` if it always may.
    """

    visible: Visibility
    taken: Visibility = field(default_factory=dict)
    imagined: Observation = field(default_factory=dict)
    still: Tensor | None = None

    def map(self, function: Callable[[Tensor], Tensor]) -> View:
        """Return a view with a function applied to each mask and imagined item."""
        return View(
            {name: function(mask) for name, mask in self.visible.items()},
            {name: function(mask) for name, mask in self.taken.items()},
            {name: function(value) for name, value in self.imagined.items()},
            None if self.still is None else function(self.still),
        )

    def as_if_seen(self, observation: Observation) -> tuple[Observation, Visibility]:
        """Return an observation in which taken items are as imagined, and masks of the view."""
        visible = {
            name: mask | self.taken[name] if name in self.taken else mask
            for name, mask in self.visible.items()
        }
        imagined = {
            name: torch.where(self.taken[name][..., None], value, observation[name])
            for name, value in self.imagined.items()
            if name in self.taken
        }
        return {**observation, **imagined}, visible

    @classmethod
    def joined(cls, parts: Sequence[View]) -> View:
        """Concatenate views ``[n, K]`` of different people, some of which may assume nothing."""
        numbers = [len(next(iter(part.visible.values()), ())) for part in parts]

        def cat(parts: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
            some = {name: value for part in parts for name, value in part.items()}
            return {
                name: torch.cat(
                    [
                        part[name] if name in part else value.new_zeros(number, *value.shape[1:])
                        for part, number in zip(parts, numbers, strict=True)
                    ]
                )
                for name, value in some.items()
            }

        still = [part.still for part in parts if part.still is not None]
        return cls(
            cat([part.visible for part in parts]),
            cat([part.taken for part in parts]),
            cat([part.imagined for part in parts]),
            torch.cat(still) if still else None,
        )

    def numbers(self) -> Tensor:
        """Return a hash of the view ``[...]``, equal where views are equal."""
        masks = [*self.visible.values(), *self.taken.values()]
        if self.still is not None:
            masks.append(self.still[..., None])
        if not masks:  # the model looks at nothing
            return torch.zeros((), dtype=torch.long)
        shape = broadcast_shapes(*(mask.shape[:-1] for mask in masks))
        joined = torch.cat([mask.expand(*shape, -1) for mask in masks], -1)
        total = (joined.double() @ exact_keys(joined.shape[-1], joined.device)).long().sum(-1)
        for kind, (name, mask) in enumerate(self.taken.items(), 2):
            if name not in self.imagined:
                continue
            imagined = self.imagined[name]
            key = random_keys(imagined.shape[-2:].numel(), imagined.device, kind)
            key = key.view(imagined.shape[-2:])
            if 2 * int(mask.sum()) > mask.numel():
                for part, own in zip(imagined.unbind(-1), key.unbind(-1), strict=True):
                    total = total + torch.where(mask, as_whole_numbers(part) * own, 0).sum(-1)
                continue
            # Where few items are taken for granted, the others are skipped.
            place = mask.nonzero(as_tuple=True)
            value = as_whole_numbers(imagined.expand(*mask.shape, -1)[place])
            value = (value * key[place[-1]]).sum(-1)
            each = torch.zeros(mask.shape[:-1], dtype=torch.long, device=mask.device)
            total = total + each.index_put(place[:-1], value, accumulate=True)
        return total
