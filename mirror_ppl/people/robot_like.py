"""People of any world: as the robot itself, but of limited sight and a consistency of their own."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.domains.base import (
    Domain,
    Observation,
    Visibility,
    by_eye,
    map_state,
    require_known,
)
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.implants import (
    CONSISTENCY_MEDIAN,
    CONSISTENCY_SPREAD,
    LEAST_PROBABILITY,
    SIGHT,
    sight_sites,
)
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.weights import fingerprint
from mirror_ppl.people.base import SimulatedPeople, derived_generator

SELF_MODEL = "self_model"
"""What recordings call the fingerprint of the robot that people are like."""
POPULATIONS = ("diverse", "paper")


@dataclass(frozen=True)
class Mind:
    """What somebody believes and knows, and what they did last.

    Attributes:
        belief: the encoder's mean, ``[P, ..., Z]``.
        action: ``[P, ...]``; the number of actions before the first one.
        knowledge: fields of the domain's knowledge, ``[P, ..., *]``, flat and one behind the other.
    """

    belief: Tensor
    action: Tensor
    knowledge: Tensor


@dataclass(frozen=True)
class RobotLike(SimulatedPeople):
    """P people who infer and value as the robot does.

    Attributes:
        self_model: the robot's.
        setting: what limits the sight of people who have no threshold of their own.
        reach: threshold of sight for each direction ``[P, D]``, or ``None``.
        consistency: inverse temperature of their choices per unit of reward, ``[P]``.
    """

    self_model: SelfModel
    setting: str
    reach: Tensor | None
    consistency: Tensor

    @property
    def domain(self) -> Domain:
        """The world that they act in."""
        return self.self_model.domain

    def start(self, *batch: int, mind_noise: Tensor | None = None) -> Mind:
        """Nothing was seen or done yet."""
        del mind_noise
        shape, like = (len(self.consistency), *batch), self.consistency
        return Mind(
            like.new_zeros(*shape, self.self_model.latent),
            torch.full(shape, len(self.domain.actions), device=like.device),
            _flat(self.domain.nothing_known(*shape, device=like.device), len(shape)),
        )

    def sees(self, observation: Observation) -> Visibility:
        """What is within reach, or all that the setting lets people see."""
        if self.reach is None:
            return self.domain.visibility(self.setting, observation)
        direction, distance = self.domain.distance(observation)
        people = torch.arange(len(self.reach)).view(-1, *(1,) * (distance.dim() - 1))
        return by_eye(self.domain, distance <= self.reach[people, direction])

    @torch.no_grad()
    def step(
        self, memory: Mind, observation: Observation, told: Visibility | None = None
    ) -> tuple[Tensor, Mind]:
        """Infer what is so by the robot's encoder, and choose by its values."""
        domain, encoder = self.domain, self.self_model.encoder
        visible = self.sees(observation)
        if told is not None:
            visible = {name: mask | told[name] for name, mask in visible.items()}
        shape = memory.action.shape
        like = domain.nothing_known(*shape, device=memory.action.device)
        knowledge = domain.learn(_like(like, memory.knowledge), observation, visible, self.sees)
        remembered = domain.known(knowledge)
        visible = {name: mask | remembered[name] for name, mask in visible.items()}
        evidence = encoder.combine(encoder.embed(domain.symbols(observation)), visible)
        evidence = evidence + encoder.action(memory.action)
        belief = encoder(memory.belief, evidence).mean
        values = self.self_model.action_values(belief)
        scale = self.consistency.view(-1, *(1,) * (values.dim() - 1))
        mind = Mind(belief, memory.action, _flat(knowledge, len(shape)))
        return torch.softmax(scale * values, -1), mind

    def acted(self, memory: Mind, action: Tensor) -> Mind:
        """They know what they did."""
        return Mind(memory.belief, action, memory.knowledge)

    def truth(self) -> dict[str, Tensor]:
        """Their consistency, and how far they see if it is up to them."""
        own = {"consistency": self.consistency}
        if self.reach is not None:
            own |= {
                SIGHT + name: self.reach[:, place]
                for place, name in enumerate(self.domain.directions)
            }
        return own

    def provenance(self) -> dict[str, str]:
        """The fingerprint of the robot whose networks they have."""
        return {SELF_MODEL: fingerprint(self.self_model)}

    def modelled(self) -> tuple[HumanModel, dict[str, Tensor]] | None:
        """The human model of the paper, which they are but for sight that a setting limits."""
        if self.reach is None:
            return None
        human = HumanModel(self.self_model)
        drawn = draw_prior(human, len(self.consistency), 1, 0)
        own = {name: torch.zeros_like(value) for name, value in drawn.items()}
        own["consistency"] = self.consistency[None, :, None]
        own["lapse"] = torch.full_like(drawn["lapse"], LEAST_PROBABILITY)
        bins = torch.tensor(self.domain.reach_bins, device=self.reach.device)
        for place, site in enumerate(sight_sites(self.domain)):
            own[site] = torch.searchsorted(bins, self.reach[:, place])[None, :, None]
        return human, own


def simulated_robot_like(
    self_model: SelfModel, setting: str, population: str, people: int, seed: int
) -> RobotLike:
    """People of a population: ``diverse``, each of a reach of their own, or ``paper``.

    Raises:
        UnknownNameError: there is no such setting or population.
    """
    domain = self_model.domain
    require_known(setting, "setting", domain.settings, domain.name)
    require_known(population, "population", POPULATIONS, domain.name)
    bins = torch.tensor(domain.reach_bins)
    reach, consistency = [], []
    for person in range(people):
        generator = derived_generator(seed, "robot-like", person)
        drawn = torch.randint(len(bins), (len(domain.directions),), generator=generator)
        reach.append(bins[drawn])
        consistency.append(CONSISTENCY_SPREAD * torch.randn((), generator=generator))
    return RobotLike(
        self_model,
        setting,
        torch.stack(reach) if population == "diverse" else None,
        CONSISTENCY_MEDIAN * torch.stack(consistency).exp(),
    )


def _flat(knowledge: object, dimensions: int) -> Tensor:
    parts = [
        part.flatten(dimensions) if part.dim() > dimensions else part[..., None]
        for part in vars(knowledge).values()
    ]
    return torch.cat([part.to(torch.get_default_dtype()) for part in parts], -1)


def _like(example: object, flat: Tensor) -> object:
    """Knowledge of the example's shapes and types, the inverse of `_flat`."""
    parts = list(vars(example).values())
    dimensions = flat.dim() - 1
    pieces = iter(flat.split([part[(0,) * dimensions].numel() for part in parts], -1))
    return map_state(lambda part: next(pieces).reshape(part.shape).to(part.dtype), example)
