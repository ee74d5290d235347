"""What messages are worth: objectives that map candidates to utilities, one for each draw.

A candidate is a sequence of messages ``[L, N]``: the first is for now, the others for the steps
that follow, and after L steps nothing is said. C candidates are valued at once, under the same
random numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from mirror_ppl.checks import require_methods, whole_number
from mirror_ppl.communication.messages import Channels
from mirror_ppl.communication.person import PlanningContext
from mirror_ppl.communication.rollouts import RolloutTree, World, robot_belief
from mirror_ppl.domains.base import Observation
from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.attention import attention_sites
from mirror_ppl.likelihood.combinations import discrete_sites
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.networks import Gaussian
from mirror_ppl.row_hashing import as_whole_numbers, distinct_rows, mixed, uniform_of


@dataclass(frozen=True)
class Valued:
    """What candidates are worth.

    Attributes:
        utility: of each candidate under each posterior draw, in units of reward, ``[C, S]``.
        actions: predicted probabilities of actions at each step ahead, ``[C, H, A]``; ``None``
            where the objective does not look at actions.
    """

    utility: Tensor
    actions: Tensor | None


Value = Callable[[Tensor], Valued]
"""Values candidates ``[C, L, N]``; the same candidates always get the same values."""


class Objective(Protocol):
    """What a communicator wants.

    One that values the message of the present step alone has an attribute ``one_step`` that is
    true, so that no plans of several steps are compared.
    """

    def at(self, context: PlanningContext, steps_left: int, seed: int) -> Value:
        """What candidates are worth at this point of a round.

        Args:
            context: the person at this point.
            steps_left: how many actions are left, at least 1.
            seed: of the random numbers that all candidates share.
        """
        ...


@dataclass(frozen=True)
class ExpectedUtility:
    """``U(c) = E[ sum_{h<H} discount^h ( r_{t+h} - cost(c_{t+h}) ) ]``.

    The expectation is over posterior draws, draws of the world, and the person's actions. Of the
    latter it is a tree in which courses less probable than ``enumerate_above`` are kept by chance,
    with a weight that makes up for it: at 0 the expectation over actions is exact, at 1 each draw
    follows a single course of actions. In between, what is probable is exact and the improbable
    cheap, and the expectation is right at every value.

    Where what could be gained after the horizon counts, it is added up as what could be gained now
    and the advantages on the way, ``r_t + discount * V(s_{t+1}) - V(s_t)``. The sum is the same,
    but only small numbers depend on which courses are kept by chance.

    Attributes:
        world: what is rolled forward.
        horizon: steps H that are looked ahead.
        discount: per step.
        enumerate_above: probability of a course of actions below which it is kept by chance.
        terminal_value: whether what could be gained at best after the last of these steps counts
            too, where the round goes on.
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
            raise ValueError(f"discount must be above 0 and at most 1, not {self.discount}")
        if not 0 <= self.enumerate_above <= 1:
            raise ValueError(f"enumerate_above must be from 0 to 1, not {self.enumerate_above}")

    def at(self, context: PlanningContext, steps_left: int, seed: int) -> Value:
        """See :class:`Objective`."""
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
            tree = _Tree(context, candidates, self.world.draws)
            utility = torch.zeros(len(candidates), person.number, device=device)
            if self.terminal_value:
                world = torch.arange(person.number, device=device) % self.world.draws
                utility += rollouts.values(0)[world, 0]
            predicted = []
            for step in range(horizon):
                observation = {
                    name: part.flatten(0, 1) for name, part in rollouts.observation(step).items()
                }
                chances = tree.act(observation, step, channels)
                gains = (
                    rollouts.advantages(step, self.discount)
                    if self.terminal_value
                    else rollouts.rewards(step)
                )
                gained = gains[tree.draw_of_world(), tree.path]
                utility += tree.of_each(discounts[step] * (chances * gained).sum(-1))
                predicted.append(tree.of_each(chances).mean(1))
                if step < horizon - 1 or (self.terminal_value and ends):
                    tree.branch(chances, rollouts, step, self.enumerate_above, seed)
            if self.terminal_value and ends:
                # What could be gained is lost where the round ends.
                left = rollouts.values(horizon)[tree.draw_of_world(), tree.path]
                utility -= tree.of_each((self.discount**horizon) * tree.weight * left)
            steps = min(candidates.shape[1], horizon)
            cost = (channels.cost(candidates)[:, :steps] * discounts[:steps]).sum(1)
            return Valued(utility - cost[:, None], torch.stack(predicted, 1))

        return value


class _Tree:
    """Courses of actions of each candidate and draw, sorted by draw; E courses in all.

    Candidates that have led a draw to the same beliefs on the same paths, and go on with the same
    messages, have the same courses from there on: they are a *group*, and count once.

    Attributes:
        draw, path, weight, group: of each course ``[E]``.
        belief: what the person believes and knows on it ``[E]``, an index into ``state``.
        state: after the last step that was looked at.
        candidate: one of each group, ``[G]``.
        group_of: of each candidate and draw, ``[C, S]``.
    """

    def __init__(self, context: PlanningContext, candidates: Tensor, worlds: int) -> None:
        device = candidates.device
        person = self.person = context.person
        self.candidates, self.worlds = candidates, worlds
        self.actions = len(person.human.domain.actions)
        count = len(candidates)
        self.draw = torch.arange(person.number, device=device).repeat_interleave(count)
        self.candidate = torch.arange(count, device=device).repeat(person.number)
        self.group = torch.arange(len(self.draw), device=device)
        self.group_of = self.group.view(person.number, count).T
        self.path = torch.zeros_like(self.draw)
        self.weight = torch.ones(len(self.draw), device=device)
        self.state = context.before
        self.belief = context.own[person.percept[self.draw]]
        self.last = torch.full_like(self.draw, context.last_action)

    def draw_of_world(self) -> Tensor:
        """Which draw of the world each course is in, ``[E]``."""
        return self.draw % self.worlds

    def of_each(self, values: Tensor) -> Tensor:
        """Sums of values ``[E, ...]`` of courses, of each candidate and draw ``[C, S, ...]``."""
        total = values.new_zeros(len(self.candidate), *values.shape[1:])
        return total.index_add_(0, self.group, values)[self.group_of]

    def act(self, observation: Observation, step: int, channels: Channels) -> Tensor:
        """Look at the world and choose: weights ``[E, A]`` of each course and its next action."""
        paths = len(observation["ego"]) // self.worlds
        row = self.draw_of_world() * paths + self.path
        percept = self.person.percept[self.draw]
        told = self.candidates[:, step] if step < self.candidates.shape[1] else None
        key = (self.belief * self.person.percept_count + percept) * (self.worlds * paths) + row
        message = None
        if told is not None:
            one, which = distinct_rows(told.long())
            message = which[self.candidate[self.group]]
            key = key * len(one) + message
            told = told[one]
        first, look = distinct_rows(key[:, None])
        if told is None or message is None:
            flags = torch.zeros(len(first), len(channels), dtype=torch.bool, device=key.device)
        else:
            # What is no longer there to be told cannot be told later, whatever the plan says.
            communicable = channels.join(self.person.human.domain.communicable(observation))
            flags = told[message[first]] & communicable[row[first]]
        transition = self.person.transition(
            percept[first], self.last[first], observation, channels.split(flags), row[first]
        )
        before = self.state.at(self.belief[first])
        self.state, index = before.after(transition).distinct()
        self.belief = index[look]
        if told is not None:
            self._merge(self.candidates[:, step + 1 :])
        beliefs = self.state.mean
        values = self.person.human.action_values(beliefs)
        # Courses of a draw share its policy implants: one row a draw, padded to the longest.
        counts = torch.bincount(self.draw, minlength=self.person.number)
        begin = counts.cumsum(0) - counts
        place = torch.arange(len(self.draw), device=key.device) - begin[self.draw]
        padded = torch.zeros(len(counts), int(counts.max()), dtype=torch.long, device=key.device)
        padded[self.draw, place] = self.state.belief[self.belief]
        log_chances = self.person.act(beliefs[padded], values[padded])[self.draw, place]
        return self.weight[:, None] * log_chances.exp()

    def _merge(self, rest: Tensor) -> None:
        """Join groups that have the same courses and the same ``rest`` ``[C, l, N]``."""
        own = mixed(self.path, self.belief, as_whole_numbers(self.weight), self.draw)
        courses = own.new_zeros(len(self.candidate)).index_add_(0, self.group, own)
        _, following = distinct_rows(rest.flatten(1).long())
        first, which = distinct_rows(torch.stack([courses, following[self.candidate]], -1))
        kept = torch.zeros_like(self.candidate, dtype=torch.bool).index_fill_(0, first, True)
        course = kept[self.group].nonzero().squeeze(-1)
        self.candidate, self.group_of = self.candidate[first], which[self.group_of]
        self._keep(course)
        self.weight, self.path = self.weight[course], self.path[course]
        self.last = self.last[course]
        self.group = which[self.group]

    def _keep(self, course: Tensor) -> None:
        """Only these courses go on, some of them perhaps more than once."""
        self.draw, self.group = self.draw[course], self.group[course]
        self.belief = self.belief[course]

    def branch(
        self, chances: Tensor, rollouts: RolloutTree, step: int, threshold: float, seed: int
    ) -> None:
        """Go on to the courses of one action more.

        Args:
            chances: their weights ``[E, A]``.
            rollouts: what they lead to.
            step: how many actions the courses have.
            threshold: see :class:`ExpectedUtility`.
            seed: of what is left to chance, which is the same for all candidates.
        """
        weight = chances
        if threshold > 0:
            small = chances < threshold
            # Systematic: the improbable siblings share one number, so that exactly as many are
            # kept as their weights ask for, give or take a fraction.
            total = torch.where(small, chances, 0.0).cumsum(-1) / threshold
            place = torch.full_like(self.draw, step)
            noise = uniform_of(seed, place, self.draw, rollouts.names(step)[self.path])
            shifted = total + noise[:, None]
            passed = shifted.floor()
            before = torch.cat([torch.zeros_like(passed[:, :1]), passed[:, :-1]], -1)
            weight = torch.where(small, threshold * (passed - before), chances)
        course, action = (weight > 0).nonzero(as_tuple=True)
        self.weight = weight[course, action]
        self.path = rollouts.follow(step, self.path[course], action)
        self.last = action
        self._keep(course)


@dataclass(frozen=True)
class Divergence:
    """``U(c) = - weight * KL( q(z^R_t) || q(zH_t | c) ) - cost(c_t)``: MIRROR-KL.

    Brings the person's belief close to the robot's, without a look at rewards. Only the message of
    the present step counts.

    Attributes:
        weight: units of reward that a nat of divergence is worth.
        measure: ``kl``, or ``squared``, the squared distance of the means that the authors'
            released code has in its place.
    """

    one_step: ClassVar[bool] = True

    weight: float = 1.0
    measure: str = "kl"

    def __post_init__(self) -> None:
        if self.measure not in ("kl", "squared"):
            raise ValueError(f'measure must be kl or squared, not "{self.measure}"')
        if not self.weight > 0:
            raise ValueError(f"weight must be positive, not {self.weight}")

    def at(self, context: PlanningContext, steps_left: int, seed: int) -> Value:
        """See :class:`Objective`; steps left and seed do not matter.

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
            return Valued(utility - channels.cost(message)[:, None], None)

        return value

    def _apart(self, robot: Gaussian, person: Gaussian) -> Tensor:
        squared = (robot.mean - person.mean).pow(2)
        if self.measure == "squared":
            return squared.sum(-1)
        ratio = (robot.scale / person.scale).pow(2)
        return 0.5 * (ratio + squared / person.scale.pow(2) - 1 - ratio.log()).sum(-1)


@torch.no_grad()
def beliefs_have_density(human: HumanModel) -> bool:
    """Whether beliefs of a human model have densities to compare with the robot's."""
    domain = human.domain
    device = next(human.parameters()).device
    observation = domain.observe(domain.initial(1, torch.Generator(device).manual_seed(0)))
    nothing = {
        m.name: torch.zeros(1, len(m.items), dtype=torch.bool, device=device)
        for m in domain.modalities
    }
    sites = discrete_sites(human) | attention_sites(human)
    implants = {name: support[:1] for name, support in sites.items()}
    view, _ = human.perceive(
        implants, domain.nothing_known(1, device=device), observation, nothing, 0
    )
    evidence = human.evidence(view, observation)
    none = torch.full((1,), len(domain.actions), device=device)
    state = human.believe(evidence.new_zeros(1, human.belief_size), evidence, none)
    return isinstance(state, Gaussian) and human.belief_size == human.self_model.latent


def require_density(human: HumanModel) -> None:
    """Refuse human models whose beliefs have no density to compare with the robot's.

    Raises:
        HumanModelError: this is one.
    """
    if not beliefs_have_density(human):
        raise HumanModelError(
            f"beliefs of {type(human).__name__} have no density like the robot's, which mirror-kl "
            "compares: its believe returns no Gaussian, or one of another size"
        )
