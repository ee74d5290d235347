"""Distributions of the models: a Gaussian Markov chain and a normalized categorical.

A latent trajectory is one sample site, ``z`` ``[T + 1, Z]``. Sampling is sequential; the log
density of a trajectory is computed for all steps at once, so the evidence lower bound is cheap.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from pyro.distributions import Categorical, TorchDistribution
from torch import Tensor
from torch.distributions import Distribution, Normal, constraints

from mirror_ppl.errors import InputError
from mirror_ppl.models.networks import Gaussian
from mirror_ppl.shapes import broadcast_shapes

Step = Callable[[Tensor, Tensor], Gaussian]


class NormalizedCategorical(Categorical):
    """A categorical distribution with log-probabilities that are already normalized.

    Args:
        log_probabilities: of each value, ``[..., n]``.
        power: of the probabilities in ``log_prob``, the likelihood of a power posterior. Values
            are drawn with the probabilities themselves, whose logarithms are ``logits``. It is no
            ``poutine.scale``, as enumerated sites need a common one.
    """

    def __init__(self, log_probabilities: Tensor, power: float = 1.0) -> None:
        self.power = power
        self.logits = log_probabilities  # pyright: ignore[reportAttributeAccessIssue] - lazy
        self._param = log_probabilities
        self._num_events = log_probabilities.shape[-1]
        # Categorical.__init__ would normalize them again.
        Distribution.__init__(self, log_probabilities.shape[:-1], validate_args=False)

    def expand(self, batch_shape: torch.Size, _instance: object = None) -> NormalizedCategorical:
        """Expand to a batch shape; see :meth:`torch.distributions.Distribution.expand`."""
        del _instance
        return NormalizedCategorical(self.logits.expand(*batch_shape, -1), self.power)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability ``[...]`` of values, times the power."""
        shape = broadcast_shapes(value.shape, self.logits.shape[:-1])
        place = value.long().expand(shape)[..., None]
        found = self.logits.expand(*shape, -1).gather(-1, place).squeeze(-1)
        return found if self.power == 1 else self.power * found


class GaussianChain(TorchDistribution):
    """``p(z_0) prod_t p(z_t | z_{t-1}, u_t)`` with diagonal Gaussian steps.

    Args:
        initial: parameters ``[..., Z]`` of ``p(z_0)``.
        step: ``(z_{t-1} [..., Z], u_t [..., U]) -> Gaussian [..., Z]``.
        inputs: ``u_1 .. u_T``, ``[..., T, U]`` or ``[..., T]``.
        input_dims: 1 if each ``u_t`` is a vector, 0 if it is a number (an action's index).
    """

    arg_constraints = {}  # noqa: RUF012 # pyright: ignore[reportAssignmentType]
    support = constraints.independent(constraints.real, 2)  # pyright: ignore[reportAssignmentType]
    has_rsample = True

    def __init__(self, initial: Gaussian, step: Step, inputs: Tensor, input_dims: int) -> None:
        self.initial = initial
        self.step = step
        self.inputs = inputs
        self.time = inputs.dim() - 1 - input_dims
        steps = inputs.shape[self.time]
        batch = initial.mean.shape[:-1]
        event = torch.Size((steps + 1, initial.mean.shape[-1]))
        super().__init__(batch, event, validate_args=False)

    def expand(self, batch_shape: torch.Size, _instance: object = None) -> GaussianChain:
        """Return itself; only its own batch shape is allowed."""
        if torch.Size(batch_shape) != self.batch_shape:
            raise InputError("a GaussianChain has one trajectory for each of its inputs")
        return self

    def rsample(self, sample_shape: torch.Size = torch.Size()) -> Tensor:  # noqa: B008
        """Draw trajectories ``[..., T + 1, Z]``, differentiable in the parameters."""
        mean, scale = self.initial
        shape = torch.Size(sample_shape) + mean.shape
        latent = mean + scale * torch.randn(shape, dtype=mean.dtype, device=mean.device)
        trajectory = [latent]
        for inputs in self.inputs.unbind(self.time):
            mean, scale = self.step(latent, inputs)
            latent = mean + scale * torch.randn_like(mean)
            trajectory.append(latent)
        return torch.stack(trajectory, -2)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density ``[...]`` of trajectories ``[..., T + 1, Z]``, all steps at once."""
        first = Normal(*self.initial, validate_args=False).log_prob(value[..., 0, :])
        rest = Normal(*self.step(value[..., :-1, :], self.inputs), validate_args=False)
        return first.sum(-1) + rest.log_prob(value[..., 1:, :]).sum((-1, -2))
