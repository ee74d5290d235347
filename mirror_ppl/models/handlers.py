"""Effect handlers of the human program: step numbers in site names, and masks for padding."""

from __future__ import annotations

from typing import Any

import torch
from pyro.poutine.messenger import Messenger
from pyro.poutine.util import site_is_subsample
from torch import Tensor

from mirror_ppl.errors import HumanModelError

BELIEVING = "sees, perceive, evidence or believe"
"""The methods that compute beliefs, for messages."""


STEP = "at_step"
"""Key of the step in what a site says about inference."""


class AtStep(Messenger):
    """Appends the number of the step to site names: ``action`` becomes ``action_3``."""

    def __init__(self, step: int) -> None:
        super().__init__()
        self.step = step

    def _pyro_sample(self, msg: Any) -> None:
        # Only once, because `pyro.do` sends a copy of a replaced site through all handlers again.
        if STEP not in msg["infer"]:
            msg["infer"] = {**msg["infer"], STEP: self.step}
            msg["name"] = f"{msg['name']}_{self.step}"


class WithoutSites(Messenger):
    """Refuses sample sites in methods where engines would leave them out.

    Args:
        methods: the methods that run, for the message.
    """

    def __init__(self, methods: str) -> None:
        super().__init__()
        self.methods = methods

    def _pyro_sample(self, msg: Any) -> None:
        if not (site_is_subsample(msg) or msg["infer"].get("_deterministic")):
            raise HumanModelError(
                f'{self.methods} has the site "{msg["name"]}", which engines would leave out; put '
                "it into prior, round_latents or act"
            )


class MaskObserved(Messenger):
    """Masks out observed sites and factors where a mask is false.

    Sampled sites count there without their own scales and masks: summed or integrated out, each
    contributes a factor of 1.

    Args:
        mask: where observed sites count, boolean ``[P, B]``.
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
