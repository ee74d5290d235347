"""The small networks of the self-model, each named by the density that it parameterizes.

Sizes are those of the supplement, section D; shape letters those of ``mirror_ppl.domains.base``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from mirror_ppl.domains.base import Visibility

MIN_SCALE = 0.01


class Gaussian(NamedTuple):
    """Parameters of a diagonal Gaussian."""

    mean: Tensor
    scale: Tensor


def layers(sizes: Sequence[int]) -> nn.Sequential:
    """Fully connected layers of the given sizes, each followed by a rectifier."""
    blocks: list[nn.Module] = []
    for before, after in zip(sizes[:-1], sizes[1:], strict=True):
        blocks += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*blocks)


class GaussianHead(nn.Module):
    """Mean and scale of a diagonal Gaussian of ``size`` dimensions, from features ``[..., H]``."""

    def __init__(self, hidden: int, size: int, initial_scale: float) -> None:
        super().__init__()
        self.linear = nn.Linear(hidden, 2 * size)
        # softplus(x) = s for x = log(exp(s) - 1)
        offset = torch.tensor(initial_scale).expm1().log()
        with torch.no_grad():
            self.linear.bias[size:] += offset

    def forward(self, features: Tensor) -> Gaussian:
        """Of ``features`` ``[..., H]``; mean and scale ``[..., size]``."""
        mean, raw = self.linear(features).chunk(2, -1)
        return Gaussian(mean, softplus(raw) + MIN_SCALE)


class Transition(nn.Module):
    """``p(z_t | z_{t-1}, a_{t-1})``: three layers of 32 to a diagonal Gaussian."""

    def __init__(self, latent: int, actions: int, hidden: int = 32) -> None:
        super().__init__()
        self.actions = actions
        self.body = layers((latent + actions, hidden, hidden, hidden))
        self.head = GaussianHead(hidden, latent, 0.5)

    def forward(self, previous: Tensor, action: Tensor) -> Gaussian:
        """Of ``previous`` ``[..., Z]`` and ``action`` (index) ``[...]``."""
        chosen = nn.functional.one_hot(action, self.actions).to(previous.dtype)
        chosen = chosen.expand(*previous.shape[:-1], -1)
        change = self.head(self.body(torch.cat([previous, chosen], -1)))
        return Gaussian(previous + change.mean, change.scale)


class Encoder(nn.Module):
    """``q(z_t | z_{t-1}, v_t * x_t, v_t, a_{t-1})``: three layers of 64 to a diagonal Gaussian.

    The first layer reads every item through weights of its own, and an item that is not visible
    adds nothing. This is the usual linear layer on masked values and masks, written as a sum, so
    that the many views of one round share the work (see :meth:`embed`).
    """

    def __init__(
        self,
        latent: int,
        actions: int,
        symbols: Mapping[str, int],
        items: Mapping[str, int],
        hidden: int = 64,
    ) -> None:
        super().__init__()
        self.latent = latent
        self.actions = actions
        self.ego = nn.Linear(symbols["ego"], hidden)
        self.items = nn.ModuleDict(
            {name: ItemEmbedding(number, symbols[name], hidden) for name, number in items.items()}
        )
        # The row beyond the actions is "no action yet", for the first observation.
        self.action = nn.Embedding(actions + 1, hidden)
        self.previous = nn.Linear(latent, hidden, bias=False)
        self.body = layers((hidden, hidden, hidden))
        self.head = GaussianHead(hidden, latent, 0.5)

    def embed(self, symbols: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """First-layer contribution of the ego ``[..., H]`` and of each item ``[..., K, H]``."""
        embedded = {"ego": self.ego(symbols["ego"])}
        embedded |= {name: module(symbols[name]) for name, module in self.items.items()}
        return embedded

    @staticmethod
    def combine(embedded: Mapping[str, Tensor], visible: Visibility) -> Tensor:
        """What a view ``[..., K]`` of the embedded observation tells, ``[..., H]``."""
        total = embedded["ego"]
        for name, mask in visible.items():
            weights = mask.to(total.dtype)
            total = total + (weights[..., None, :] @ embedded[name]).squeeze(-2)
        return total

    def previous_actions(self, actions: Tensor) -> Tensor:
        """Contribution ``[..., T + 1, H]`` of the action before each observation."""
        none = actions.new_full((*actions.shape[:-1], 1), self.actions)
        return self.action(torch.cat([none, actions], -1))

    def forward(self, previous: Tensor, evidence: Tensor) -> Gaussian:
        """Of ``previous`` ``[..., Z]`` and ``evidence`` ``[..., H]`` of ``x_t, v_t, a_{t-1}``."""
        features = torch.relu(self.previous(previous) + evidence)
        change = self.head(self.body(features))
        return Gaussian(previous + change.mean, change.scale)


class ItemEmbedding(nn.Module):
    """A linear map for each of K items, from symbols ``[..., K, D]`` to ``[..., K, H]``."""

    def __init__(self, items: int, symbols: int, hidden: int) -> None:
        super().__init__()
        bound = (items * 3) ** -0.5
        self.weight = nn.Parameter(torch.empty(items, symbols, hidden).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(items, hidden))

    def forward(self, symbols: Tensor) -> Tensor:
        """Of ``symbols`` ``[..., K, D]``; contributions ``[..., K, H]``."""
        return torch.einsum("...kd,kdh->...kh", symbols, self.weight) + self.bias


class Decoder(nn.Module):
    """``p(x^m_t | z_t)`` of one modality: three layers of 32 to a diagonal Gaussian over items."""

    def __init__(self, latent: int, items: int, features: int, hidden: int = 32) -> None:
        super().__init__()
        self.shape = (items, features)
        self.body = layers((latent, hidden, hidden, hidden))
        self.head = GaussianHead(hidden, items * features, 0.5)

    def forward(self, latent: Tensor) -> Gaussian:
        """Of ``latent`` ``[..., Z]``; mean and scale ``[..., K, F]`` in units of the scales."""
        mean, scale = self.head(self.body(latent))
        shape = latent.shape[:-1] + self.shape
        return Gaussian(mean.reshape(shape), scale.reshape(shape))


class Reward(nn.Module):
    """``p(r_t | z_t, a_t)``: three layers of 32 to a Gaussian."""

    def __init__(self, latent: int, actions: int, hidden: int = 32) -> None:
        super().__init__()
        self.actions = actions
        self.body = layers((latent + actions, hidden, hidden, hidden))
        self.head = GaussianHead(hidden, 1, 1.0)

    def forward(self, latent: Tensor, action: Tensor) -> Gaussian:
        """Of ``latent`` ``[..., Z]`` and ``action`` ``[...]``; mean and scale ``[...]``."""
        chosen = nn.functional.one_hot(action, self.actions).to(latent.dtype)
        chosen = chosen.expand(*latent.shape[:-1], -1)
        mean, scale = self.head(self.body(torch.cat([latent, chosen], -1)))
        return Gaussian(mean.squeeze(-1), scale.squeeze(-1))


class QNetwork(nn.Module):
    """``Q(z_t, a_t)``: three layers of 128 to the discounted return of an action."""

    def __init__(self, latent: int, actions: int, hidden: int = 128) -> None:
        super().__init__()
        self.latent = nn.Linear(latent, hidden)
        self.action = nn.Embedding(actions, hidden)
        self.body = layers((hidden, hidden, hidden))
        self.value = nn.Linear(hidden, 1)

    def forward(self, latent: Tensor) -> Tensor:
        """Values of all actions ``[..., A]`` at ``latent`` ``[..., Z]``."""
        first = torch.relu(self.latent(latent)[..., None, :] + self.action.weight)
        return self.value(self.body(first)).squeeze(-1)
