"""What a communicator knows of a round that is under way."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.domains.base import Domain, Observation, Visibility


@dataclass(frozen=True)
class RoundSoFar:
    """A round up to the moment at which the person is about to act for the (t + 1)-th time.

    Attributes:
        observation: everything there was to observe at each step, as the robot saw it: ego
            ``[t + 1, E]``, each modality ``[t + 1, K, F]``.
        actions: what the person did, ``[t]``.
        told: what they were told at each step, by modality ``[t, K]``.
    """

    observation: Observation
    actions: Tensor
    told: Visibility

    def __post_init__(self) -> None:
        steps = len(self.actions)
        for name, value in self.observation.items():
            if len(value) != steps + 1:
                raise ValueError(
                    f'{steps} actions go with {steps + 1} observations; "{name}" has {len(value)}'
                )
        for name, value in self.told.items():
            if len(value) != steps:
                raise ValueError(
                    f'{steps} actions go with as many steps of told "{name}", not {len(value)}'
                )

    @classmethod
    def begin(cls, domain: Domain, observation: Observation) -> RoundSoFar:
        """A round of which there is only the first observation, ``[E]`` and ``[K, F]``.

        Raises:
            ValueError: such an observation cannot be.
        """
        device = observation["ego"].device
        nothing = {
            m.name: torch.zeros(0, len(m.items), dtype=torch.bool, device=device)
            for m in domain.modalities
        }
        first = {name: value[None] for name, value in observation.items()}
        past = cls(first, torch.zeros(0, dtype=torch.long, device=device), nothing)
        past.check(domain)
        return past

    def then(self, told: Visibility, action: int | Tensor, observation: Observation) -> RoundSoFar:
        """The round one step later.

        Args:
            told: what the person was told before they acted, ``[K]`` by modality.
            action: what they did.
            observation: what there is to observe now, ``[E]`` and ``[K, F]``.
        """
        done = torch.as_tensor(action, dtype=torch.long, device=self.actions.device).reshape(1)
        return RoundSoFar(
            {
                name: torch.cat([value, observation[name][None]])
                for name, value in self.observation.items()
            },
            torch.cat([self.actions, done]),
            {name: torch.cat([value, told[name][None]]) for name, value in self.told.items()},
        )

    def check(self, domain: Domain) -> None:
        """Make sure that the last step can be one of this domain.

        Raises:
            ValueError: its observation or action cannot be.
        """
        now = self.now
        expected = {"ego": (len(domain.ego_features),)} | {
            m.name: (len(m.items), len(m.features)) for m in domain.modalities
        }
        for name, shape in expected.items():
            found = tuple(now[name].shape) if name in now else None
            if found != shape:
                raise ValueError(f'the observation of "{name}" has shape {found}, expected {shape}')
        for rule, broken in domain.faults(now).items():
            if broken:
                raise ValueError(f"this observation cannot be: {rule}")
        if self.time and not 0 <= int(self.actions[-1]) < len(domain.actions):
            raise ValueError(
                f"there is no action {int(self.actions[-1])}; actions count from 0 to "
                f"{len(domain.actions) - 1}"
            )

    @property
    def time(self) -> int:
        """How many actions there have been, t."""
        return len(self.actions)

    @property
    def now(self) -> Observation:
        """The last observation, ``[E]`` and ``[K, F]``."""
        return {name: value[-1] for name, value in self.observation.items()}
