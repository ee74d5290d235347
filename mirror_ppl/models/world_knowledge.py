"""Learning about the world itself from recordings: an optional part of a human model.

A human model whose person knows what the robot does not, such as the rules of bomb defusal, derives
from :class:`WorldKnowledge`, too. All other code calls the functions below, which also accept human
models without it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

from torch import Tensor

from mirror_ppl.data import Demonstrations, asset_path, load_demonstrations
from mirror_ppl.domains.base import Domain
from mirror_ppl.models.human import HumanModel


class WorldKnowledge(ABC):
    """A human model that learns about the world.

    Attributes:
        world_sites: sites of ``prior`` that are about the world, whose prior :meth:`fit_world`
            changes. Partial pooling over people leaves them out.
    """

    world_sites: tuple[str, ...] = ()

    def fit_world(self, demonstrations: Demonstrations) -> None:
        """Learn about the world from recorded rounds, before any implants are inferred.

        Does nothing unless overridden.
        """
        del demonstrations

    @abstractmethod
    def planning_domain(self, draws: Mapping[str, Tensor]) -> Domain:
        """Return the domain in which the robot plans after :meth:`fit_world`.

        Args:
            draws: of one person's implants ``[S, 1, 1, ...]``; implants of the reward change the
                domain.
        """


def world_sites(human: HumanModel) -> tuple[str, ...]:
    """Return the sites of a human model that are about the world; see :class:`WorldKnowledge`."""
    return human.world_sites if isinstance(human, WorldKnowledge) else ()


def fit_world(human: HumanModel, demonstrations: Demonstrations) -> None:
    """Call :meth:`WorldKnowledge.fit_world` if the human model has it."""
    if isinstance(human, WorldKnowledge):
        human.fit_world(demonstrations)


def fit_shipped_world(human: HumanModel, setting: str) -> None:
    """Fit the world to the shipped recordings, before people are drawn from the prior."""
    if isinstance(human, WorldKnowledge):
        human.fit_world(load_demonstrations(asset_path(f"{human.domain.name}_{setting}_paper.nc")))


def planning_domain(human: HumanModel, draws: Mapping[str, Tensor]) -> Domain:
    """Return the domain in which the robot plans for a person with draws ``[S, 1, 1, ...]``."""
    if isinstance(human, WorldKnowledge):
        return human.planning_domain(draws)
    return human.domain.as_believed  # nothing is learned of the world beside what was taught
