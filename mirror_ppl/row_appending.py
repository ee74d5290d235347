"""Appending of rows again and again, without copying those before each time."""

from __future__ import annotations

import torch
from torch import Tensor

GROWTH = 2
"""Rows for which there is room, relative to those needed, whenever room has to be made."""


class RowBuffer:
    """Memory with room for more rows.

    Only the newest rows are extended in place. Others are copied, so that rows that were returned
    never change, whatever is appended to them or to earlier ones.
    """

    def __init__(self) -> None:
        self._rows = torch.zeros(0)
        self._used = 0

    @torch.no_grad()
    def appended(self, rows: Tensor, more: Tensor) -> Tensor:
        """Return rows ``[m, Z]`` and more ``[k, Z]`` as ``[m + k, Z]``, without gradients."""
        begin, end = len(rows), len(rows) + len(more)
        newest = begin == self._used and rows.data_ptr() == self._rows.data_ptr()
        if not newest or end > len(self._rows):
            self._rows = rows.new_empty(GROWTH * end, *rows.shape[1:])
            self._rows[:begin] = rows
        self._rows[begin:end] = more
        self._used = end
        return self._rows[:end]
