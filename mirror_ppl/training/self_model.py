"""Training of the self-model: SVI for the world, Q-learning for the policy (supplement, section D).

Training alternates between phases of driving and of learning. Before a phase each round is given to
the expert with probability beta, else to the model's own epsilon-greedy policy. Every gradient step
draws rounds from all experience so far, sees each through a view of its own, and follows

    - ELBO / (B (T + 1)) * world_weight  +  mean squared Bellman error of both actions.

The Bellman error uses the outcomes of *every* action: the robot's simulator is at hand, so no
action's value has to wait until somebody takes it. Where the robot knows everything, it can also
learn from the exact planner, which is its expert, instead of from what it expects itself.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from mirror_ppl.checkpoints import read_checkpoint, save_checkpoint
from mirror_ppl.domains.base import Domain, map_state
from mirror_ppl.domains.record import settings_of
from mirror_ppl.domains.registry import code_of, get_domain
from mirror_ppl.domains.world import offers
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.sizes import Sizes, sizes_of
from mirror_ppl.models.speech import EMBEDDINGS
from mirror_ppl.training.experience import Experience, drive, experience
from mirror_ppl.training.views import KIND_PROBABILITIES, KINDS, draw_views


@dataclass(frozen=True)
class SelfModelOptions:
    """Settings of self-model training.

    Attributes:
        phases: number of phases of driving and learning.
        rounds: rounds driven in a phase.
        steps: gradient steps of a phase.
        batch: rounds in a gradient step.
        learning_rate: of Adam at the start; it falls to a hundredth on a cosine. The supplement
            has 3e-4; ``docs/decisions.md`` has the measurement of both.
        beta: probability that the expert drives a round, in the first phase (supplement: 0.5).
        beta_decay: factor on beta after each phase (supplement: 0.8).
        epsilon: probability of a random action, in the first phase (supplement: 0.5).
        epsilon_decay: factor on epsilon after each phase (supplement: 0.75).
        epsilon_floor: least epsilon; people err more often than a finished policy, and the
            robot has to know the states that errors lead to.
        discount: discount of rewards per step.
        target_rate: rate at which the target network follows the Q-network, per step.
        world_weight: weight of the negative ELBO per observation.
        speech_weight: how often what is said counts in that; pictures have many more numbers.
        length: steps of a round that is learned from; as many as a round has, if 0.
        stride: of every so many steps of a round one is learned from for values; which, is drawn.
        difference_weight: how often errors count by which actions differ, besides the errors
            themselves. What people choose hangs on differences alone.
        kinds: share of rounds that are seen in full, with items dropped, and by limited sight; see
            `mirror_ppl.training.views`.
        at_means: whether values are learned at the encoder's means in every step, and not at draws
            of the guide in every other one: sooner exact, where what counts is clear to see.
        exact: whether somebody who knows all that counts learns the values of the exact planner,
            where there is one, and not what a step leads to.
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
    stride: int = 1
    difference_weight: float = 0.0
    kinds: tuple[float, float, float] = KIND_PROBABILITIES
    at_means: bool = False
    exact: bool = False

    @classmethod
    def of(cls, domain: str, **changes: Any) -> Self:
        """The settings for a domain, with changes.

        Args:
            domain: its name.
            changes: settings by name; None leaves what is set for the domain.
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
        if len(self.kinds) != len(KINDS) or min(self.kinds) < 0 or not sum(self.kinds) > 0:
            raise ValueError(
                f"kinds must be {len(KINDS)} numbers, not negative and not all 0, not {self.kinds}"
            )
        for name in ("beta", "beta_decay", "epsilon", "epsilon_decay", "epsilon_floor", "discount"):
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
        self_model: what is trained.
        target: the slow copy of its Q-network.
        lived: rounds and outcomes.
        options: settings.
        on_means: learn values at the encoder's means, which is what everything that uses them
            believes in, and not at draws of the guide, which keep the guide from being vague about
            what values depend on. Training takes turns.
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
    # When all is done, which may be so in every round, it does not matter what one does.
    error = (self_model.action_values(belief) - goal)[~lived.over]
    unlike = error - error.mean(-1, keepdim=True)
    bellman, apart = (part.pow(2).mean() if len(part) else part.sum() for part in (error, unlike))
    total = options.world_weight * negative_elbo + bellman + options.difference_weight * apart
    return Loss(total, negative_elbo.detach(), bellman.detach())


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
        checkpoint: file that is written after each phase and continued from if it exists.
        speech: a name in `mirror_ppl.models.speech.EMBEDDINGS`.
        sizes: of the networks; the domain's own unless given.
        kind: class of the self-model.

    Raises:
        AssetError: that embedding needs what is not there.
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


class _Trainer:
    """State of a training run; everything that a checkpoint has to hold."""

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
        # Whole numbers of a world are small.
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
        plan = draw_views(domain, options.rounds, length, self.generator, options.kinds)
        epsilon = options.epsilon * options.epsilon_decay**self.phase
        expert = options.beta * options.beta_decay**self.phase
        if not offers(domain, "reference_values"):
            expert = 0.0  # there is no exact planner: the policy is learned from outcomes alone
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
        starts = map_state(lambda *parts: torch.cat(parts), *self.starts)
        actions = torch.cat(self.actions)
        elbo = bellman = 0.0
        for step in range(options.steps):
            chosen = torch.randint(
                len(actions),
                (options.batch,),
                generator=self.generator,
                device=self.generator.device,
            )
            steps = actions.shape[1]
            plan = draw_views(self.domain, options.batch, steps, self.generator, options.kinds)
            start = map_state(lambda part: part[chosen], starts)  # noqa: B023 - used at once
            lived = experience(
                self.domain,
                start,
                actions[chosen],
                plan,
                self._first(),
                options.stride,
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

    def _first(self) -> int:
        """At which step the first of every ``stride`` steps is from which values are learned."""
        if self.options.stride == 1:
            return 0
        device = self.generator.device
        return int(torch.randint(self.options.stride, (), generator=self.generator, device=device))

    @torch.no_grad()
    def _follow(self) -> None:
        pairs = zip(self.target.parameters(), self.self_model.q_network.parameters(), strict=True)
        for slow, fast in pairs:
            slow.lerp_(fast, self.options.target_rate)
