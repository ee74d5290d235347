"""Rounds of driving in which nothing happens, and arrays of any kind."""

import numpy as np
from example_person import DOMAIN, begun

from mirror_ppl.communication import RoundSoFar, SimulatorWorld

NAN = float("nan")
NOW = begun(0, [3, 9, -9, -8], [-1, 1, -1, -1]).now
WORLD = SimulatorWorld(DOMAIN)


def going_on(steps, domain=DOMAIN, now=NOW):
    """A round in which nothing happens."""
    told = {m.name: [0] * len(m.items) for m in domain.modalities}
    past = RoundSoFar.begin(domain, now)
    for _ in range(steps):
        past = past.then(told, 0, now)
    return past


KINDS = {
    "float64": lambda value: value.double(),
    "numpy": lambda value: value.numpy(),
    "numpy of float64": lambda value: value.numpy().astype(np.float64),
    "numpy of int64": lambda value: value.numpy().astype(np.int64),
    "lists": lambda value: value.tolist(),
}
