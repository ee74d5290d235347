"""What recordings tell of the world itself, and not of one person: an optional part of a model.

A human model whose person knows what the robot does not, such as the rules of bomb defusal, derives
from :class:`WorldKnowledge`, too. Everything else asks the functions below, which know what holds
of human models without it.
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
            changes. A population of people says nothing of them.
    """

    world_sites: tuple[str, ...] = ()

    def fit_world(self, demonstrations: Demonstrations) -> None:
        """Learn about the world from recorded rounds, before anybody's implants are inferred.

        There is nothing to learn unless this is overridden.
        """
        del demonstrations

    @abstractmethod
    def planning_domain(self, draws: Mapping[str, Tensor]) -> Domain:
        """The domain in which the robot plans, after what it learned.

        Args:
            draws: of one person's implants ``[S, 1, 1, ...]``; implants of the reward change it.
        """


def world_sites(human: HumanModel) -> tuple[str, ...]:
    """Sites of a human model that are about the world; see :class:`WorldKnowledge`."""
    return human.world_sites if isinstance(human, WorldKnowledge) else ()


def fit_world(human: HumanModel, demonstrations: Demonstrations) -> None:
    """Let a human model learn about the world, if it can; see :class:`WorldKnowledge`."""
    if isinstance(human, WorldKnowledge):
        human.fit_world(demonstrations)


def fit_shipped_world(human: HumanModel, setting: str) -> None:
    """The same from the recordings that ship, for people who are drawn from what is left open."""
    if isinstance(human, WorldKnowledge):
        human.fit_world(load_demonstrations(asset_path(f"{human.domain.name}_{setting}_paper.nc")))


def planning_domain(human: HumanModel, draws: Mapping[str, Tensor]) -> Domain:
    """The domain in which the robot plans for a person of these draws ``[S, 1, 1, ...]``."""
    return human.planning_domain(draws) if isinstance(human, WorldKnowledge) else human.domain
