"""Training of the self-model: SVI for the world, Q-learning for the policy (supplement, section D).

Training alternates between driving and learning. In a driving phase each round is driven by the
expert with probability beta, else by the model's own epsilon-greedy policy. Every gradient step
samples rounds from all experience so far, each under a newly drawn view, and minimizes

    - ELBO / (B (T + 1)) * world_weight  +  mean squared Bellman error of both actions.

With ``distil``, the planner's values in the true state take the place of outcomes, in every view;
the error that is reported is then that of the regression.

The Bellman error uses the outcomes of *every* action, from the robot's simulator, not only of the
action taken. Where the observer knows everything, the targets can also be the values of the exact
planner (the expert) instead of bootstrapped values.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from mirror_ppl.checkpoints import read_checkpoint, save_checkpoint
from mirror_ppl.domains.base import Domain, map_state
from mirror_ppl.domains.record import settings_of
from mirror_ppl.domains.registry import code_of, get_domain
from mirror_ppl.domains.world import World, offers
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.sizes import Sizes, sizes_of
from mirror_ppl.models.speech import EMBEDDINGS
from mirror_ppl.training.experience import Course, Experience, drive, experience
from mirror_ppl.training.views import (
    ASSUMPTION_PROBABILITY,
    KIND_PROBABILITIES,
    KINDS,
    draw_views,
)

VALUED = 1024
"""States of which values are computed at once; bounds memory."""


@dataclass(frozen=True)
class SelfModelOptions:
    """Settings of self-model training.

    Attributes:
        phases: number of phases of driving and learning.
        rounds: rounds driven in a phase.
        steps: gradient steps of a phase.
        batch: rounds in a gradient step.
        learning_rate: initial rate of Adam, annealed to a hundredth on a cosine. The supplement
            has 3e-4; ``docs/decisions.md`` compares both.
        beta: probability that the expert drives a round, in the first phase (supplement: 0.5).
        beta_decay: factor on beta after each phase (supplement: 0.8).
        epsilon: probability of a random action, in the first phase (supplement: 0.5).
        epsilon_decay: factor on epsilon after each phase (supplement: 0.75).
        epsilon_floor: least epsilon; people err more often than a trained policy, and the
            robot has to know the states that errors lead to.
        discount: discount of rewards per step.
        target_rate: rate at which the target network follows the Q-network, per step.
        world_weight: weight of the negative ELBO per observation.
        speech_weight: weight of messages in the ELBO; pictures have many more numbers.
        length: steps of a training round; the domain's horizon if 0.
        window: steps of these rounds in a gradient step, from a random one on; all of them if 0.
            What happened is then kept, which takes memory, and not computed again.
        stride: values are learned at one of every ``stride`` steps; the offset is random, and with
            ``distil`` the same for all rounds of a phase.
        difference_weight: weight of errors in the differences between actions, added to the errors
            themselves. Choices of people depend on these differences alone.
        choice_weight: weight of the cross entropy, in nats, of choices in proportion to the
            exponential of learned values, if they were made so by the planner's. Of observers who
            know all decisive items, and only with ``distil``: others would take what is likely for
            certain. Errors of values where one action is far better than another hardly count.
        kinds: shares of full, dropout and sight views; see `mirror_ppl.training.views`.
        assumed: share of sight views in which each assumption is made. At 0 the robot does not
            learn what follows from assumptions; imagined items are then like seen ones to it. With
            ``distil``, the share of all rounds that are kept as one observer who makes assumptions
            believed them to be, with the planner's values there.
        at_means: True to learn values at the encoder's means in every step, False to alternate with
            draws of the guide. Means are exact sooner where decisive items are clearly visible.
        exact: True to learn the exact planner's values, where there is one, for observers who know
            all decisive items, instead of bootstrapped values.
        distil: True to learn the planner's values of the true state in every view: their mean,
            given what is seen. They are computed once for each driven state; only for planners
            whose values hold without further observations, and with ``window``. In worlds where
            left and right are alike, the same rounds are learned from with both exchanged, too.
    """

    phases: int = 40
    rounds: int = 2048
    steps: int = 300
    batch: int = 64
    learning_rate: float = 1e-3
    beta: float = 0.5
    beta_decay: float = 0.8
    epsilon: float = 0.5
    epsilon_decay: float = 0.75
    epsilon_floor: float = 0.15
    discount: float = 0.9
    target_rate: float = 0.01
    world_weight: float = 0.01
    speech_weight: float = 1.0
    length: int = 0
    window: int = 0
    stride: int = 1
    difference_weight: float = 0.0
    choice_weight: float = 0.0
    kinds: tuple[float, float, float] = KIND_PROBABILITIES
    assumed: float = ASSUMPTION_PROBABILITY
    at_means: bool = False
    exact: bool = False
    distil: bool = False

    @classmethod
    def of(cls, domain: str, **changes: Any) -> Self:
        """Settings of a domain, with changes.

        Args:
            domain: name of the domain.
            changes: settings by name; None keeps the domain's own.
        """
        given = {name: value for name, value in changes.items() if value is not None}
        return cls(**{**settings_of(get_domain(domain).record, "training", cls), **given})

    def __post_init__(self) -> None:
        for name in ("phases", "rounds", "steps", "batch", "stride"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if not 0 < self.learning_rate <= 1:
            raise ValueError(
                f"learning_rate must be above 0 and at most 1, not {self.learning_rate}"
            )
        if self.window < 0 or self.length < 0:
            raise ValueError("window and length must not be negative")
        if self.distil and self.exact:
            raise ValueError("distil and exact are two ways to learn a planner's values")
        if self.choice_weight and not self.distil:
            raise ValueError("choice_weight needs distil: choices are those at a planner's values")
        if self.distil and not self.window:
            raise ValueError("distil needs a window: values are kept with the states of rounds")
        if len(self.kinds) != len(KINDS) or min(self.kinds) < 0 or not sum(self.kinds) > 0:
            raise ValueError(
                f"kinds must be {len(KINDS)} numbers, not negative and not all 0, not {self.kinds}"
            )
        for name in (
            "beta",
            "beta_decay",
            "epsilon",
            "epsilon_decay",
            "epsilon_floor",
            "discount",
            "assumed",
        ):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must lie in [0, 1], not {getattr(self, name)}")


@dataclass(frozen=True)
class Loss:
    """Parts of the loss of one gradient step."""

    total: Tensor
    negative_elbo: Tensor
    bellman: Tensor


def self_model_loss(
    self_model: SelfModel,
    target: torch.nn.Module,
    lived: Experience,
    options: SelfModelOptions,
    on_means: bool,
) -> Loss:
    """Loss of a batch of rounds.

    Args:
        self_model: the model to train.
        target: target network, the slow copy of its Q-network.
        lived: rounds and outcomes.
        options: settings.
        on_means: True to learn values at the encoder's means, which all other code uses as beliefs;
            False for draws of the guide, which keep it precise about what values depend on.
            Training alternates.
    """
    rounds = lived.rounds
    bound, z = self_model.elbo(rounds)
    batch, steps = rounds.actions.shape
    negative_elbo = -bound / (batch * (steps + 1))
    belief = z[:, :-1]
    if on_means:
        evidence = self_model.evidence(rounds.observation, rounds.visible, rounds.actions)
        belief = self_model.believe(evidence[:, :-1])
    belief = belief[:, lived.steps]
    goal = (
        lived.exact if options.distil else _bootstrapped(self_model, target, lived, options, belief)
    )
    assert goal is not None
    # Once a round is over (possibly in every round) actions do not matter.
    values = self_model.action_values(belief)
    error = (values - goal)[~lived.over]
    unlike = error - error.mean(-1, keepdim=True)
    bellman, apart = (part.pow(2).mean() if len(part) else part.sum() for part in (error, unlike))
    total = options.world_weight * negative_elbo + bellman + options.difference_weight * apart
    if options.choice_weight:
        sure = lived.informed & ~lived.over
        total = total + options.choice_weight * _cross_entropy(goal[sure], values[sure])
    return Loss(total, negative_elbo.detach(), bellman.detach())


def _cross_entropy(goal: Tensor, values: Tensor) -> Tensor:
    """Return the mean cross entropy of softmax choices at values ``[n, A]``; 0 if n is 0."""
    each = -(torch.softmax(goal, -1) * torch.log_softmax(values, -1)).sum(-1)
    return each.mean() if len(each) else each.sum()


def _bootstrapped(
    self_model: SelfModel,
    target: torch.nn.Module,
    lived: Experience,
    options: SelfModelOptions,
    belief: Tensor,
) -> Tensor:
    """Return the goals ``[B, T', A]`` of action values at beliefs ``[B, T', Z]``."""
    steps = lived.rounds.actions.shape[1]
    goals = []
    with torch.no_grad():
        for action, outcome in enumerate(lived.outcomes):
            embedded = self_model.encoder.embed(self_model.domain.symbols(outcome.observation))
            evidence = self_model.encoder.combine(embedded, outcome.visible)
            evidence = evidence + self_model.encoder.action.weight[action]
            value = target(self_model.encoder(belief, evidence).mean).amax(-1)
            over = outcome.over
            if self_model.domain.over_at_horizon and steps == self_model.domain.horizon:
                over = over | (torch.arange(steps, device=over.device) == steps - 1)[lived.steps]
            goals.append(outcome.reward + options.discount * value.masked_fill(over, 0.0))
    goal = torch.stack(goals, -1)
    if lived.exact is not None:
        goal = torch.where(lived.informed[..., None], lived.exact, goal)
    return goal


def train_self_model(
    domain: Domain,
    options: SelfModelOptions,
    generator: torch.Generator,
    report: Callable[[int, str], None] = lambda done, message: None,
    checkpoint: Path | None = None,
    speech: str = "words",
    sizes: Sizes | None = None,
    kind: type[SelfModel] = SelfModel,
) -> SelfModel:
    """Train a self-model from nothing.

    Args:
        domain: the world to learn.
        options: settings.
        generator: source of randomness; torch's global generator is forked and seeded from it
            because Pyro draws from the global one.
        report: called after each phase with the number of phases done and a message.
        checkpoint: file that is written after each phase and resumed from if it exists.
        speech: a name in `mirror_ppl.models.speech.EMBEDDINGS`.
        sizes: sizes of the networks; by default the domain's own.
        kind: class of the self-model.

    Raises:
        AssetError: a file or package of that embedding is missing.
        CheckpointError: if the checkpoint belongs to another run (domain, options or seed) or
            cannot be read.
    """
    device = generator.device
    seed = int(torch.randint(2**31, (1,), generator=generator, device=device))
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        sizes = sizes or sizes_of(domain)
        trainer = _Trainer(domain, options, generator, seed, speech, sizes, kind)
        trainer.run(report, checkpoint)
    return trainer.self_model.eval()


def _require_fitting(domain: Domain, options: SelfModelOptions) -> None:
    """Refuse options that do not fit a world.

    Raises:
        ValueError: a window is longer than rounds, or ends where nothing is known to follow; or
            assumptions are to be learned that the world does not work out.
    """
    rounds = options.length or domain.horizon
    if options.window > rounds:
        raise ValueError(f"window is {options.window}, longer than rounds of {rounds} steps")
    if options.window and domain.over_at_horizon and not options.distil:
        raise ValueError(f"with a window, values of {domain.name} can only be distilled")
    works_out = not isinstance(domain, World) or offers(domain, "supposed")
    if options.assumed and domain.assumptions and not works_out:
        raise ValueError(f"assumed must be 0, as {domain.name} has no supposed()")


class _Trainer:
    """State of a training run, as checkpoints hold it."""

    def __init__(
        self,
        domain: Domain,
        options: SelfModelOptions,
        generator: torch.Generator,
        seed: int,
        speech: str,
        sizes: Sizes,
        kind: type[SelfModel],
    ) -> None:
        _require_fitting(domain, options)
        self.domain = domain
        self.options = options
        self.run_id = {
            "domain": domain.name,
            "domain_version": domain.version,
            "domain_code": code_of(domain),
            "options": asdict(options),
            "seed": seed,
            "speech": speech,
            "sizes": asdict(sizes),
            "kind": kind.__name__,
        }
        self.generator = generator
        embedding = EMBEDDINGS[speech]
        self.self_model = kind(domain, sizes, embedding).to(generator.device)
        self.self_model.emphasis = {"verbal": options.speech_weight}
        self.target = copy.deepcopy(self.self_model.q_network)
        self.optimizer = torch.optim.Adam(
            self.self_model.parameters(), options.learning_rate, fused=True
        )
        self.schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
            self.optimizer, options.phases * options.steps, options.learning_rate / 100
        )
        self.starts: list[Any] = []
        self.actions: list[Tensor] = []
        self.courses: list[Course] = []
        self.seed = seed
        self.phase = 0

    def run(self, report: Callable[[int, str], None], checkpoint: Path | None) -> None:
        if checkpoint is not None and checkpoint.exists():
            self._restore(checkpoint)
        while self.phase < self.options.phases:
            self._drive()
            message = self._learn()
            self.phase += 1
            if checkpoint is not None:
                self._save(checkpoint)
            report(self.phase, message)

    def _save(self, path: Path) -> None:
        # Integers of a world are small.
        starts = [
            map_state(lambda part: part.int() if part.dtype == torch.long else part, start)
            for start in self.starts
        ]
        content = {
            "phase": self.phase,
            "self_model": self.self_model.state_dict(),
            "target": self.target.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "schedule": self.schedule.state_dict(),
            "starts": [vars(start) for start in starts],
            "actions": [actions.int() for actions in self.actions],
            "generator": self.generator.get_state(),
            "torch": torch.random.get_rng_state(),
        }
        save_checkpoint(path, self.run_id, content)

    def _restore(self, path: Path) -> None:
        content = read_checkpoint(path, self.run_id)
        self.self_model.load_state_dict(content["self_model"])
        self.target.load_state_dict(content["target"])
        self.optimizer.load_state_dict(content["optimizer"])
        self.schedule.load_state_dict(content["schedule"])
        kind = type(self.domain.initial(1, torch.Generator(self.generator.device)))
        self.starts = [
            kind(
                **{
                    name: part.long() if part.dtype == torch.int32 else part
                    for name, part in start.items()
                }
            )
            for start in content["starts"]
        ]
        self.actions = [actions.long() for actions in content["actions"]]
        self.phase = content["phase"]
        self.generator.set_state(content["generator"])
        torch.random.set_rng_state(content["torch"])

    def _drive(self) -> None:
        options, domain = self.options, self.domain
        start = domain.anywhere(options.rounds, self.generator)
        length = options.length or domain.horizon
        plan = draw_views(
            domain, options.rounds, length, self.generator, options.kinds, options.assumed
        )
        epsilon = options.epsilon * options.epsilon_decay**self.phase
        expert = options.beta * options.beta_decay**self.phase
        if not offers(domain, "reference_values"):
            expert = 0.0  # no exact planner: the policy is learned from outcomes alone
        self.starts.append(start)
        self.actions.append(
            drive(
                self.self_model,
                start,
                plan,
                length,
                self.generator,
                epsilon=max(epsilon, options.epsilon_floor),
                expert=expert,
                discount=options.discount,
            )
        )

    def _learn(self) -> str:
        options = self.options
        exact = options.exact and offers(self.domain, "reference_values")
        course = self._course() if options.window else None
        actions = torch.cat(self.actions) if course is None else course.actions
        starts = None
        if course is None:
            starts = map_state(lambda *parts: torch.cat(parts), *self.starts)
        elbo = bellman = 0.0
        for step in range(options.steps):
            chosen = torch.randint(
                len(actions),
                (options.batch,),
                generator=self.generator,
                device=self.generator.device,
            )
            if course is None:
                some = map_state(lambda part: part[chosen], starts)  # noqa: B023 - used at once
                rounds = Course.of(self.domain, some, actions[chosen])
            else:
                begin = self._drawn(actions.shape[1] - options.window + 1)
                rounds = course.window(chosen, begin, options.window)
            plan = draw_views(
                self.domain,
                options.batch,
                rounds.actions.shape[1],
                self.generator,
                options.kinds,
                0.0 if options.distil else options.assumed,
            )
            lived = experience(
                self.domain,
                rounds,
                plan,
                0 if options.distil else self._drawn(options.stride),
                1 if options.distil else options.stride,
                options.discount if exact else None,
            )
            means = options.at_means or step % 2 == 1
            loss = self_model_loss(self.self_model, self.target, lived, options, means)
            self.optimizer.zero_grad()
            loss.total.backward()
            torch.nn.utils.clip_grad_norm_(self.self_model.parameters(), 5.0)
            self.optimizer.step()
            self.schedule.step()
            self._follow()
            elbo -= float(loss.negative_elbo) / options.steps
            bellman += float(loss.bellman) / options.steps
        return f"elbo {elbo:.2f} per observation, bellman error {bellman:.3f}"

    def _course(self) -> Course:
        """Return what happened in all rounds."""
        rounds = list(zip(self.starts, self.actions, strict=True))
        for start, actions in rounds[len(self.courses) :]:
            course = Course.of(self.domain, start, actions)
            self.courses.append(self._valued(course) if self.options.distil else course)
        return Course.join(self.courses)

    def _valued(self, course: Course) -> Course:
        """Return a phase's rounds, some of them as believed, with the planner's values."""
        domain, phase = self.domain, len(self.courses)
        if self.options.assumed and domain.assumptions:
            # A generator of its own, as a resumed run has to repeat the phases before.
            own = torch.Generator(self.generator.device).manual_seed(self.seed + phase)
            number, steps = course.actions.shape
            share, only_sight = self.options.assumed, (0.0, 0.0, 1.0)
            plan = draw_views(domain, number, steps, own, only_sight, share)
            course = course.supposed_by(domain, plan)
        course = replace(course, values=self._values(course.states, phase % self.options.stride))
        if isinstance(domain, World) and offers(domain, "reflected"):
            course = Course.join([course, course.reflected(domain)])
        return course

    def _values(self, states: Any, first: int) -> Tensor:
        """Return the planner's values ``[B, T, A]`` of states ``[B, T + 1]``; nan between strides.

        Args:
            states: of a course.
            first: step from which on every ``stride``-th is valued.
        """
        steps = slice(first, -1, self.options.stride)
        some = map_state(lambda part: part[:, steps], states)
        batch, number = self.domain.over(some).shape
        flat = map_state(lambda part: part.flatten(0, 1), some)
        rows = torch.arange(batch * number, device=self.generator.device).split(VALUED)
        parts = [
            self.domain.reference_values(
                map_state(lambda part: part[own], flat),  # noqa: B023 - used at once
                self.options.discount,
            )
            for own in rows
        ]
        found = torch.cat(parts).view(batch, number, -1)
        length = self.domain.over(states).shape[1] - 1
        values = found.new_full((batch, length, found.shape[-1]), torch.nan)
        values[:, first :: self.options.stride] = found
        return values

    def _drawn(self, number: int) -> int:
        """Return a random whole number from 0 to below another."""
        if number == 1:
            return 0
        device = self.generator.device
        return int(torch.randint(number, (), generator=self.generator, device=device))

    @torch.no_grad()
    def _follow(self) -> None:
        pairs = zip(self.target.parameters(), self.self_model.q_network.parameters(), strict=True)
        for slow, fast in pairs:
            slow.lerp_(fast, self.options.target_rate)
