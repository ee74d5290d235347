"""Simulated people, one file a domain, and the recordings of them that are fitted."""

from __future__ import annotations

from collections.abc import Callable

import torch

from mirror_ppl.console import Progress
from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.domains.base import require_known
from mirror_ppl.people.recordings import simulate_driving

SIMULATORS: dict[str, Callable[..., Demonstrations]] = {"driving": simulate_driving}
"""What records simulated people, by the name of the domain."""
