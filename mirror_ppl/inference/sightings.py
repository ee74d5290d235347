"""The views of one person's rounds, round after round.

Every combination of the discrete implants is a candidate. Round by round, candidates are dropped
that explain the person's actions hopelessly worse than the best one, however the person decides:
the later rounds need not be seen through their eyes, and exact marginalization stays cheap.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import prod

import pyro
import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.distinct import distinct_rows
from mirror_ppl.domains import Observation, Visibility
from mirror_ppl.inference.combinations import grid_of, log_priors, perceived_sites
from mirror_ppl.inference.courses import beliefs_and_values
from mirror_ppl.inference.prior import draw_prior
from mirror_ppl.models.human import HumanModel, View
from mirror_ppl.models.view_table import NO_VIEW, ViewTable


@dataclass(frozen=True)
class Screening:
    """When a combination of discrete implants is given up.

    Attributes:
        margin: nats by which its log-likelihood may fall behind the best one's, each under the way
            to decide that suits it best.
        ways: number of ways to decide, drawn from the prior.
        seed: seed of those draws.
        resolution: views of a round count as one when the action values along them, in units of
            reward, fall on the same points of a grid of this width at every step. The grid widens
            where one action is far better, because there nothing hangs on how much.
    """

    margin: float = 15.0
    ways: int = 16
    seed: int = 0
    resolution: float = 0.1


class Sightings:
    """What a person may have seen in their rounds so far.

    Args:
        human: whose ``perceive`` and ``believe`` are called (and ``act`` for screening).
        screening: when to give up combinations on the way; never if ``None``.
        candidates: numbers of the combinations that are considered at all (see
            :meth:`ViewTable.combination`); all of them unless given.

    Raises:
        HumanModelError: see :func:`perceived_sites`.

    Attributes:
        grid: values ``[M]`` of the discrete sites that perception reads, for each combination.
        sizes: number of values of each of these sites.
        alive: numbers of the combinations that are left.
        score: log-likelihood ``[ways, M]`` of each of them under each way to decide.
        ways: these ways, see :meth:`draw_ways`.
    """

    def __init__(
        self,
        human: HumanModel,
        screening: Screening | None,
        candidates: Tensor | None = None,
    ) -> None:
        device = next(human.parameters()).device
        self.human = human
        self.screening = screening
        supports = perceived_sites(human)
        self.grid = grid_of(supports)
        self.sizes = tuple(len(support) for support in supports.values())
        self.alive = torch.arange(prod(self.sizes), device=device)
        if candidates is not None:
            self.alive = candidates
        ways = 0 if screening is None else screening.ways
        self.score = torch.zeros(ways, prod(self.sizes), device=device)
        self.ways: dict[str, Tensor] = {}
        self._rounds: list[dict[str, Tensor]] = []
        self._seen: list[tuple[Tensor, Tensor]] = []
        self._recorded: list[tuple[Tensor, Tensor]] = []

    @torch.no_grad()
    def add(
        self, observation: Observation, told: Visibility, actions: Tensor, real: Tensor
    ) -> None:
        """Go through one round more.

        Args:
            observation: ``[1, T, ...]``.
            told: ``[1, T, K]``.
            actions: ``[1, T]``.
            real: which steps are no padding, ``[T]``.
        """
        alive = self.alive
        candidates = {name: axis[alive] for name, axis in self.grid.items()}
        view = self.human.perceive(candidates, observation, told)
        resolution = 0.0 if self.screening is None else self.screening.resolution
        part, which = _views(self.human, view, observation, actions, real, len(alive), resolution)
        total = sum(len(one["actions"]) for one in self._rounds)
        self._rounds.append(part)
        self._seen.append((alive, total + which))
        self._recorded.append((actions[0], real))
        if self.screening is not None:
            self.score[:, alive] += self._log_likelihoods(part)[:, which]
            best = self.score[:, alive].amax(0)
            self.alive = alive[best >= best.max() - self.screening.margin]

    def table(self) -> ViewTable:
        """The views that are left, as a table of one person; there was at least one round."""
        rounds = len(self._seen)
        index = torch.full((rounds, prod(self.sizes)), NO_VIEW, device=self.alive.device)
        for row, (combination, view) in zip(index, self._seen, strict=True):
            row[combination] = view
        # Only what somebody who was never given up has seen is worth keeping.
        kept = torch.full_like(index, NO_VIEW)
        kept[:, self.alive] = index[:, self.alive]
        needed, renumbered = torch.unique(kept[kept != NO_VIEW], return_inverse=True)
        kept[kept != NO_VIEW] = renumbered

        def part(name: str) -> Tensor:
            return torch.cat([one[name] for one in self._rounds])[needed][None]

        return ViewTable(
            sites=tuple(self.grid),
            sizes=self.sizes,
            index=kept[None],
            belief=part("belief"),
            values=part("values"),
            view_actions=part("actions"),
            view_steps=part("steps"),
            recorded=torch.stack([actions for actions, _ in self._recorded])[None],
            steps=torch.stack([real for _, real in self._recorded])[None],
            view_counts=torch.tensor([len(needed)]),
        )

    @cached_property
    def log_prior(self) -> Tensor:
        """Log prior probability of each combination under each way, ``[ways, M]``."""
        others = {name: way for name, way in self.draw_ways().items() if name not in self.grid}
        return log_priors(self.human, self.grid, others, 1)[:, 0]

    def _log_likelihoods(self, part: Mapping[str, Tensor]) -> Tensor:
        """Of a round's actions under each way and view, ``[ways, U]``."""
        log_probabilities = self._act(part["belief"][None], part["values"][None])[:, 0]
        actions = part["actions"].expand(log_probabilities.shape[:-1])
        chosen = log_probabilities.gather(-1, actions[..., None]).squeeze(-1)
        return torch.where(part["steps"], chosen, 0.0).sum(-1)

    def draw_ways(self) -> dict[str, Tensor]:
        """The ways to decide, ``[ways, 1, 1, ...]``; always the same."""
        if not self.ways and self.screening is not None:
            self.ways = draw_prior(self.human, 1, self.screening.ways, self.screening.seed)
        return self.ways

    def _act(self, belief: Tensor, values: Tensor) -> Tensor:
        """Log-probabilities ``[ways, 1, U, T, A]``."""
        with (
            poutine.block(),
            poutine.condition(data=self.draw_ways()),
            pyro.plate("way", len(self.score), dim=-3),
            pyro.plate("person", 1, dim=-2),
        ):
            return self.human.act(self.human.prior(), belief, values)


def _views(
    human: HumanModel,
    view: View,
    observation: Observation,
    actions: Tensor,
    real: Tensor,
    combinations: int,
    resolution: float,
) -> tuple[dict[str, Tensor], Tensor]:
    """Distinct views of one round, and which of them each combination has."""
    view = view.map(lambda part: part.expand(combinations, *part.shape[1:]))
    numbers = view.numbers() * real
    first, inverse = distinct_rows(numbers)
    some = view.map(lambda part: part[first])
    belief, values, node = beliefs_and_values(human, some, numbers[first], observation, actions)
    if resolution > 0:
        merged, cluster = _alike(values[node], real, resolution)
        node, inverse = node[merged], cluster[inverse]
    belief, values = belief[node], values[node]
    return {
        "belief": belief,
        "values": values,
        "actions": actions.expand(len(belief), -1),
        "steps": real.expand(len(belief), -1),
    }, inverse


def _alike(values: Tensor, real: Tensor, resolution: float) -> tuple[Tensor, Tensor]:
    """Rows ``[U']`` that stand for clusters of like action values, and each row's cluster."""
    advantage = values - values.mean(-1, keepdim=True)
    # asinh is the identity near 0 and logarithmic far from it.
    grid = torch.round(torch.asinh(advantage) / resolution) * real[:, None]
    return distinct_rows(grid.flatten(1).long())
