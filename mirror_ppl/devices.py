"""Names of the devices on which torch can compute."""

from __future__ import annotations

from mirror_ppl.errors import UnknownNameError


def usable_device(name: str) -> str:
    """The name of a device that torch can compute on here.

    Raises:
        UnknownNameError: there is none of that name; lists those there are.
    """
    import torch

    known = ["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
    if name not in known and not (name == "cuda" and len(known) > 1):
        raise UnknownNameError.of("device", name, known)
    return name
