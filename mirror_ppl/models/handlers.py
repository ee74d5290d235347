"""Effect handlers of the human program: names of steps, and padding."""

from __future__ import annotations

from typing import Any

import torch
from pyro.poutine.messenger import Messenger
from pyro.poutine.util import site_is_subsample
from torch import Tensor


class AtStep(Messenger):
    """Sites get the number of the step appended: ``action`` becomes ``action_3``."""

    def __init__(self, step: int) -> None:
        super().__init__()
        self.step = step

    def _pyro_sample(self, msg: Any) -> None:
        # Once: `pyro.do` sends a copy of what it replaces through all handlers again.
        if not msg["infer"].get("has_step"):
            msg["infer"] = {**msg["infer"], "has_step": True}
            msg["name"] = f"{msg['name']}_{self.step}"


class MaskObserved(Messenger):
    """Observed sites and factors do not count where a mask is false.

    Sampled ones do, without scales and masks of their own: summed or integrated out, each of them
    comes to 1.

    Args:
        mask: which of them count, boolean ``[P, B]``.
    """

    def __init__(self, mask: Tensor) -> None:
        super().__init__()
        self.mask = mask

    def _pyro_sample(self, msg: Any) -> None:
        if site_is_subsample(msg):
            return
        if msg["is_observed"]:
            msg["mask"] = self.mask if msg["mask"] is None else msg["mask"] & self.mask
            return
        if msg["mask"] is not None:
            msg["mask"] = msg["mask"] | ~self.mask
        if isinstance(msg["scale"], Tensor) or msg["scale"] != 1:
            scale = torch.as_tensor(msg["scale"], device=self.mask.device)
            msg["scale"] = torch.where(self.mask, scale, torch.ones_like(scale))
