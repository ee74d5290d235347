"""The networks of the self-model, each named by the density that it parameterizes.

Sizes are in `mirror_ppl.models.sizes`; shape letters are those of ``mirror_ppl.domains.base``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from mirror_ppl.domains.base import Domain, Visibility
from mirror_ppl.models.readers import (
    ImageReader,
    ItemEmbedding,
    Reader,
    SpeechReader,
    image_patches,
    layers,
)
from mirror_ppl.models.sizes import Sizes

MIN_SCALE = 0.01
PIXEL_SCALE = 0.1
"""Least scale of a pixel, so that the many constant pixels do not dominate the density."""
MARGIN = 3
"""Bins of values beyond the least and the largest value."""
SMOOTHING = 0.75
"""Standard deviation of the Gaussians around target values, in bins (Farebrother et al.)."""
START = 0.05
"""Distance from the value next to 0 at which a bin of a new network is less probable by a factor of
*e*, as a share of the range of values."""
TINY = 1e-30
"""Least probability whose logarithm is taken."""
AT_ONCE = 1536
"""Largest number of action values that are computed at once, so that layers fit into a cache."""
BLOCK = 32
"""Parts have a multiple of so many latents, so that rounding does not depend on the split."""


class Gaussian(NamedTuple):
    """Parameters of a diagonal Gaussian."""

    mean: Tensor
    scale: Tensor


def softmax_of_few(logits: Tensor) -> Tensor:
    """Return the softmax of logits ``[..., A]`` of few actions, faster than ``torch``.

    ``torch`` processes rows one by one; here rows are processed in parallel.
    """
    if logits.dim() > 1 and logits.mT.is_contiguous():
        return torch.softmax(logits.mT, -2).mT
    side_by_side = logits.reshape(-1, logits.shape[-1]).T.contiguous().softmax(0)
    return side_by_side.view(logits.shape[-1], *logits.shape[:-1]).movedim(0, -1)


def log_softmax_with_lapse(logits: Tensor, lapse: Tensor) -> Tensor:
    """Return ``log((1 - lapse) softmax(logits) + lapse / A)`` ``[..., A]``.

    Logarithms of the summands are used, which takes longer, if some ``lapse`` ``[..., 1]`` is so
    low that the probability of an action could be rounded to 0.
    """
    at_random = lapse / logits.shape[-1]
    if bool((at_random > TINY).all()):
        return torch.log(torch.addcmul(at_random, softmax_of_few(logits), 1 - lapse))
    aware = torch.log1p(-lapse) + torch.log_softmax(logits, -1)
    return torch.logaddexp(aware, torch.log(at_random).expand_as(aware))


class GaussianHead(nn.Module):
    """Maps features ``[..., H]`` to a diagonal Gaussian of ``size`` dimensions."""

    def __init__(self, hidden: int, size: int, initial_scale: float) -> None:
        super().__init__()
        self.linear = nn.Linear(hidden, 2 * size)
        # softplus(x) = s for x = log(exp(s) - 1)
        offset = torch.tensor(initial_scale).expm1().log()
        with torch.no_grad():
            self.linear.bias[size:] += offset

    def forward(self, features: Tensor) -> Gaussian:
        """Return mean and scale ``[..., size]`` for ``features`` ``[..., H]``."""
        mean, raw = self.linear(features).chunk(2, -1)
        return Gaussian(mean, softplus(raw) + MIN_SCALE)


class Transition(nn.Module):
    """``p(z_t | z_{t-1}, a_{t-1})``: three layers to a diagonal Gaussian."""

    def __init__(self, latent: int, actions: int, hidden: int = 32) -> None:
        super().__init__()
        self.actions = actions
        self.body = layers((latent + actions, hidden, hidden, hidden))
        self.head = GaussianHead(hidden, latent, 0.5)

    def forward(self, previous: Tensor, action: Tensor) -> Gaussian:
        """Return the Gaussian for ``previous`` ``[..., Z]`` and ``action`` (index) ``[...]``."""
        chosen = nn.functional.one_hot(action, self.actions).to(previous.dtype)
        chosen = chosen.expand(*previous.shape[:-1], -1)
        change = self.head(self.body(torch.cat([previous, chosen], -1)))
        return Gaussian(previous + change.mean, change.scale)


class Encoder(nn.Module):
    """``q(z_t | z_{t-1}, v_t * x_t, v_t, a_{t-1})``: three layers to a diagonal Gaussian.

    The first layer has separate weights for every symbolic item, and an item that is not visible
    adds nothing. It is the usual linear layer on masked values and masks, written as a sum, so that
    the many views of one round share the work (see :meth:`embed`). Images and speech have their own
    readers, see `mirror_ppl.models.readers`.

    Args:
        domain: whose observations are read.
        sizes: of the layers.
        codes: of the utterances of each modality that has some, ``[K, U, C]``.
    """

    def __init__(
        self, domain: Domain, sizes: Sizes, codes: Mapping[str, Tensor] | None = None
    ) -> None:
        super().__init__()
        latent, actions, hidden = sizes.latent, len(domain.actions), sizes.encoder
        symbols, codes = domain.symbol_sizes, codes or {}
        self.latent = latent
        self.actions = actions
        self.ego = nn.Linear(symbols["ego"], hidden)
        self.items = nn.ModuleDict()
        for m in domain.modalities:
            if m.image is not None:
                self.items[m.name] = ImageReader(len(m.items), m.image, sizes)
            elif m.name in codes:
                self.items[m.name] = SpeechReader(codes[m.name], sizes)
            else:
                self.items[m.name] = ItemEmbedding(len(m.items), symbols[m.name], hidden)
        # The row beyond the actions is "no action yet", for the first observation.
        self.action = nn.Embedding(actions + 1, hidden)
        self.previous = nn.Linear(latent, hidden, bias=False)
        self.body = layers((hidden, hidden, hidden))
        self.head = GaussianHead(hidden, latent, 0.5)

    def embed(self, symbols: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the first-layer contributions of the ego ``[..., H]`` and of each item."""
        embedded = {"ego": self.ego(symbols["ego"])}
        for name, reader in self.items.items():
            embedded[name] = cast(Reader, reader).embed(symbols[name])
        return embedded

    def evidence(self, symbols: Mapping[str, Tensor], visible: Visibility) -> Tensor:
        """Return the evidence ``[..., H]`` in a view ``[..., K]`` of an observation.

        That is :meth:`combine` of :meth:`embed`, in less time where each view is of an observation
        of its own.

        Args:
            symbols: the observation, as the domain encodes it.
            visible: its items that are in the view.
        """
        total = self.ego(symbols["ego"])
        for name, reader in self.items.items():
            total = total + cast(Reader, reader).read(symbols[name], visible[name])
        return total

    def combine(self, embedded: Mapping[str, Tensor], visible: Visibility) -> Tensor:
        """Return the evidence ``[..., H]`` in a view ``[..., K]`` of the embedded observation.

        Args:
            embedded: the observation, from :meth:`embed`.
            visible: its items that are in the view.
        """
        total = embedded["ego"]
        for name, reader in self.items.items():
            total = total + cast(Reader, reader).join(embedded[name], visible[name])
        return total

    def previous_actions(self, actions: Tensor) -> Tensor:
        """Return the contribution ``[..., T + 1, H]`` of the action before each observation."""
        none = actions.new_full((*actions.shape[:-1], 1), self.actions)
        return self.action(torch.cat([none, actions], -1))

    def forward(self, previous: Tensor, evidence: Tensor) -> Gaussian:
        """Return the Gaussian for ``previous`` ``[..., Z]`` and ``evidence`` ``[..., H]``."""
        features = torch.relu(self.previous(previous) + evidence)
        change = self.head(self.body(features))
        return Gaussian(previous + change.mean, change.scale)


class Decoder(nn.Module):
    """``p(x^m_t | z_t)`` of one modality: three layers to a diagonal Gaussian over items."""

    def __init__(self, latent: int, items: int, features: int, hidden: int = 32) -> None:
        super().__init__()
        self.shape = (items, features)
        self.body = layers((latent, hidden, hidden, hidden))
        self.head = GaussianHead(hidden, items * features, 0.5)

    def forward(self, latent: Tensor) -> Gaussian:
        """Return mean and scale ``[..., K, F]``, in units of the scales, for ``latent``."""
        mean, scale = self.head(self.body(latent))
        shape = latent.shape[:-1] + self.shape
        return Gaussian(mean.reshape(shape), scale.reshape(shape))


class ImageDecoder(nn.Module):
    """``p(x^m_t | z_t)`` of images: layers, and a deconvolution to a diagonal Gaussian of pixels.

    Each pixel has a constant mean; the deconvolution, with the kernel size and stride of the
    encoder's convolution, adds what differs between images.
    """

    patches: Tensor

    def __init__(self, items: int, image: tuple[int, int, int], sizes: Sizes) -> None:
        super().__init__()
        patches, numbers = image_patches(image, sizes.stride)
        self.items, self.pixels = items, math.prod(image)
        self.channels = sizes.channels
        self.body = layers((sizes.latent, *(sizes.image,) * 3))
        self.head = nn.Linear(sizes.image, items * patches.shape[0] * sizes.channels)
        bound = sizes.channels**-0.5
        self.mean = nn.Parameter(torch.empty(sizes.channels, numbers).uniform_(-bound, bound))
        self.raw = nn.Parameter(torch.empty(sizes.channels, numbers).uniform_(-bound, bound))
        self.same = nn.Parameter(torch.full((items, self.pixels), 0.5))
        self.same_raw = nn.Parameter(torch.full((items, self.pixels), -0.4))
        self.register_buffer("patches", patches, persistent=False)

    def forward(self, latent: Tensor) -> Gaussian:
        """Return mean and scale ``[..., K, F]`` of intensities for ``latent`` ``[..., Z]``."""
        shape = (*latent.shape[:-1], self.items, -1)
        channels = self.head(self.body(latent)).view(shape)
        mean = self.same + channels @ self._kernels(self.mean)
        raw = self.same_raw + channels @ self._kernels(self.raw)
        return Gaussian(mean, softplus(raw) + PIXEL_SCALE)

    def _kernels(self, kernel: Tensor) -> Tensor:
        """Return the deconvolution as one matrix ``[places * channels, pixels]``."""
        places = len(self.patches)
        matrix = kernel.new_zeros(places, self.channels, self.pixels)
        index = self.patches[:, None].expand(-1, self.channels, -1)
        return matrix.scatter(2, index, kernel.expand(places, -1, -1)).flatten(0, 1)


class Reward(nn.Module):
    """``p(r_t | z_t, a_t)``: three layers to a Gaussian."""

    def __init__(self, latent: int, actions: int, hidden: int = 32) -> None:
        super().__init__()
        self.actions = actions
        self.body = layers((latent + actions, hidden, hidden, hidden))
        self.head = GaussianHead(hidden, 1, 1.0)

    def forward(self, latent: Tensor, action: Tensor) -> Gaussian:
        """Return mean and scale ``[...]`` for ``latent`` ``[..., Z]`` and ``action`` ``[...]``."""
        chosen = nn.functional.one_hot(action, self.actions).to(latent.dtype)
        chosen = chosen.expand(*latent.shape[:-1], -1)
        mean, scale = self.head(self.body(torch.cat([latent, chosen], -1)))
        return Gaussian(mean.squeeze(-1), scale.squeeze(-1))


class QNetwork(nn.Module):
    """``Q(z_t, a_t)``: three layers to the discounted return of each action."""

    def __init__(self, latent: int, actions: int, hidden: int = 128, outputs: int = 1) -> None:
        super().__init__()
        self.latent = nn.Linear(latent, hidden)
        self.action = nn.Embedding(actions, hidden)
        self.body = layers((hidden, hidden, hidden))
        self.value = nn.Linear(hidden, outputs)

    def output(self, latent: Tensor) -> Tensor:
        """Return what the last layer gives for each action, ``[..., A, outputs]``."""
        first = torch.relu(self.latent(latent)[..., None, :] + self.action.weight)
        return self.value(self.body(first))

    def values_at_once(self, latent: Tensor) -> Tensor:
        """Return values of all actions ``[..., A]`` at ``latent`` ``[..., Z]``."""
        return self.output(latent).squeeze(-1)

    def forward(self, latent: Tensor) -> Tensor:
        """Return values of all actions ``[..., A]`` at ``latent`` ``[..., Z]``.

        Of many latents they are computed in parts, which is faster on a processor; not in training,
        which needs all of them in memory.
        """
        size = max(1, AT_ONCE // self.action.num_embeddings // BLOCK) * BLOCK
        rows = math.prod(latent.shape[:-1])
        if torch.is_grad_enabled() or latent.device.type != "cpu" or rows <= size:
            return self.values_at_once(latent)
        parts = [self.values_at_once(part) for part in latent.reshape(rows, -1).split(size)]
        return torch.cat(parts).view(*latent.shape[:-1], -1)


class BinnedQNetwork(QNetwork):
    """``Q(z_t, a_t)`` as the mean of a categorical distribution over bins of values.

    It is learned by the cross entropy of target values that are smoothed by a Gaussian (HL-Gauss;
    Farebrother et al., *Stop regressing*, 2024). The spread of the distribution is that of the
    targets given ``z_t``, and of the smoothing.

    Args:
        latent: dimensions Z.
        actions: their number A.
        hidden: units of a layer.
        bins: number of bins with centres from ``least`` to ``most``; three more follow on either
            side, so that targets at the ends are smoothed like others.
        least: least value; lower targets count as this one.
        most: largest value.
    """

    centres: Tensor

    def __init__(
        self, latent: int, actions: int, hidden: int, bins: int, least: float, most: float
    ) -> None:
        super().__init__(latent, actions, hidden, bins + 2 * MARGIN)
        self.least, self.most, self.width = least, most, (most - least) / (bins - 1)
        places = torch.arange(-MARGIN, bins + MARGIN)
        self.register_buffer("centres", least + self.width * places)
        nearest = min(max(0.0, least), most)
        with torch.no_grad():
            self.value.bias.copy_(-(self.centres - nearest).abs() / (START * (most - least)))

    def log_probabilities(self, latent: Tensor) -> Tensor:
        """Return logs of the bins' probabilities ``[..., A, V]`` at ``latent`` ``[..., Z]``."""
        return torch.log_softmax(self.output(latent), -1)

    def mean(self, log_probabilities: Tensor) -> Tensor:
        """Return the values ``[..., A]`` of distributions ``[..., A, V]``."""
        return log_probabilities.exp() @ self.centres

    def values_at_once(self, latent: Tensor) -> Tensor:
        """Return values of all actions ``[..., A]`` at ``latent`` ``[..., Z]``."""
        return torch.softmax(self.output(latent), -1) @ self.centres

    def target(self, values: Tensor) -> Tensor:
        """Return the probabilities of bins ``[..., V]`` that are learned of ``values`` ``[...]``.

        They are those of a Gaussian around the value.
        """
        edges = torch.cat([self.centres, self.centres[-1:] + self.width]) - self.width / 2
        off = edges - values.clamp(self.least, self.most)[..., None]
        below = torch.special.ndtr(off / (SMOOTHING * self.width))
        inside = below[..., 1:] - below[..., :-1]
        return inside / inside.sum(-1, keepdim=True)

    def ranked_cross_entropy(self, target: Tensor, log_probabilities: Tensor) -> Tensor:
        """Return the ranked cross entropy ``[..., A]``, in nats times units of value.

        It is the cross entropy of whether the value lies below the edge between two bins, summed
        over edges and multiplied by the width of a bin. So it counts how far away wrong values are;
        the cross entropy of bins does so only within the smoothing. With squared errors of
        probabilities in place of logarithms it would be the continuous ranked probability score
        (Gneiting and Raftery, *Strictly proper scoring rules*, 2007).

        Args:
            target: probabilities of bins that are learned ``[..., A, V]``.
            log_probabilities: logs of the distribution's ``[..., A, V]``.
        """
        found = log_probabilities.exp()
        below = found.cumsum(-1)[..., :-1].clamp(min=TINY).log()
        above = found.flip(-1).cumsum(-1).flip(-1)[..., 1:].clamp(min=TINY).log()
        wanted = target.cumsum(-1)[..., :-1].clamp(max=1.0)
        return -self.width * (wanted * below + (1 - wanted) * above).sum(-1)


def q_network(sizes: Sizes, actions: int) -> QNetwork:
    """Return a new Q-network, with bins if there are ``sizes.value_bins``."""
    size = sizes.latent, actions, sizes.q_network
    if not sizes.value_bins:
        return QNetwork(*size)
    return BinnedQNetwork(*size, sizes.value_bins, sizes.least_value, sizes.most_value)
