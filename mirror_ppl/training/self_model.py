"""Training of the self-model: SVI for the world, Q-learning for the policy (supplement, section D).

Training alternates between driving and learning. In a driving phase each round is driven by the
expert with probability beta, else by the model's own epsilon-greedy policy. Every gradient step
samples rounds from all experience so far, each under a newly drawn view, and minimizes

    - ELBO / (B (T + 1)) * world_weight  +  mean squared Bellman error of both actions.

Where the Q-network has bins of values, their cross entropy takes the place of squared errors, which
are then only reported.

With ``distil``, the planner's values take the place of outcomes, in every view: values of the true
state, or in some rounds of the state that an observer who makes assumptions believes in. The error
that is reported is then that of the regression.

The Bellman error uses the outcomes of *every* action, from the robot's simulator, not only of the
action taken. Where the observer knows everything, the targets can also be the values of the exact
planner (the expert) instead of bootstrapped values.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.checkpoints import read_checkpoint, save_checkpoint
from mirror_ppl.domains.base import Domain, map_state
from mirror_ppl.domains.registry import code_of
from mirror_ppl.domains.world import World, offers
from mirror_ppl.errors import InputError
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.sizes import Sizes, sizes_of
from mirror_ppl.models.speech import EMBEDDINGS
from mirror_ppl.randomness import forked, seed_everything
from mirror_ppl.training.experience import Course, drive, experience
from mirror_ppl.training.self_model_loss import self_model_loss
from mirror_ppl.training.self_model_options import SelfModelOptions, require_fitting
from mirror_ppl.training.views import draw_views
from mirror_ppl.user_code import source_of
from mirror_ppl.version import __version__

VALUED = 1024
"""States of which values are computed at once; bounds memory."""


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
        InputError: the options do not fit the world or the sizes, or ``kind`` cannot have bins.
        CheckpointError: if the checkpoint belongs to another run (domain, options or seed) or
            cannot be read.
    """
    device = generator.device
    seed = int(torch.randint(2**31, (1,), generator=generator, device=device))
    with forked():
        seed_everything(seed)
        sizes = sizes or sizes_of(domain)
        trainer = _Trainer(domain, options, generator, seed, speech, sizes, kind)
        trainer.run(report, checkpoint)
    return trainer.self_model.eval()


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
        require_fitting(domain, options)
        if sizes.value_bins and kind.action_values is not SelfModel.action_values:
            raise InputError(
                f"value_bins must be 0, as {kind.__name__} has an action_values of its own, which "
                "cannot be learned by bins"
            )
        if options.ranked_weight and not sizes.value_bins:
            raise InputError(
                f"ranked_weight must be 0, as {domain.name}'s Q-network has no value_bins"
            )
        self.domain = domain
        self.options = options
        of_kind = [one for one in kind.__mro__ if issubclass(one, SelfModel)]
        given = {name: value for name, value in vars(domain).items() if name[0] != "_"}
        self.run_id = {
            "domain": domain.name,
            "domain_version": domain.version,
            "domain_code": code_of(domain),
            "options": asdict(options),
            "seed": seed,
            "speech": speech,
            "sizes": asdict(sizes),
            "kind": [(one.__qualname__, source_of(one)) for one in of_kind],
            "given": {name: value for name, value in given.items() if _is_plain(value)},
            "version": __version__,
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
        starts = [map_state(_smaller, start) for start in self.starts]
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
        if self.generator.device.type == "cuda":
            content["cuda"] = torch.cuda.get_rng_state(self.generator.device)
        save_checkpoint(path, self.run_id, content)

    def _restore(self, path: Path) -> None:
        content = read_checkpoint(path, self.run_id)
        self.self_model.load_state_dict(content["self_model"])
        self.target.load_state_dict(content["target"])
        self.optimizer.load_state_dict(content["optimizer"])
        self.schedule.load_state_dict(content["schedule"])
        like = self.domain.initial(1, torch.Generator(self.generator.device))
        self.starts = [
            map_state(lambda part, own: part.to(own.dtype), type(like)(**start), like)
            for start in content["starts"]
        ]
        self.actions = [actions.long() for actions in content["actions"]]
        self.phase = content["phase"]
        self.generator.set_state(content["generator"])
        torch.random.set_rng_state(content["torch"])
        if "cuda" in content:
            torch.cuda.set_rng_state(content["cuda"], self.generator.device)

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


def _is_plain(value: object) -> bool:
    """True of numbers, texts, and tuples, lists and dicts of them."""
    if isinstance(value, dict):
        return all(_is_plain(part) for pair in value.items() for part in pair)
    if isinstance(value, tuple | list):
        return all(map(_is_plain, value))
    return value is None or type(value) in (str, int, float, bool)


def _smaller(part: Tensor) -> Tensor:
    """Whole numbers in 32 bits, if they fit."""
    limits = torch.iinfo(torch.int32)
    whole = part.dtype == torch.long and part.numel()
    fits = whole and limits.min <= int(part.min()) and int(part.max()) <= limits.max
    return part.int() if fits else part
