"""Logistic regression pooled over people: the strongest simple baseline where rounds are few.

The model has no memory, and weights that are partially pooled over people::

    a_pt ~ Categorical(softmax((w + u_p) . [ego_t, v_t * x_t, v_t, a_{t-1}, 1]))
    w    ~ Normal(0, shared^-1/2)          what all P people have in common
    u_p  ~ Normal(0, own^-1/2)             how person p differs

It is fitted by the posterior's mode, which is unique. The precisions ``shared`` and ``own`` are
chosen on the people's validation rounds. This baseline is not in the supplement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from mirror_ppl.baselines.inputs import SIGHTS, Sight, recorded_inputs
from mirror_ppl.baselines.training import check_parts, mean_nll
from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.domains import Domain, get_domain, require_known
from mirror_ppl.errors import DemonstrationsError, InputError
from mirror_ppl.minimization import minimize

ITERATIONS, ENOUGH = 200, 1e-5
"""Most iterations of the optimizer, and the change of the loss in nats below which it stops."""


@dataclass(frozen=True)
class LogisticOptions:
    """Settings of pooled logistic regression.

    Attributes:
        sight: a name in ``SIGHTS``: which items are read.
        shared: candidate precisions of the shared weights ``w``.
        own: candidate precisions of the individual weights ``u_p``.
    """

    sight: Sight = "setting"
    shared: tuple[float, ...] = (0.03, 0.3, 3.0)
    own: tuple[float, ...] = (1.0, 10.0, 100.0, 1000.0)

    def __post_init__(self) -> None:
        require_known(self.sight, "sight", SIGHTS)
        for name in ("shared", "own"):
            if not getattr(self, name) or min(getattr(self, name)) <= 0:
                raise InputError(f"{name} must be positive numbers, not {getattr(self, name)}")


@dataclass(frozen=True)
class PooledLogistic:
    """Weights of P people; made by `fit_pooled_logistic`.

    Attributes:
        domain: the world.
        people: P ids.
        sight: which items are read.
        weights: ``w + u_p`` ``[P, I + 1, A]``, the last row being that of 1.
        precisions: chosen precisions of ``w`` and ``u_p``.
    """

    domain: Domain
    people: tuple[str, ...]
    sight: Sight
    weights: Tensor
    precisions: tuple[float, float]

    def log_probabilities(self, demonstrations: Demonstrations) -> Tensor:
        """Log-probabilities in nats of all actions at every step, ``[P, B, T, A]``.

        Args:
            demonstrations: rounds of the people in their order.

        Raises:
            DemonstrationsError: they are of other people or another domain.
        """
        if (demonstrations.domain, demonstrations.people) != (self.domain.name, self.people):
            raise DemonstrationsError(
                f"demonstrations of {demonstrations.domain}, {', '.join(demonstrations.people)}; "
                f"expected {self.domain.name}, {', '.join(self.people)}"
            )
        return _log_softmax(_inputs(self.domain, self.sight, demonstrations), self.weights)


def fit_pooled_logistic(
    train: Demonstrations,
    validation: Demonstrations,
    options: LogisticOptions = LogisticOptions(),  # noqa: B008 - frozen
) -> PooledLogistic:
    """Fit logistic regression to P people jointly.

    Args:
        train: rounds to learn from, of any lengths and numbers.
        validation: rounds of the same people in the same order, to choose the precisions.
        options: settings.

    Raises:
        DemonstrationsError: a person has no training or no validation round; or the validation
            rounds are of another domain or other people.
    """
    check_parts(train, validation)
    domain = get_domain(train.domain)
    inputs, others = (_inputs(domain, options.sight, part) for part in (train, validation))
    found: list[tuple[float, tuple[float, float], Tensor]] = []
    for precisions in product(options.shared, options.own):
        weights = _mode(inputs, train.actions, len(domain.actions), precisions)
        nll = mean_nll(_log_softmax(others, weights), validation.actions).mean().item()
        found.append((nll, precisions, weights))
    _, precisions, weights = min(found, key=lambda one: one[0])
    return PooledLogistic(domain, train.people, options.sight, weights, precisions)


def _inputs(domain: Domain, sight: Sight, demonstrations: Demonstrations) -> Tensor:
    inputs = recorded_inputs(domain, sight, demonstrations)
    return torch.cat([inputs, torch.ones_like(inputs[..., :1])], -1)


def _log_softmax(inputs: Tensor, weights: Tensor) -> Tensor:
    return (inputs.flatten(1, 2) @ weights).unflatten(1, inputs.shape[1:3]).log_softmax(-1)


def _mode(inputs: Tensor, actions: Tensor, number: int, precisions: Sequence[float]) -> Tensor:
    """Weights ``[P, I + 1, A]`` of the posterior's mode."""
    used = inputs[actions >= 0].any(0)  # inputs that never occur keep the weight 0
    some, chosen, times = _counted(inputs[..., used], actions)
    shared = some.new_zeros(some.shape[-1], number, requires_grad=True)
    own = some.new_zeros(len(some), some.shape[-1], number, requires_grad=True)

    def loss() -> Tensor:
        log_probabilities = (some @ (shared + own)).log_softmax(-1)
        total = -(times * log_probabilities.gather(-1, chosen).squeeze(-1)).sum()
        for precision, part in zip(precisions, (shared, own), strict=True):
            total = total + 0.5 * precision * part.square().sum()
        return total

    minimize(loss, [shared, own], ITERATIONS, tolerance_change=ENOUGH)
    weights = inputs.new_zeros(len(inputs), inputs.shape[-1], number)
    weights[:, used] = (shared + own).detach()
    return weights


def _counted(inputs: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Distinct pairs of inputs and action of each person, with their counts.

    Returns:
        Inputs ``[P, N, I]``, actions ``[P, N, 1]``, and counts ``[P, N]``, 0 in padding.
    """
    each = []
    for own, done in zip(inputs, actions, strict=True):
        pairs = torch.cat([own, done[..., None].to(own)], -1)[done >= 0]
        each.append(pairs.unique(dim=0, return_counts=True))
    pairs, times = (pad_sequence(list(part), batch_first=True) for part in zip(*each, strict=True))
    return pairs[..., :-1], pairs[..., -1:].long(), times.to(inputs)
