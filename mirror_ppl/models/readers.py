"""Readers, by which the encoder reads a modality: lists of symbols, images, and speech.

Each reader has two halves. ``embed`` processes every item by itself, so that the many views of one
round share that work; ``join`` combines the items of a view into one vector.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from mirror_ppl.errors import InputError
from mirror_ppl.models.sizes import Sizes

KERNEL = 3
"""Rows and columns of a convolution's kernel."""


def layers(sizes: Sequence[int]) -> nn.Sequential:
    """Return fully connected layers of the given sizes, each followed by a ReLU."""
    blocks: list[nn.Module] = []
    for before, after in zip(sizes[:-1], sizes[1:], strict=True):
        blocks += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*blocks)


class Reader(nn.Module):
    """Base class: reads one modality."""

    def embed(self, symbols: Tensor) -> Tensor:
        """Embed each item by itself: symbols ``[..., K, D]`` to ``[..., K, H]``."""
        raise NotImplementedError

    def join(self, embedded: Tensor, mask: Tensor) -> Tensor:
        """Return the contribution ``[..., H]`` of the items in the view, ``mask`` ``[..., K]``."""
        raise NotImplementedError

    def read(self, symbols: Tensor, mask: Tensor) -> Tensor:
        """Embed and join items ``[..., K, D]`` of which a mask ``[..., K]`` is in the view."""
        return self.join(self.embed(symbols), mask)


class ItemEmbedding(Reader):
    """A linear map for each of K items, from symbols ``[..., K, D]`` to ``[..., K, H]``."""

    def __init__(self, items: int, symbols: int, hidden: int) -> None:
        super().__init__()
        bound = (items * 3) ** -0.5
        self.weight = nn.Parameter(torch.empty(items, symbols, hidden).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(items, hidden))

    def embed(self, symbols: Tensor) -> Tensor:
        """Return contributions ``[..., K, H]`` of ``symbols`` ``[..., K, D]``."""
        return torch.einsum("...kd,kdh->...kh", symbols, self.weight) + self.bias

    def read(self, symbols: Tensor, mask: Tensor) -> Tensor:
        """Return the sum ``[..., H]`` of the items in the view.

        Where every view is of an observation of its own, the items of a view are a single row.
        """
        if symbols.shape[:-1] != mask.shape:
            return super().read(symbols, mask)
        weights = mask.to(symbols.dtype)
        items = (weights[..., None] * symbols).flatten(-2)
        return items @ self.weight.flatten(0, 1) + weights @ self.bias

    def join(self, embedded: Tensor, mask: Tensor) -> Tensor:
        """Return the sum ``[..., H]`` of the items in the view."""
        weights = mask.to(embedded.dtype)
        return (weights[..., None, :] @ embedded).squeeze(-2)


class JoinedReader(Reader):
    """A reader that concatenates items and masks instead of summing them."""

    def __init__(self, items: int, each: int, hidden: Sequence[int], encoder: int) -> None:
        super().__init__()
        self.body = layers((items * (each + 1), *hidden))
        self.head = nn.Linear(hidden[-1], encoder, bias=False)

    def join(self, embedded: Tensor, mask: Tensor) -> Tensor:
        """Return the contribution ``[..., H]`` to the encoder's first layer."""
        there = mask.to(embedded.dtype)
        features = (there[..., None] * embedded).flatten(-2)
        return self.head(self.body(torch.cat([features, there], -1)))


class ImageReader(JoinedReader):
    """Items that are images: a convolution, three layers, features (supplement, section D)."""

    patches: Tensor

    def __init__(self, items: int, image: tuple[int, int, int], sizes: Sizes) -> None:
        patches, numbers = image_patches(image, sizes.stride)
        hidden = (sizes.image,) * 3 + (sizes.features,)
        super().__init__(items, patches.shape[0] * sizes.channels, hidden, sizes.encoder)
        self.convolution = nn.Linear(numbers, sizes.channels)
        self.register_buffer("patches", patches, persistent=False)

    def embed(self, symbols: Tensor) -> Tensor:
        """Map pixels ``[..., K, D]`` to channels of every place ``[..., K, places * channels]``."""
        return torch.relu(self.convolution(symbols[..., self.patches])).flatten(-2)


class SpeechReader(JoinedReader):
    """Utterances: the code of each item's utterance, and one layer (supplement, section D).

    Args:
        codes: of the U utterances about each of K items, ``[K, U, C]``; see
            `mirror_ppl.models.speech`.
        sizes: of the networks.
    """

    codes: Tensor

    def __init__(self, codes: Tensor, sizes: Sizes) -> None:
        super().__init__(codes.shape[0], codes.shape[-1], (sizes.features,), sizes.encoder)
        self.register_buffer("codes", codes.clone())

    def embed(self, symbols: Tensor) -> Tensor:
        """Map the one-hot true utterance ``[..., K, U]`` to its code ``[..., K, C]``."""
        return torch.einsum("...ku,kuc->...kc", symbols, self.codes)


def image_patches(image: tuple[int, int, int], stride: int) -> tuple[Tensor, int]:
    """Return the pixels of an image that a convolution's kernel covers at each place.

    Args:
        image: rows, columns and colours.
        stride: step of the kernel.

    Returns:
        Indices of pixels ``[places, 3 * 3 * colours]``, and the number of pixels per place.

    Raises:
        InputError: the kernel does not cover the image evenly.
    """
    rows, columns, colours = image
    if (rows - KERNEL) % stride or (columns - KERNEL) % stride or min(rows, columns) < KERNEL:
        raise InputError(f"kernels of {KERNEL} at stride {stride} do not cover {rows} x {columns}")
    numbers = torch.arange(rows * columns * colours).view(image)
    places = numbers.unfold(0, KERNEL, stride).unfold(1, KERNEL, stride)
    places = places.movedim(2, -1).flatten(2).flatten(0, 1)
    return places, places.shape[1]
