"""The cross-entropy method over sequences of binary actions.

Implements the planner that the supplement calls CE (section B): sequences are drawn from a product
of Bernoulli distributions, the best of them (the elites) move those distributions towards
themselves, and so on. The result is the best sequence of all iterations, not a draw from the last
distribution, so more iterations never make it worse.

It maximizes any function of sequences. N stands for the sequences that are tried at a time; the
other shape letters are those of `mirror_ppl.domains.base`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.errors import InputError


@dataclass(frozen=True)
class CrossEntropyOptions:
    """Settings of the cross-entropy method.

    Args:
        samples: sequences tried in each iteration, N.
        elites: number of the best of them, towards which the distribution moves.
        iterations: number of iterations.
        smoothing: how far it moves, from 0 (not at all) to 1 (to the elites' frequencies).
        start_probability: of action 1 at every step, in the first iteration.

    Raises:
        InputError: a number is out of its range.
    """

    samples: int = 256
    elites: int = 32
    iterations: int = 4
    smoothing: float = 0.5
    start_probability: float = 0.3

    def __post_init__(self) -> None:
        if not 1 <= self.elites <= self.samples:
            raise InputError(f"elites must be from 1 to samples={self.samples}, not {self.elites}")
        if self.iterations < 1:
            raise InputError(f"iterations must be at least 1, not {self.iterations}")
        if not 0.0 <= self.smoothing <= 1.0:
            raise InputError(f"smoothing must be from 0 to 1, not {self.smoothing}")
        if not 0.0 < self.start_probability < 1.0:
            raise InputError(
                f"start_probability must be between 0 and 1, not {self.start_probability}"
            )


def best_sequences(
    value: Callable[[Tensor], Tensor],
    batch: tuple[int, ...],
    horizon: int,
    generator: torch.Generator,
    options: CrossEntropyOptions | None = None,
    first: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Search for the sequence of binary actions that has the highest value.

    Every element of the batch is searched with the same random numbers. So its result does not
    depend on the rest of the batch, and equal elements get equal results.

    Args:
        value: maps sequences, boolean ``[*batch, N, H]``, to their values ``[*batch, N]``; higher
            is better.
        batch: shape ``[...]`` of the problems that are solved at once.
        horizon: length H of a sequence.
        generator: source of randomness; its device is where the search happens.
        options: settings of the search.
        first: boolean ``[...]``, the first action; searched for unless given.

    Returns:
        The best sequence found, boolean ``[..., H]``, and its value ``[...]``. Of several that are
        equally good it is one of those that were found in the earliest iteration.

    Raises:
        InputError: ``value`` returned another shape.
    """
    options = options or CrossEntropyOptions()
    device, dtype = generator.device, torch.get_default_dtype()
    shape = (*batch, options.samples)
    probability = torch.full((*batch, 1, horizon), options.start_probability, device=device)
    best = torch.zeros((*batch, horizon), dtype=torch.bool, device=device)
    best_value: Tensor | None = None
    for _ in range(options.iterations):
        noise = torch.rand(options.samples, horizon, generator=generator, device=device)
        sequences = noise < probability
        if first is not None:
            sequences[..., 0] = first[..., None]
        values = value(sequences)
        if values.shape != shape:
            raise InputError(f"value must return shape {shape}, not {tuple(values.shape)}")
        elite_values, index = values.topk(options.elites, dim=-1)
        elites = sequences.gather(-2, index[..., None].expand(*index.shape, horizon))
        if best_value is None:
            best, best_value = elites[..., 0, :], elite_values[..., 0]
        else:
            better = elite_values[..., 0] > best_value
            best = torch.where(better[..., None], elites[..., 0, :], best)
            best_value = torch.where(better, elite_values[..., 0], best_value)
        frequency = elites.to(dtype).mean(-2, keepdim=True)
        probability = probability + options.smoothing * (frequency - probability)
    assert best_value is not None
    return best, best_value
