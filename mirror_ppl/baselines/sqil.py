"""SQIL: soft Q imitation learning, with recurrent networks.

Implements the baseline SQIL of MIRROR (Chen, Fong and Soh, RSS 2022; supplement, section D) after
Reddy, Dragan and Levine, *SQIL: Imitation Learning via Reinforcement Learning with Sparse Rewards*
(ICLR 2020)::

    h_t = GRU(h_{t-1}, [ego_t, v_t * x_t, v_t, m_t, a_{t-1}])               48 units
    Q(h_t, .) = output(relu(layer_3(relu(layer_2(relu(layer_1(h_t)))))))    three layers of 32
    a_t ~ Categorical(softmax(Q(h_t, .)))                                   on the highway 128 each

    delta^2(D, r) = mean over D of (Q(h_t, a_t) - r - discount * log sum_a exp Q(h_{t+1}, a))^2
    loss          = delta^2(recorded, reward) + sampled_weight * delta^2(sampled, 0)

Sampled rounds are played in the domain by the network itself and have reward 0, so that it keeps to
the person's actions. Each person has a separate network.

Departures from the supplement are those of `mirror_ppl.baselines.behaviour_cloning`: the GRU reads
``a_{t-1}``, masks are inputs, input weights are initialized at zero, training stops early. The
value after a round's last step is 0. The reward is larger than 1, which is equivalent to a
temperature below 1: people are more consistent than a reward of 1 implies.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from mirror_ppl.baselines.inputs import StepInputs, look, network_inputs
from mirror_ppl.baselines.recurrent import RecurrentNetworks, initial_weights
from mirror_ppl.baselines.training import (
    Report,
    TrainingOptions,
    check_parts,
    no_report,
    train_each,
)
from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.domains.base import map_state
from mirror_ppl.errors import InputError
from mirror_ppl.randomness import derived_generator

SAMPLED = 0.0
"""Reward of steps in sampled rounds."""


@dataclass(frozen=True)
class SoftQOptions(TrainingOptions):
    """Settings of SQIL.

    The defaults solve the tests' tasks with each of three seeds. Action values are initialized
    where they would be if all actions were equivalent; otherwise the first steps left units dead,
    and every other run learned nothing.

    Attributes:
        reward: of the person's actions.
        discount: per step.
        target_rate: rate per gradient step at which the target network follows the trained one.
        sampled_weight: weight of the error in sampled rounds.
        sampled: number of rounds sampled at a time.
        sample_every: gradient steps between samplings.
        kept: number of the latest sets of sampled rounds that are learned from.
    """

    learning_rate: float = 0.02
    weight_decay: float = 0.3
    epochs: int = 200
    patience: int = 20
    layers: tuple[int, ...] = (32, 32, 32)
    reward: float = 5.0
    discount: float = 0.5
    target_rate: float = 0.2
    sampled_weight: float = 1.0
    sampled: int = 10
    sample_every: int = 10
    kept: int = 5

    BASELINE = "sqil"
    COUNTS = (*TrainingOptions.COUNTS, "sampled", "sample_every", "kept")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.reward > 0:
            raise InputError(f"reward must be positive, not {self.reward}")
        if not 0 <= self.discount < 1:
            raise InputError(f"discount must be at least 0 and below 1, not {self.discount}")


class SoftQ(RecurrentNetworks):
    """Networks of ``Q(h_t, a_t)``: outputs are soft action values, and logits of actions.

    Made by `fit_soft_q`.
    """

    @torch.no_grad()
    def play(
        self,
        setting: str,
        rounds: int,
        generators: Sequence[torch.Generator],
        told: Tensor | None = None,
    ) -> tuple[StepInputs, Tensor]:
        """Play rounds with the networks.

        Args:
            setting: the setting, which limits unaided sight.
            rounds: number of rounds B of each of P people.
            generators: one for each person.
            told: probability ``[P]`` that a communicable item is communicated, at each step.

        Returns:
            Inputs, and actions ``[P, B, T]``, -1 after the end.
        """
        domain, people = self.domain, len(self.people)
        begin = [domain.initial(rounds, generator) for generator in generators]
        hidden = self.start(rounds)
        state = map_state(lambda *parts: torch.stack(parts).to(hidden.device), *begin)
        last = torch.full((people, rounds), len(domain.actions), device=hidden.device)
        knowledge = domain.nothing_known(people, rounds, device=hidden.device)
        inputs, actions = [], []
        for _ in range(domain.horizon):
            observation = domain.observe(state)
            can_be = domain.communicable(observation)
            heard = {name: torch.zeros_like(may) for name, may in can_be.items()}
            if told is not None and told.any():
                for m in domain.modalities:
                    shape = (rounds, len(m.communicated))
                    noise = torch.stack([torch.rand(shape, generator=own) for own in generators])
                    noise = noise.to(told.device)
                    heard[m.name] = can_be[m.name] & m.items_of(noise < told[:, None, None])
            seen, heard, knowledge = look(
                domain, self.sight, setting, knowledge, observation, heard
            )
            inputs.append(network_inputs(domain, observation, seen, heard, last))
            hidden = self.step(hidden, inputs[-1])
            probabilities = self.act(hidden).exp().cpu()  # as generators are
            drawn = [
                torch.multinomial(own, 1, generator=generator).squeeze(-1)
                for own, generator in zip(probabilities, generators, strict=True)
            ]
            last = torch.stack(drawn).to(hidden.device)
            actions.append(torch.where(domain.over(state), -1, last))
            state = domain.transition(state, last)
        return StepInputs.of(torch.stack(inputs, 2)), torch.stack(actions, 2)


def squared_errors(
    networks: SoftQ,
    target: SoftQ,
    inputs: StepInputs,
    actions: Tensor,
    reward: Tensor,
    discount: float,
) -> Tensor:
    """Squared Bellman errors at all steps of each person's rounds ``[P, B, T]``, zero in padding.

    Args:
        networks: the trained networks.
        target: networks that give the values of the next step.
        inputs: of the rounds.
        actions: ``[P, B, T]``, -1 in padding.
        reward: of every step of a round, ``[B, 1]``.
        discount: per step.
    """
    real = actions >= 0
    with torch.no_grad():
        ahead = torch.where(real, target(inputs).logsumexp(-1), 0.0)
        ahead = pad(ahead[..., 1:], [0, 1])
    own = networks(inputs).gather(-1, actions.clamp(min=0)[..., None]).squeeze(-1)
    return torch.where(real, own - reward - discount * ahead, 0.0).square()


def mean_error(errors: Tensor, actions: Tensor) -> Tensor:
    """``delta^2`` ``[P]``, the mean over real steps of errors ``[P, B, T]``."""
    return errors.sum((1, 2)) / (actions >= 0).sum((1, 2)).clamp(min=1)


def soft_q_loss(
    networks: SoftQ,
    target: SoftQ,
    recorded: tuple[StepInputs, Tensor],
    played: tuple[StepInputs, Tensor],
    options: SoftQOptions,
) -> Tensor:
    """Weighted sum ``[P]`` of ``delta^2`` of recorded and of sampled rounds.

    Args:
        networks: the trained networks.
        target: networks that give the values of the next step.
        recorded: inputs, and actions ``[P, B, T]``, -1 in padding.
        played: inputs and actions of rounds that the networks played.
        options: settings.
    """
    # One pass over both costs little more than a pass over either.
    inputs = recorded[0].beside(played[0])
    steps = inputs.place.shape[-1]
    own, other = (
        pad(actions, [0, steps - actions.shape[-1]], value=-1) for _, actions in (recorded, played)
    )
    number = own.shape[1]
    reward = torch.full((number + other.shape[1], 1), SAMPLED, device=own.device)
    reward[:number] = options.reward
    errors = squared_errors(
        networks, target, inputs, torch.cat([own, other], 1), reward, options.discount
    )
    sampled_error = mean_error(errors[:, number:], other)
    return mean_error(errors[:, :number], own) + options.sampled_weight * sampled_error


def fit_soft_q(
    train: Demonstrations,
    validation: Demonstrations,
    options: SoftQOptions,
    seed: int,
    report: Report = no_report,
) -> SoftQ:
    """Fit a separate soft Q network to each of P people.

    Args:
        train: rounds to learn from, of any lengths and numbers.
        validation: rounds of the same people in the same order, for early stopping.
        options: settings.
        seed: seed of everything random here; with a person's id and rounds it determines their
            network.
        report: called at each validation with the number of gradient steps done (in the end
            ``options.epochs``, even after early stopping) and a message.

    Returns:
        The networks, on the device of the training rounds.

    Raises:
        DemonstrationsError: a person has no training or no validation round; or the validation
            rounds are of another domain or other people.
    """
    check_parts(train, validation)
    domain = get_domain(train.domain)
    generators = [derived_generator(seed, "soft q", name) for name in train.people]
    weights = initial_weights(domain, options.hidden, options.layers, generators)
    weights["output_bias"] += _usual_value(options, len(domain.actions))
    networks = SoftQ(domain, train.people, options.sight, weights).to(train.actions.device)
    target = copy.deepcopy(networks).requires_grad_(False)
    sampled: list[tuple[StepInputs, Tensor]] = []
    told = _told_rates(train)

    def loss(step: int, inputs: StepInputs, actions: Tensor) -> Tensor:
        if step:
            with torch.no_grad():
                for slow, fast in zip(target.parameters(), networks.parameters(), strict=True):
                    slow.lerp_(fast, options.target_rate)
        if step % options.sample_every == 0:
            sampled.append(networks.play(train.setting, options.sampled, generators, told))
            del sampled[: -options.kept]
        played = sampled[step % len(sampled)]
        return soft_q_loss(networks, target, (inputs, actions), played, options)

    train_each(networks, (train, validation), loss, options, generators, report)
    return networks.requires_grad_(False)


def _told_rates(train: Demonstrations) -> Tensor:
    """Share of the communicable items that were communicated to each person, ``[P]``."""
    real = (train.actions >= 0)[..., None]
    told = could = torch.zeros(train.num_people, device=real.device)
    for name, may in get_domain(train.domain).communicable(train.observation()).items():
        may = may[:, :, : real.shape[2]] & real
        told = told + (may & train.told[name]).sum((1, 2, 3))
        could = could + may.sum((1, 2, 3))
    return told / could.clamp(min=1)


def _usual_value(options: SoftQOptions, actions: int) -> float:
    """Value at which a step's mean error is 0 if all actions and steps are equivalent.

    Networks that are initialized there only have to learn differences; otherwise the first steps,
    which move all values equally, leave most units dead.
    """
    reward = (options.reward + options.sampled_weight * SAMPLED) / (1 + options.sampled_weight)
    return (reward + options.discount * math.log(actions)) / (1 - options.discount)
