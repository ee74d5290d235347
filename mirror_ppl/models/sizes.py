"""Sizes of the networks of a self-model, by domain (supplement, section D)."""

from __future__ import annotations

from dataclasses import dataclass

from mirror_ppl.checks import real_number, whole_number
from mirror_ppl.domains.base import Domain
from mirror_ppl.errors import InputError

LARGEST = 1e6
"""Largest absolute value that bins may have."""


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
        value_bins: bins of values over which the Q-network has a distribution, at least 2; at 0 it
            has values alone.
        least_value: centre of the first of these bins; no value that is learned should be less.
        most_value: centre of the last one.
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
    value_bins: int = 0
    least_value: float = 0.0
    most_value: float = 0.0
    image: int = 48
    channels: int = 4
    stride: int = 3
    features: int = 16
    code: int = 8

    def __post_init__(self) -> None:
        if self.value_bins:
            whole_number(self.value_bins, "value_bins", 2)
            least = real_number(self.least_value, "least_value", -LARGEST, LARGEST)
            most = real_number(self.most_value, "most_value", -LARGEST, LARGEST)
            if not least < most:
                raise InputError(
                    f"least_value must be below most_value, not {least:g} and {most:g}"
                )


def sizes_of(domain: Domain, paper: bool = False) -> Sizes:
    """Return the sizes for a domain.

    Args:
        domain: the world.
        paper: use the supplement's sizes despite their cost: bomb defusal's larger Q-network.
    """
    record = domain.record
    return Sizes(**{**record.networks, **(record.paper_networks if paper else {})})
