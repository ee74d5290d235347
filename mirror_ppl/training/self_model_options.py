"""Settings of self-model training."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Self

from mirror_ppl.domains.base import Domain
from mirror_ppl.domains.record import settings_of
from mirror_ppl.domains.registry import get_domain
from mirror_ppl.domains.world import World, offers
from mirror_ppl.errors import InputError
from mirror_ppl.training.views import ASSUMPTION_PROBABILITY, KIND_PROBABILITIES, KINDS

OF_CHOICES = ("choice_weight", "regret_weight")
"""Weights of losses of choices."""
WEIGHTS = ("world_weight", "speech_weight", "difference_weight", "bin_weight", "ranked_weight")
"""Weights of other losses."""


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
        bin_weight: weight of the cross entropy, in nats, of bins of values. In worlds whose
            Q-network has bins (``Sizes.value_bins``) it takes the place of squared errors, also of
            those in differences.
        ranked_weight: weight of `BinnedQNetwork.ranked_cross_entropy`, in nats times units of
            value, added to that of bins. It makes errors count by how far away wrong values are.
        choice_weight: weight of the cross entropy, in nats, of choices in proportion to the
            exponential of learned values, if they were made so by the planner's. Of observers who
            know all decisive items, and only with ``distil``: others would take what is likely for
            certain. Errors of values where one action is far better than another hardly count.
        regret_weight: weight of the expected regret of such choices: how much less than the best
            they are worth by the planner's values, beyond ``regret_margin``. Of the same observers,
            and only with ``distil``. It makes mistakes count by what they cost, however rare they
            are.
        regret_margin: regret that does not count. Without a margin the network would exaggerate
            all differences of values, as regret is least if the best choice is certain.
        kinds: shares of full, dropout and sight views; see `mirror_ppl.training.views`.
        assumed: share of sight views in which each assumption is made. At 0 the robot does not
            learn what follows from assumptions; imagined items are then like seen ones to it. With
            ``distil``, also the probability of each assumption in every stored round: rounds with
            an assumption have the believed states, and the planner's values there.
        at_means: True to learn values at the encoder's means in every step, False to alternate with
            draws of the guide. Means are exact sooner where decisive items are clearly visible.
        exact: True to learn the exact planner's values, where there is one, for observers who know
            all decisive items, instead of bootstrapped values.
        distil: True to learn the planner's values of the true state (with ``assumed``, in some
            rounds the believed one) in every view: their mean, given what is seen. They are
            computed once for each driven state; only for planners whose values hold without
            further observations, and with ``window``. In worlds with `World.reflected`, mirror
            images of the same rounds are learned from, too.
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
    bin_weight: float = 1.0
    ranked_weight: float = 0.0
    choice_weight: float = 0.0
    regret_weight: float = 0.0
    regret_margin: float = 0.0
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
                raise InputError(f"{name} must be at least 1, not {getattr(self, name)}")
        for name in ("learning_rate", "target_rate"):
            if not 0 < getattr(self, name) <= 1:
                raise InputError(f"{name} must be above 0 and at most 1, not {getattr(self, name)}")
        for name in (*WEIGHTS, *OF_CHOICES, "regret_margin"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"{name} must be at least 0 and finite, not {getattr(self, name)}")
        if self.window < 0 or self.length < 0:
            raise InputError("window and length must not be negative")
        if self.distil and self.exact:
            raise InputError("distil and exact are two ways to learn a planner's values")
        for name in OF_CHOICES:
            if getattr(self, name) and not self.distil:
                raise InputError(f"{name} needs distil: choices are those at a planner's values")
        if self.distil and not self.window:
            raise InputError("distil needs a window: values are kept with the states of rounds")
        if len(self.kinds) != len(KINDS) or min(self.kinds) < 0 or not sum(self.kinds) > 0:
            raise InputError(
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
                raise InputError(f"{name} must lie in [0, 1], not {getattr(self, name)}")


def require_fitting(domain: Domain, options: SelfModelOptions) -> None:
    """Refuse options that do not fit a world.

    Raises:
        InputError: a window is longer than rounds, or ends where nothing is known to follow; or
            assumptions are to be learned that the world does not work out.
    """
    rounds = options.length or domain.horizon
    if options.window > rounds:
        raise InputError(f"window is {options.window}, longer than rounds of {rounds} steps")
    if options.window and domain.over_at_horizon and not options.distil:
        raise InputError(f"with a window, values of {domain.name} can only be distilled")
    works_out = not isinstance(domain, World) or offers(domain, "supposed")
    if options.assumed and domain.assumptions and not works_out:
        raise InputError(f"assumed must be 0, as {domain.name} has no supposed()")
