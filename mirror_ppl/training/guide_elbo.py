"""Training of the amortized guide by the ELBO, with ``pyro.infer.SVI``.

People are drawn from the prior and play rounds, a group at a time. The network then maximizes the
ELBO of their actions, without access to their true implants::

    psi_p ~ prior;   rounds_p ~ program(psi_p);   minimize  - ELBO(q(. | rounds_p), rounds_p)

Discrete sites are summed out. Continuous sites that the network does not cover (the weights of a
residual) have a mean-field guide, which is reinitialized for each group.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, cast

import pyro
import torch
from pyro.distributions import TorchDistribution
from pyro.infer import SVI, config_enumerate
from pyro.optim import ClippedAdam
from torch import Tensor

from mirror_ppl.inference.amortized import log_evidence
from mirror_ppl.inference.amortized_guide import AmortizedGuide, guide_screening
from mirror_ppl.inference.calibration.study import prior_people
from mirror_ppl.inference.marginal_elbo import elbo_of
from mirror_ppl.inference.refining import with_mean_field
from mirror_ppl.likelihood.compiled import ViewTables
from mirror_ppl.likelihood.tables import join_tables, person_builders
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import scalar_sites, unconstrained
from mirror_ppl.models.simulation import play_rounds

GROUP = 20
"""People whose tables are in memory together."""
STEPS_OF_A_GROUP = 25
"""Gradient steps before other people are simulated."""
MEAN_FIELD_RATE = 0.01
"""Learning rate of the mean-field guide."""
NORM = 100.0
"""Largest gradient norm; larger gradients are clipped."""


@dataclass(frozen=True)
class Group:
    """Simulated people who are in memory together.

    Attributes:
        compiled: their rounds.
        log_evidence: features of the rounds that the network reads, ``[P, 1, W]``.
        steps: numbers of recorded actions, ``[P, 1]``.
        place: true values of the scalar sites in unconstrained space, ``[P, D]``.
    """

    compiled: ViewTables
    log_evidence: Tensor
    steps: Tensor
    place: Tensor


@torch.no_grad()
def simulated_groups(
    human: HumanModel, rounds: Sequence[int], generator: torch.Generator
) -> Iterator[Group]:
    """Yield groups of simulated people; each group's number of rounds is drawn from ``rounds``."""
    while True:
        number = rounds[int(torch.randint(len(rounds), (), generator=generator))]
        implants = prior_people(human, GROUP, generator)
        recordings = play_rounds(human, implants, number, human.domain.settings[-1], generator)
        tables, evidence = [], []
        for builder in person_builders(human, recordings, guide_screening()):
            tables.append(builder.table())
            evidence.append(log_evidence(builder))
        yield Group(
            ViewTables(human, join_tables(tables, recordings.shape)),
            torch.stack(evidence)[:, None],
            recordings.mask.flatten(1).sum(-1, keepdim=True),
            unconstrained(scalar_sites(human), implants),
        )


class ELBOTraining:
    """Gradient steps of the ELBO.

    Args:
        network: the guide to train.
        groups: simulated people.
        learning_rate: rate of Adam for the network.
    """

    def __init__(
        self, network: AmortizedGuide, groups: Iterator[Group], learning_rate: float
    ) -> None:
        self.network = network
        self.groups = groups

        def settings(name: str) -> dict[str, float]:
            rate = learning_rate if name.startswith("network") else MEAN_FIELD_RATE
            return {"lr": rate, "clip_norm": NORM}

        self._optimizer = ClippedAdam(cast(dict, settings))
        self._steps = 0
        self._parameters: Any = None
        self._svi: SVI | None = None

    def step(self) -> float:
        """Take one gradient step (global random state); return the negative ELBO, nats a person."""
        if self._steps % STEPS_OF_A_GROUP == 0:
            self._svi = self._of(next(self.groups))
            self._parameters = {"params": {}, "constraints": {}}
        self._steps += 1
        assert self._svi is not None
        # Pyro validates the model at the first step only.
        with (
            pyro.get_param_store().scope(self._parameters),
            pyro.validation_enabled(self._steps == 1),
        ):
            return cast(float, self._svi.step()) / GROUP

    def _of(self, group: Group) -> SVI:
        def density() -> TorchDistribution:
            pyro.module("network", self.network)
            return self.network.density(group.log_evidence, group.steps)

        program = config_enumerate(group.compiled.program, "parallel")
        guide = with_mean_field(group.compiled, density)
        return SVI(program, guide, self._optimizer, elbo_of(group.compiled))
