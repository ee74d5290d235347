"""Training of recurrent baselines: settings, batches, weight decay, early stopping."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from mirror_ppl.baselines.inputs import SIGHTS, Sight, StepInputs
from mirror_ppl.baselines.recurrent import RecurrentNetworks
from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.domains import get_domain, require_known
from mirror_ppl.errors import DemonstrationsError, InputError

Report = Callable[[int, str], None]
"""Called at each validation with the number of gradient steps done and a message."""
Loss = Callable[[int, StepInputs, Tensor], Tensor]
"""Loss of each person ``[P]``, given the number of the gradient step, the inputs of B rounds and
their actions ``[P, B, T]``."""


def no_report(done: int, message: str) -> None:
    """Report nothing."""


@dataclass(frozen=True)
class TrainingOptions:
    """Settings that recurrent baselines share.

    Attributes:
        sight: a name in ``SIGHTS``: which items the networks read.
        hidden: units of the GRU (supplement: 48, on the highway 128).
        layers: units of each layer after it (supplement: 32 each, on the highway 128).
        learning_rate: of Adam.
        weight_decay: decoupled weight decay on all weights but biases, as in AdamW.
        epochs: most gradient steps; a step uses all training rounds, or ``batch`` of them.
        batch: most rounds of a person in a gradient step, drawn without replacement.
        check_every: gradient steps between validations.
        patience: validations without improvement after which a person's training ends.
    """

    sight: Sight = "setting"
    hidden: int = 48
    layers: tuple[int, ...] = (32,)
    learning_rate: float = 0.01
    weight_decay: float = 0.0
    epochs: int = 400
    batch: int = 20
    check_every: int = 5
    patience: int = 10

    BASELINE: ClassVar[str] = ""
    """Name under which a world's record holds settings of its own."""
    COUNTS = ("hidden", "epochs", "batch", "check_every", "patience")
    """Settings that have to be at least 1."""

    @classmethod
    def of(cls, domain: str, **changes: Any) -> Self:
        """The settings for a domain, with changes by name."""
        return cls(**{**get_domain(domain).record.baselines.get(cls.BASELINE, {}), **changes})

    def __post_init__(self) -> None:
        require_known(self.sight, "sight", SIGHTS)
        for name in self.COUNTS:
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1, not {getattr(self, name)}")
        if min(self.layers, default=1) < 1:
            raise InputError(f"layers must have at least 1 unit each, not {self.layers}")
        if not self.learning_rate > 0:
            raise InputError(f"learning_rate must be positive, not {self.learning_rate}")
        if not 0 <= self.weight_decay * self.learning_rate < 1:
            raise InputError(
                "weight_decay must not be negative, and below 1 / learning_rate, "
                f"not {self.weight_decay}"
            )


def check_parts(train: Demonstrations, validation: Demonstrations) -> None:
    """Check that each person has training and validation rounds.

    Raises:
        DemonstrationsError: a person lacks either; or the validation rounds are of another domain
            or other people.
    """
    if validation.domain != train.domain or validation.people != train.people:
        raise DemonstrationsError(
            f"validation rounds are of {validation.domain}, {', '.join(validation.people)}; "
            f"expected those of training: {train.domain}, {', '.join(train.people)}"
        )
    for purpose, part in (("training", train), ("validation", validation)):
        for person, count in zip(part.people, part.round_counts.tolist(), strict=True):
            if count == 0:
                raise DemonstrationsError(f"person {person!r} has no {purpose} round")


def train_each(
    networks: RecurrentNetworks,
    parts: tuple[Demonstrations, Demonstrations],
    loss: Loss,
    options: TrainingOptions,
    generators: Sequence[torch.Generator],
    report: Report = no_report,
    decay: Tensor | None = None,
) -> None:
    """Train all people's networks with early stopping, and keep each person's best weights.

    Args:
        networks: of P people; changed in place.
        parts: training and validation rounds.
        loss: minimized for each person.
        options: settings.
        generators: one for each person.
        report: called at each validation with the number of gradient steps done (in the end
            ``options.epochs``, even after early stopping) and a message.
        decay: weight decay of each person ``[P]``; that of the options unless given.
    """
    train, validation = parts
    inputs, actions, counts = networks.inputs(train), train.actions, train.round_counts.tolist()
    rates = options.learning_rate * (options.weight_decay if decay is None else decay)
    optimizer = torch.optim.Adam(networks.parameters(), options.learning_rate)
    stopping = BestWeights(networks, validation, options.patience)
    for step in range(options.epochs + 1):
        last = step == options.epochs
        if last or step % options.check_every == 0:
            last = stopping.look() or last
            report(options.epochs if last else step, stopping.message)
        if last:
            break
        batch = draw_batch(inputs, actions, counts, options.batch, generators)
        optimizer.zero_grad()
        # A sum: people share no weight, so each network follows its own person's loss alone.
        loss(step, *batch).sum().backward()
        shrink(networks, rates)
        optimizer.step()
    stopping.restore()


def held_out_nll(networks: RecurrentNetworks, demonstrations: Demonstrations) -> Tensor:
    """Mean negative log-likelihood of a person's actions, in nats per action, ``[P]``.

    It is NaN for people who have no rounds.

    Args:
        networks: of these people and perhaps others.
        demonstrations: rounds that the networks have not learned from.

    Raises:
        DemonstrationsError: they are of another domain.
        UnknownNameError: a person has no network here.
    """
    return mean_nll(networks.log_probabilities(demonstrations), demonstrations.actions)


def mean_nll(log_probabilities: Tensor, actions: Tensor) -> Tensor:
    """Mean over real actions ``[P, B, T]`` of their negative log-likelihood, ``[P]``."""
    real = actions >= 0
    own = log_probabilities.gather(-1, actions.clamp(min=0)[..., None]).squeeze(-1)
    return -torch.where(real, own, 0.0).sum((1, 2)) / real.sum((1, 2))


class BestWeights:
    """Keeps each person's weights at the lowest validation NLL.

    Args:
        networks: the trained networks.
        validation: rounds that are not learned from.
        patience: validations without improvement after which a person's training ends.
    """

    def __init__(
        self, networks: RecurrentNetworks, validation: Demonstrations, patience: int
    ) -> None:
        self.networks = networks
        self.inputs, self.actions = networks.inputs(validation), validation.actions
        self.patience = patience
        self._kept = {name: value.detach().clone() for name, value in networks.weights.items()}
        self._best = self.inputs.rows.new_full((len(networks.people),), torch.inf)
        self._looks_since = torch.zeros_like(self._best)

    @torch.no_grad()
    def look(self) -> bool:
        """Keep the weights of people who improved; True if training has ended for all."""
        nll = mean_nll(self.networks(self.inputs).log_softmax(-1), self.actions)
        better = (nll < self._best) & (self._looks_since < self.patience)
        self._best = torch.where(better, nll, self._best)
        for name, value in self.networks.weights.items():
            self._kept[name][better] = value[better]
        self._looks_since = torch.where(better, 0, self._looks_since + 1)
        return bool((self._looks_since >= self.patience).all())

    @property
    def message(self) -> str:
        """Mean validation NLL of the best weights, as text."""
        return f"validation {self._best.mean().item():.3f} nats an action"

    def restore(self) -> None:
        """Set each person's weights to their best ones."""
        self.networks.weights.load_state_dict(self._kept)


@torch.no_grad()
def shrink(networks: RecurrentNetworks, rates: Tensor | float) -> None:
    """Apply one step of decoupled weight decay, by rates ``[P]``, to all weights but biases."""
    factor = 1 - rates
    if isinstance(factor, Tensor):
        factor = factor[:, None, None]
    for name, value in networks.weights.items():
        if not name.endswith("bias"):
            value.mul_(factor)


def draw_batch(
    inputs: StepInputs,
    actions: Tensor,
    counts: Sequence[int],
    size: int,
    generators: Sequence[torch.Generator],
) -> tuple[StepInputs, Tensor]:
    """Draw inputs and actions of ``size`` rounds of each person, or of all if there are fewer."""
    if actions.shape[1] <= size:
        return inputs, actions
    index = torch.zeros(len(counts), size, dtype=torch.long)
    padding = torch.ones(len(counts), size, dtype=torch.bool)
    for person, (count, generator) in enumerate(zip(counts, generators, strict=True)):
        # Nothing is drawn for few rounds, so that it makes no difference how many others have.
        few = count <= size
        own = torch.arange(count) if few else torch.randperm(count, generator=generator)[:size]
        index[person, : len(own)] = own
        padding[person, : len(own)] = False
    index, padding = index.to(actions.device), padding.to(actions.device)
    person = torch.arange(len(counts), device=actions.device)[:, None]
    own = StepInputs(inputs.rows, inputs.place[person, index])
    return own, actions[person, index].masked_fill(padding[..., None], -1)
