"""How large the networks of a self-model are, by domain (supplement, section D)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from mirror_ppl.domains.base import Domain


@dataclass(frozen=True)
class Sizes:
    """Units of the networks; each has three layers of them unless said otherwise.

    Attributes:
        latent: dimensions Z of the latent state.
        encoder: of ``q(z_t | z_{t-1}, v_t * x_t, v_t, a_{t-1})``.
        transition: of ``p(z_t | z_{t-1}, a_{t-1})``.
        decoder: of ``p(x^m_t | z_t)`` where the modality is not an image.
        reward: of ``p(r_t | z_t, a_t)``.
        q_network: of ``Q(z_t, a_t)``.
        image: of the layers between a convolution and the features, and of those before the
            deconvolution of an image's decoder.
        channels: of the one convolution, and of the deconvolution; the kernel is 3 by 3.
        stride: of both.
        features: numbers that each of image and speech is reduced to before they are joined.
        code: numbers that an utterance's embedding is compressed to.
    """

    latent: int = 48
    encoder: int = 64
    transition: int = 32
    decoder: int = 32
    reward: int = 32
    q_network: int = 128
    image: int = 48
    channels: int = 4
    stride: int = 3
    features: int = 16
    code: int = 8


SIZES: dict[str, Sizes] = {
    "driving": Sizes(),
    "search_rescue": Sizes(encoder=128, decoder=64, q_network=200),
    "bomb_defusal": Sizes(encoder=128, decoder=64, q_network=200, image=64, stride=2),
}
"""The supplement's sizes by domain; of bomb defusal a smaller Q-network, see ``PAPER``."""
PAPER: dict[str, Sizes] = SIZES | {"bomb_defusal": replace(SIZES["bomb_defusal"], q_network=2048)}
"""The supplement's sizes by domain, whatever they cost."""


def sizes_of(domain: Domain, sizes: Mapping[str, Sizes] = SIZES) -> Sizes:
    """The sizes for a domain; of one that is not known here those of driving, but for its own."""
    return sizes.get(domain.name) or Sizes(**getattr(domain, "networks", {}))
