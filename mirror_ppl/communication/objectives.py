"""Objectives: map candidate messages to utilities, one for each posterior draw.

A candidate is a sequence of messages ``[L, N]``: the first is for now, the others for the steps
that follow, with silence after L steps. C candidates are valued at once, with common random
numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from mirror_ppl.checks import require_methods, whole_number
from mirror_ppl.communication.action_sequences import ActionSequences
from mirror_ppl.communication.messages import Channels
from mirror_ppl.communication.person import PlanningContext
from mirror_ppl.communication.rollouts import World, robot_belief
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.errors import HumanModelError, InputError
from mirror_ppl.likelihood.attention import attention_sites
from mirror_ppl.likelihood.combinations import perceived_names
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.networks import Gaussian
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.self_model import SelfModel


@dataclass(frozen=True)
class Valued:
    """Values of candidates.

    Attributes:
        utility: of each candidate under each posterior draw, in units of reward, ``[C, S]``.
        actions: predicted probabilities of actions at each step ahead, ``[C, H, A]``; ``None``
            where the objective does not predict actions.
        worlds: number of draws W of the world; posterior draw s was valued in draw s mod W. Or the
            number of posterior draws that repeat, in the same way.
    """

    utility: Tensor
    actions: Tensor | None
    worlds: int = 1

    @property
    def mean(self) -> Tensor:
        """Expected utility of each candidate, ``[C]``; each draw of the world counts the same."""
        return self.independent(self.utility).mean(-1)

    def independent(self, gain: Tensor) -> Tensor:
        """Return gains ``[..., S]`` whose spread is that of a mean: those of draws, or means by W.

        Posterior draws that were valued in one draw of the world share its chance; those that are
        the same differ in sampled actions alone.
        """
        draws = gain.shape[-1]
        if not 1 < self.worlds < draws:
            return gain
        share = torch.zeros(draws, self.worlds, dtype=gain.dtype, device=gain.device)
        share[torch.arange(draws), torch.arange(draws) % self.worlds] = 1.0
        return gain @ (share / share.sum(0))


Value = Callable[[Tensor], Valued]
"""Values candidates ``[C, L, N]``; the same candidates always get the same values."""


class Objective(Protocol):
    """An objective of a communicator.

    An objective that values the message of the present step alone has a true attribute
    ``one_step``, so that no plans of several steps are compared.
    """

    def at(self, context: PlanningContext, steps_left: int, seed: int) -> Value:
        """Return the function that values candidates at this point of a round.

        Args:
            context: the person at this point.
            steps_left: number of actions left, at least 1.
            seed: of the random numbers that all candidates share.
        """
        ...


@dataclass(frozen=True)
class ExpectedUtility:
    """``U(c) = E[ sum_{h<H} discount^h ( r_{t+h} - cost(c_{t+h}) ) ]``.

    The expectation is over posterior draws, draws of the world, and the person's actions. The cost
    is that of the whole plan ``c``, also of items that will not be communicable at their step, or
    where the round will be over by then; such plans are slightly undervalued. Action
    sequences form a tree; those more probable than ``enumerate_above`` are enumerated, the others
    are sampled and reweighted. At 0 the expectation over actions is exact, at 1 each draw follows a
    single action sequence; the estimate is unbiased at every value.

    A terminal value is computed as the value now plus the advantages of later actions,
    ``r_t + discount * V(s_{t+1}) - V(s_t)``. The sum is the same, with less variance from sampled
    sequences.

    Attributes:
        world: the world in which actions are rolled out.
        horizon: number of steps H planned ahead.
        discount: per step.
        enumerate_above: probability of an action sequence above which it is enumerated.
        terminal_value: whether to add the optimal value after the last of these steps, where the
            round goes on.
    """

    world: World
    horizon: int = 10
    discount: float = 1.0
    enumerate_above: float = 0.1
    terminal_value: bool = False

    def __post_init__(self) -> None:
        require_methods(self.world, ["rollouts"], "world", "a world such as SimulatorWorld(domain)")
        object.__setattr__(self, "horizon", whole_number(self.horizon, "horizon", 1))
        if not 0 < self.discount <= 1:
            raise InputError(f"discount must be above 0 and at most 1, not {self.discount}")
        if not 0 <= self.enumerate_above <= 1:
            raise InputError(f"enumerate_above must be from 0 to 1, not {self.enumerate_above}")

    def at(self, context: PlanningContext, steps_left: int, seed: int) -> Value:
        """Return the function that values candidates; see :class:`Objective`."""
        person, past = context.person, context.past
        horizon = min(self.horizon, steps_left)
        device = past.actions.device
        generator = torch.Generator(device).manual_seed(seed)
        rollouts = self.world.rollouts(past, horizon, generator)
        channels = Channels(person.human.domain)
        ends = steps_left <= horizon
        discounts = self.discount ** torch.arange(horizon, device=device)

        @torch.no_grad()
        def value(candidates: Tensor) -> Valued:
            worlds, roots = rollouts.observation(0)["ego"].shape[:2]
            tree = ActionSequences(context, candidates, worlds, roots)
            utility = torch.zeros(len(candidates), person.number, device=device)
            if self.terminal_value:
                draw = torch.arange(person.number, device=device)
                utility += rollouts.values(0)[draw % worlds, draw % roots]
            predicted = []
            for step in range(horizon):
                observation = {
                    name: part.flatten(0, 1) for name, part in rollouts.observation(step).items()
                }
                probabilities = tree.act(observation, step, channels)
                gains = (
                    rollouts.advantages(step, self.discount)
                    if self.terminal_value
                    else rollouts.rewards(step)
                )
                gained = gains[tree.draw_of_world(), tree.path]
                utility += tree.of_each(discounts[step] * (probabilities * gained).sum(-1))
                predicted.append(tree.of_each(probabilities).mean(1))
                if step < horizon - 1 or (self.terminal_value and ends):
                    tree.branch(probabilities, rollouts, step, self.enumerate_above, seed)
            if self.terminal_value and ends:
                # There is no terminal value where the round ends.
                left = rollouts.values(horizon)[tree.draw_of_world(), tree.path]
                utility -= tree.of_each((self.discount**horizon) * tree.weight * left)
            steps = min(candidates.shape[1], horizon)
            cost = (channels.cost(candidates)[:, :steps] * discounts[:steps]).sum(1)
            utility -= cost[:, None]
            worlds = self.world.draws if self.world.draws > 1 else person.cycle
            return Valued(utility, torch.stack(predicted, 1), worlds)

        return value


@dataclass(frozen=True)
class ExpectedValue:
    """``U(c) = E[ Q(z^R_t, a_t) ] - cost(c_t)``: the value of what the person does next.

    Values are the robot's, who sees everything. Nothing is rolled out: after the next action, the
    person is taken to act as the robot's values suppose. Only the message of the present step
    counts. For worlds in which a roll-out costs too much, or values are of plans that are kept up.
    """

    one_step: ClassVar[bool] = True

    def at(self, context: PlanningContext, steps_left: int, seed: int) -> Value:
        """Return the function that values candidates; steps left and seed are not used."""
        del steps_left, seed
        person = context.person
        human = person.human
        channels = Channels(human.domain)
        true_values = robot_values(human.self_model, context.past)

        @torch.no_grad()
        def value(candidates: Tensor) -> Valued:
            message = candidates[:, 0]
            probabilities = predicted_choices(context, message)
            utility = (probabilities * true_values).sum(-1).T
            predicted = probabilities.mean(0)[:, None]
            return Valued(utility - channels.cost(message)[:, None], predicted, person.cycle)

        return value


def robot_values(self_model: SelfModel, past: RoundSoFar) -> Tensor:
    """Return the action values ``[A]`` of the robot, who sees everything."""
    return self_model.action_values(robot_belief(self_model, past).mean).view(-1)


def predicted_choices(context: PlanningContext, messages: Tensor) -> Tensor:
    """Return probabilities of the next action ``[S, C, A]`` after messages ``[C, N]``."""
    person = context.person
    state, index = context.told(messages)
    # Beliefs of each draw after each message, [S, C].
    own = state.belief[index][:, person.percept].T
    beliefs, values = state.mean, person.human.action_values(state.mean)
    return person.act(beliefs[own], values[own]).exp()


@dataclass(frozen=True)
class Divergence:
    """``U(c) = - weight * KL( q(z^R_t) || q(zH_t | c) ) - cost(c_t)``: MIRROR-KL.

    Brings the person's belief close to the robot's, ignoring rewards. Only the message of the
    present step counts.

    Attributes:
        weight: units of reward per nat of divergence.
        measure: ``kl``, or ``squared``, the squared distance of means in the authors' released
            code.
    """

    one_step: ClassVar[bool] = True

    weight: float = 1.0
    measure: str = "kl"

    def __post_init__(self) -> None:
        if self.measure not in ("kl", "squared"):
            raise InputError(f'measure must be kl or squared, not "{self.measure}"')
        if not self.weight > 0:
            raise InputError(f"weight must be positive, not {self.weight}")

    def at(self, context: PlanningContext, steps_left: int, seed: int) -> Value:
        """Return the function that values candidates; steps left and seed are not used.

        Raises:
            HumanModelError: the beliefs of the human model have no density like the robot's.
        """
        person = context.person
        require_density(person.human)
        channels = Channels(person.human.domain)
        robot = robot_belief(person.human.self_model, context.past)

        @torch.no_grad()
        def value(candidates: Tensor) -> Valued:
            message = candidates[:, 0]
            state, index = context.told(message)
            assert state.scale is not None
            apart = self._apart(robot, Gaussian(state.mean, state.scale))[state.belief[index]]
            utility = -self.weight * apart[:, person.percept]
            return Valued(utility - channels.cost(message)[:, None], None, person.cycle)

        return value

    def _apart(self, robot: Gaussian, person: Gaussian) -> Tensor:
        squared = (robot.mean - person.mean).pow(2)
        if self.measure == "squared":
            return squared.sum(-1)
        ratio = (robot.scale / person.scale).pow(2)
        return 0.5 * (ratio + squared / person.scale.pow(2) - 1 - ratio.log()).sum(-1)


@torch.no_grad()
def beliefs_have_density(human: HumanModel) -> bool:
    """True if beliefs of a human model have densities to compare with the robot's."""
    domain = human.domain
    device = next(human.parameters()).device
    observation = domain.observe(domain.initial(1, torch.Generator(device).manual_seed(0)))
    nothing = {
        m.name: torch.zeros(1, len(m.items), dtype=torch.bool, device=device)
        for m in domain.modalities
    }
    drawn = draw_prior(human, 1, 1, 0)
    implants = {name: drawn[name][0, 0] for name in perceived_names(human)}
    implants |= {name: support[:1] for name, support in attention_sites(human).items()}
    known = human.nothing_known(1, device=device)
    view, _ = human.perceive(implants, known, observation, nothing, 0)
    evidence = human.evidence(view, observation)
    none = torch.full((1,), len(domain.actions), device=device)
    state = human.believe(evidence.new_zeros(1, human.belief_size), evidence, none)
    return isinstance(state, Gaussian) and human.belief_size == human.self_model.latent


def require_density(human: HumanModel) -> None:
    """Refuse human models whose beliefs have no density to compare with the robot's.

    Raises:
        HumanModelError: the model's beliefs have none.
    """
    if not beliefs_have_density(human):
        raise HumanModelError(
            f"beliefs of {type(human).__name__} have no density like the robot's, which mirror-kl "
            "compares: its believe returns no Gaussian, or one of another size"
        )
