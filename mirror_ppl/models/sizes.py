"""Sizes of the networks of a self-model, by domain (supplement, section D)."""

from __future__ import annotations

from dataclasses import dataclass

from mirror_ppl.domains.base import Domain
from mirror_ppl.errors import InputError


@dataclass(frozen=True)
class Sizes:
    """Units per layer of the networks, three layers each unless said otherwise.

    Attributes:
        latent: dimensions Z of the latent state.
        encoder: of ``q(z_t | z_{t-1}, v_t * x_t, v_t, a_{t-1})``.
        transition: of ``p(z_t | z_{t-1}, a_{t-1})``.
        decoder: of ``p(x^m_t | z_t)`` where the modality is not an image.
        reward: of ``p(r_t | z_t, a_t)``.
        q_network: of ``Q(z_t, a_t)``.
        returns: intervals of the Q-network's distribution of returns; at 0 it has values alone.
        least_return: where the first of these intervals begins.
        most_return: where the last one ends.
        image: of the layers between a convolution and the features, and of those before an image
            decoder's deconvolution.
        channels: of the one convolution, and of the deconvolution; the kernel is 3 by 3.
        stride: of both.
        features: dimensions of image and of speech features before they are joined.
        code: dimensions that an utterance's embedding is compressed to.
    """

    latent: int = 48
    encoder: int = 64
    transition: int = 32
    decoder: int = 32
    reward: int = 32
    q_network: int = 128
    returns: int = 0
    least_return: int = 0
    most_return: int = 0

    def __post_init__(self) -> None:
        if self.returns and not (self.returns > 1 and self.least_return < self.most_return):
            raise InputError(
                f"returns must be at least 2 intervals that end above where they begin, not "
                f"{self.returns} from {self.least_return} to {self.most_return}"
            )

    image: int = 48
    channels: int = 4
    stride: int = 3
    features: int = 16
    code: int = 8


def sizes_of(domain: Domain, paper: bool = False) -> Sizes:
    """Return the sizes for a domain.

    Args:
        domain: the world.
        paper: use the supplement's sizes despite their cost: bomb defusal's larger Q-network.
    """
    record = domain.record
    return Sizes(**{**record.networks, **(record.paper_networks if paper else {})})
