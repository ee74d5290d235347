"""Shapes that tensors broadcast to."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """Return the shape that some shapes broadcast to.

    The first call of torch's own imports sympy, which takes a second in every process.

    Raises:
        ValueError: they do not broadcast.
    """
    return torch.Size(np.broadcast_shapes(*map(tuple, shapes)))
