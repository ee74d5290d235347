"""Minimizes smooth losses by L-BFGS."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from inspect import unwrap

import torch
from torch import Tensor
from torch.optim import LBFGS


class _Minimizer(LBFGS):
    """L-BFGS without torch's compiler, whose import takes a second in every process."""

    add_param_group = unwrap(LBFGS.add_param_group)
    zero_grad = unwrap(LBFGS.zero_grad)


def minimize(
    loss: Callable[[], Tensor],
    parameters: Sequence[Tensor],
    iterations: int,
    *,
    tolerance_grad: float = 1e-7,
    tolerance_change: float = 1e-9,
) -> None:
    """Minimize a loss by L-BFGS with a line search by the strong Wolfe conditions.

    Args:
        loss: computes the loss of the present parameters.
        parameters: tensors that require gradients; changed in place.
        iterations: most iterations.
        tolerance_grad: gradient at which it stops.
        tolerance_change: change of the loss or the parameters at which it stops.
    """
    optimizer = _Minimizer(
        list(parameters),
        max_iter=iterations,
        tolerance_grad=tolerance_grad,
        tolerance_change=tolerance_change,
        line_search_fn="strong_wolfe",
    )

    def closure() -> float:
        optimizer.zero_grad()
        value = loss()
        value.backward()
        return value.item()

    with torch.enable_grad():
        optimizer.step(closure)
