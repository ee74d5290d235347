"""People of any world who act like the robot, with their own limited sight and consistency."""

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
    CONSISTENCY_SPREAD,
    LEAST_PROBABILITY,
    MOTOR_NOISE,
    MOTOR_NOISE_MEDIAN,
    MOTOR_NOISE_SPREAD,
    SIGHT,
    executed,
    sight_sites,
)
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.value_errors import choice_values
from mirror_ppl.models.weights import SELF_MODEL, fingerprint
from mirror_ppl.people.base import SimulatedPeople
from mirror_ppl.randomness import derived_generator

POPULATIONS = ("diverse", "paper")


@dataclass(frozen=True)
class Mind:
    """Beliefs, knowledge and last actions of people.

    Attributes:
        belief: the encoder's mean, ``[P, ..., Z]``.
        action: ``[P, ...]``; the number of actions before the first one.
        knowledge: fields of the domain's knowledge, ``[P, ..., *]``, flattened and concatenated.
    """

    belief: Tensor
    action: Tensor
    knowledge: Tensor


@dataclass(frozen=True)
class RobotLike(SimulatedPeople):
    """P people who infer and value as the robot does.

    Attributes:
        self_model: the robot's.
        setting: setting that limits the sight of people without thresholds.
        reach: threshold of sight for each direction ``[P, D]``, or ``None``.
        consistency: inverse temperature of their choices per unit of reward, ``[P]``.
        motor_noise: standard deviation of executed controls, in distances between levels of the
            grid, ``[P]``; ``None`` where actions are numbered.
    """

    self_model: SelfModel
    setting: str
    reach: Tensor | None
    consistency: Tensor
    motor_noise: Tensor | None = None

    @property
    def domain(self) -> Domain:
        """World in which they act."""
        return self.self_model.domain

    def start(self, *batch: int, mind_noise: Tensor | None = None) -> Mind:
        """Return memories before a round begins."""
        del mind_noise
        shape, like = (len(self.consistency), *batch), self.consistency
        return Mind(
            like.new_zeros(*shape, self.self_model.latent),
            torch.full(shape, len(self.domain.actions), device=like.device),
            _flat(self.domain.nothing_known(*shape, device=like.device), len(shape)),
        )

    def sees(self, observation: Observation) -> Visibility:
        """Return items within reach, or those visible in the setting."""
        if self.reach is None:
            return self.domain.visibility(self.setting, observation)
        direction, distance = self.domain.distance(observation)
        people = torch.arange(len(self.reach)).view(-1, *(1,) * (distance.dim() - 1))
        everything = self.reach >= torch.tensor(self.domain.reach_bins[-1:]).to(self.reach)
        limits = self.reach.masked_fill(everything, torch.inf)
        return by_eye(self.domain, distance <= limits[people, direction])

    @torch.no_grad()
    def step(
        self, memory: Mind, observation: Observation, told: Visibility | None = None
    ) -> tuple[Tensor, Mind]:
        """Update beliefs by the robot's encoder, and choose by its action values."""
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
        values = choice_values(self.self_model, belief)
        scale = self.consistency.view(-1, *(1,) * (values.dim() - 1))
        mind = Mind(belief, memory.action, _flat(knowledge, len(shape)))
        chosen = torch.softmax(scale * values, -1)
        if self.motor_noise is not None:
            own = {MOTOR_NOISE: self.motor_noise.view(scale.shape[:-1])}
            chosen = executed(domain, own, chosen.log()).exp()
        return chosen, mind

    def acted(self, memory: Mind, action: Tensor) -> Mind:
        """Return the memory with the chosen action."""
        return Mind(memory.belief, action, memory.knowledge)

    def truth(self) -> dict[str, Tensor]:
        """Return their consistency, and sight thresholds if they have them."""
        own = {"consistency": self.consistency}
        if self.motor_noise is not None:
            own[MOTOR_NOISE] = self.motor_noise
        if self.reach is not None:
            own |= {
                SIGHT + name: self.reach[:, place]
                for place, name in enumerate(self.domain.directions)
            }
        return own

    def provenance(self) -> dict[str, str]:
        """Return the fingerprint of their self-model."""
        return {SELF_MODEL: fingerprint(self.self_model)}

    def modelled(self) -> tuple[HumanModel, dict[str, Tensor]] | None:
        """Return the paper's human model, or None if a setting limits their sight."""
        if self.reach is None:
            return None
        human = HumanModel(self.self_model)
        drawn = draw_prior(human, len(self.consistency), 1, 0)
        own = {name: torch.zeros_like(value) for name, value in drawn.items()}
        own["consistency"] = self.consistency[None, :, None]
        if self.motor_noise is not None:
            own[MOTOR_NOISE] = self.motor_noise[None, :, None]
        own["lapse"] = torch.full_like(drawn["lapse"], LEAST_PROBABILITY)
        bins = torch.tensor(self.domain.reach_bins, device=self.reach.device)
        for place, site in enumerate(sight_sites(self.domain)):
            own[site] = torch.searchsorted(bins, self.reach[:, place])[None, :, None]
        return human, own


def simulated_robot_like(
    self_model: SelfModel, setting: str, population: str, people: int, seed: int
) -> RobotLike:
    """Make people of a population: ``diverse``, each with their own reach, or ``paper``.

    Raises:
        UnknownNameError: there is no such setting or population.
    """
    domain = self_model.domain
    require_known(setting, "setting", domain.settings, domain.name)
    require_known(population, "population", POPULATIONS, domain.name)
    bins = torch.tensor(domain.reach_bins)
    reach, consistency, noise = [], [], []
    for person in range(people):
        generator = derived_generator(seed, "robot-like", person)
        drawn = torch.randint(len(bins), (len(domain.directions),), generator=generator)
        reach.append(bins[drawn])
        consistency.append(CONSISTENCY_SPREAD * torch.randn((), generator=generator))
        noise.append(MOTOR_NOISE_SPREAD * torch.randn((), generator=generator))
    device = next(self_model.parameters()).device
    motor_noise = MOTOR_NOISE_MEDIAN * torch.stack(noise).exp()
    return RobotLike(
        self_model,
        setting,
        torch.stack(reach).to(device) if population == "diverse" else None,
        (domain.record.consistency * torch.stack(consistency).exp()).to(device),
        motor_noise.to(device) if domain.controls else None,
    )


def _flat(knowledge: object, dimensions: int) -> Tensor:
    parts = [
        part.flatten(dimensions) if part.dim() > dimensions else part[..., None]
        for part in vars(knowledge).values()
    ]
    return torch.cat([part.to(torch.get_default_dtype()) for part in parts], -1)


def _like(example: object, flat: Tensor) -> object:
    """Restore knowledge of the example's shapes and dtypes, the inverse of `_flat`."""
    parts = list(vars(example).values())
    dimensions = flat.dim() - 1
    pieces = iter(flat.split([part[(0,) * dimensions].numel() for part in parts], -1))
    return map_state(lambda part: next(pieces).reshape(part.shape).to(part.dtype), example)
