"""Models of people who act on one of several beliefs, with probabilities of their own.

The program is unchanged; a belief is the concatenation of several of the robot's::

    zH_t = (zH_t^1, ..., zH_t^N)                             each as the robot would infer it
    a_t  ~ sum_i w_i(psi) p(a | zH_t^i, psi)                 i is drawn anew at every step

The belief acted on is summed out at each step, so there is no latent per step. The model assumes
that these choices are independent across steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation
from mirror_ppl.models.human import HumanModel, Implants
from mirror_ppl.models.implants import LEAST_PROBABILITY
from mirror_ppl.models.networks import Gaussian
from mirror_ppl.models.view import View
from mirror_ppl.row_hashing import as_whole_numbers, distinct_rows

NOW = "now"
"""Name of the belief, and of the view, of the package's own model."""
DRAWS = 3
"""Dimensions of a site's values if they have draws: ``[S, P, 1]``."""
MANY_DRAWS = 64
"""Number of draws from which finding equal beliefs saves time."""


class SeveralBeliefs(HumanModel):
    """Base class: acts on one of several beliefs, drawn anew at every step.

    Derive from it and add :attr:`views`, :attr:`beliefs` (updated by :meth:`after`) and the
    probabilities of acting on them (:meth:`shares`), each to those of ``super()``.
    """

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the views from which beliefs are inferred."""
        return (NOW,)

    @property
    def beliefs(self) -> tuple[str, ...]:
        """Names of the N beliefs."""
        return (NOW,)

    def after(
        self,
        before: Mapping[str, Tensor],
        evidence: Mapping[str, Tensor],
        action: Tensor,
        still: Tensor | None,
    ) -> dict[str, Tensor]:
        """Return each belief after one step ``[..., Z]``.

        Args:
            before: beliefs of the step before, ``[..., Z]`` by name.
            evidence: evidence of each view, ``[..., H]``.
            action: the action in between, as in :meth:`believe`.
            still: where nothing is new, as in :meth:`believe`.
        """
        return {NOW: self.inferred(before[NOW], evidence[NOW], action, still)}

    def shares(self, implants: Implants) -> dict[str, Tensor]:
        """Return the probability of acting on each belief, ``[..., P, 1]``; they sum to 1."""
        del implants
        return {NOW: next(self.self_model.parameters()).new_ones(())}

    @property
    def belief_size(self) -> int:
        """Size ``N Z`` of the concatenated beliefs."""
        return len(self.beliefs) * super().belief_size

    def evidence(self, view: View, observation: Observation) -> Tensor:
        """Return the concatenated evidence of all views, ``[..., V H]``."""
        each = parted(view)
        parts = [
            super(SeveralBeliefs, self).evidence(each[name], observation) for name in self.views
        ]
        return torch.cat(torch.broadcast_tensors(*parts), -1)

    def believe(
        self, belief: Tensor, evidence: Tensor, action: Tensor, still: Tensor | None = None
    ) -> Tensor:
        """Return all beliefs after one step, concatenated."""
        before = dict(zip(self.beliefs, belief.chunk(len(self.beliefs), -1), strict=True))
        of_views = dict(zip(self.views, evidence.chunk(len(self.views), -1), strict=True))
        found = self.after(before, of_views, action, still)
        return torch.cat([found[name] for name in self.beliefs], -1)

    def inferred(
        self, belief: Tensor, evidence: Tensor, action: Tensor, still: Tensor | None
    ) -> Tensor:
        """Return the belief ``[..., Z]`` that the robot would infer from a belief before."""
        found = super().believe(belief, evidence, action, still)
        return found.mean if isinstance(found, Gaussian) else found

    def action_values(self, belief: Tensor) -> Tensor:
        """Return action values ``[..., N A]`` at all beliefs, concatenated."""
        number = len(self.beliefs)
        apart = belief.unflatten(-1, (number, belief.shape[-1] // number))
        rows = apart.flatten(0, -2)
        first, place = distinct_rows(as_whole_numbers(rows.detach()))
        values = super().action_values(rows[first])[place]
        return values.view(*apart.shape[:-1], values.shape[-1]).flatten(-2)

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """Return log-probabilities of actions ``[..., P, B, A]``, beliefs summed out."""
        shares = self.shares(implants)
        parts = [part.chunk(len(self.beliefs), -1) for part in (belief, values)]
        each = [(shares[name], *own) for name, *own in zip(self.beliefs, *parts, strict=True)]
        if each[1:] and all(
            share.dim() == DRAWS and not share.requires_grad for share, *_ in each[1:]
        ):
            return self._act_of_draws(implants, each)
        found = []
        for share, own, worth in each:
            # The gradient of the logarithm of 0 is no number.
            safe = share.clamp(min=LEAST_PROBABILITY) if share.requires_grad else share
            found.append(torch.log(safe)[..., None] + super().act(implants, own, worth))
        return torch.logsumexp(torch.stack(torch.broadcast_tensors(*found)), 0)

    def _act_of_draws(
        self, implants: Implants, each: Sequence[tuple[Tensor, Tensor, Tensor]]
    ) -> Tensor:
        """Compute :meth:`act` of S draws, at each belief only for draws that may act on it.

        These are few in a mixture of kinds, and this computation takes most of the time.
        """
        number = max(len(share) for share, *_ in each if share.dim())
        found = None
        for share, belief, values in each:
            share = share.expand(number, *each[-1][0].shape[1:])
            rows = (share > 0).flatten(1).any(-1).nonzero().squeeze(-1)
            if not len(rows):
                continue
            own, place = [belief, values], None
            if number >= MANY_DRAWS and belief.dim() == DRAWS and len(belief) == 1:
                # Distinct joint beliefs are many, distinct single ones few.
                first, place = distinct_rows(as_whole_numbers(belief[0]))
                own = [part[:, first] for part in own]
            own = [part[rows] if _is_of(part, number, DRAWS + 1) else part for part in own]
            some = {
                name: value[rows] if _is_of(value, number, DRAWS) else value
                for name, value in implants.items()
            }
            part = torch.log(share[rows])[..., None] + super().act(some, own[0], own[1])
            part = part if place is None else part.index_select(-2, place)
            if found is None:
                found = part.new_full((number, *part.shape[1:]), -torch.inf)
            if len(rows) == number:
                found = torch.logaddexp(found, part)
            else:
                found[rows] = torch.logaddexp(found[rows], part)
        assert found is not None
        return found


def _is_of(value: Tensor, draws: int, dimensions: int) -> bool:
    """True if a value has that many draws and at least that many dimensions."""
    return value.dim() >= dimensions and len(value) == draws


def joined(views: Mapping[str, View]) -> View:
    """Join several views into one: the first, with all masks of the others added by name."""
    first = next(iter(views.values()))

    def together(kind: str) -> dict[str, Tensor]:
        return {
            name if number == 0 else f"{place}: {name}": value
            for number, (place, view) in enumerate(views.items())
            for name, value in getattr(view, kind).items()
        }

    return View(together("visible"), together("taken"), together("imagined"), first.still)


def parted(view: View) -> dict[str, View]:
    """Split a view from :func:`joined` into its parts by name."""
    found: dict[str, dict[str, dict[str, Tensor]]] = {}
    for kind in ("visible", "taken", "imagined"):
        for name, value in getattr(view, kind).items():
            place, _, own = name.rpartition(": ")
            found.setdefault(place or NOW, {}).setdefault(kind, {})[own] = value
    return {place: View(**parts, still=view.still) for place, parts in found.items()}
