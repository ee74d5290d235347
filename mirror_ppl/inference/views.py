"""Building tables of views: which distinct ways there are to have seen the recorded rounds.

Every combination of the discrete implants is a candidate. Round by round, candidates are dropped
that explain the person's actions hopelessly worse than the best one, however the person decides:
the later rounds need not be seen through their eyes, and exact marginalization stays cheap.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import prod

import pyro
import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.distinct import distinct_rows
from mirror_ppl.domains import Observation
from mirror_ppl.errors import HumanModelError
from mirror_ppl.inference.courses import beliefs_and_values
from mirror_ppl.models.human import HumanModel, View
from mirror_ppl.models.sites import Readable, discrete_names, latent_sites, latent_values
from mirror_ppl.models.view_table import IMPOSSIBLE, NO_VIEW, ViewTable

MAX_COMBINATIONS = 100_000


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


def discrete_sites(human: HumanModel) -> dict[str, Tensor]:
    """Supports ``[n]`` of the discrete sites of a human model's prior, by name."""
    with torch.random.fork_rng(devices=[]), pyro.plate("person", 1, dim=-2):
        trace = poutine.trace(human.prior).get_trace()
    sites = latent_sites(trace)
    return {
        name: sites[name]["fn"].enumerate_support(expand=False).flatten()
        for name in sites
        if name in discrete_names(trace)
    }


def restricted(table: ViewTable, alive: Tensor) -> ViewTable:
    """The table with only the combinations ``[P, M]`` that are alive, and the views they had."""
    index = torch.where(alive[:, None], table.index, NO_VIEW)
    kept = []
    for person in index:
        needed, renumbered = torch.unique(person[person != NO_VIEW], return_inverse=True)
        person[person != NO_VIEW] = renumbered
        kept.append(needed)
    most = max(len(needed) for needed in kept)

    def part(value: Tensor) -> Tensor:
        pairs = zip(value, kept, strict=True)
        return torch.stack([_pad(own[needed], most) for own, needed in pairs])

    return replace(
        table,
        index=index,
        belief=part(table.belief),
        values=part(table.values),
        view_actions=part(table.view_actions),
        view_steps=part(table.view_steps),
        view_counts=torch.tensor([len(needed) for needed in kept]),
    )


def combination_scores(table: ViewTable, log_probabilities: Tensor) -> Tensor:
    """Log-likelihood ``[..., P, M]`` of each combination, given log-probabilities of actions.

    Args:
        table: the recorded rounds.
        log_probabilities: ``[..., P, V, T, A]`` of actions in each view.
    """
    likelihood = table.log_likelihoods(log_probabilities)
    scores = []
    for person, index in enumerate(table.index):
        index = index[table.real[person]]
        possible = (index != NO_VIEW).all(0)
        own = likelihood[..., person, :]
        found = own.new_full((*own.shape[:-1], index.shape[-1]), IMPOSSIBLE)
        total = own.new_zeros(*own.shape[:-1], int(possible.sum()))
        for views in index[:, possible]:
            total = total + own[..., views]
        found[..., possible] = total
        scores.append(found)
    return torch.stack(scores, -2)


@torch.no_grad()
def build_view_table(
    human: HumanModel,
    demonstrations: Demonstrations,
    candidates: Sequence[Tensor] | None = None,
    screening: Screening | None = None,
    report: Callable[[int], None] = lambda people: None,
) -> ViewTable:
    """Every distinct view of the recorded rounds, with the beliefs that they lead to.

    Args:
        human: whose ``perceive`` and ``believe`` are called (and ``act`` for screening).
        demonstrations: rounds of P people.
        candidates: for each person, the combinations that are considered at all (see
            :meth:`ViewTable.combination`); all of them unless given.
        screening: when to give up combinations on the way; never unless given.
        report: called with the number of people done.

    Raises:
        HumanModelError: ``perceive`` reads a site that cannot be enumerated, or there are too many
            combinations of values.
    """
    supports = discrete_sites(human)
    used = _sites_read(human, demonstrations, supports)
    supports = {name: support for name, support in supports.items() if name in used}
    sizes = tuple(len(support) for support in supports.values())
    if prod(sizes) > MAX_COMBINATIONS:
        raise HumanModelError(
            f"perceive() depends on {prod(sizes)} combinations of discrete values; "
            f"at most {MAX_COMBINATIONS} can be marginalized"
        )
    axes = torch.meshgrid(*supports.values(), indexing="ij") if supports else ()
    grid = {name: axis.flatten() for name, axis in zip(supports, axes, strict=True)}
    observation = demonstrations.observation()
    everything = torch.arange(prod(sizes), device=demonstrations.actions.device)
    people = []
    for person in range(demonstrations.num_people):
        alive = everything if candidates is None else candidates[person]
        people.append(_person(human, demonstrations, observation, person, grid, alive, screening))
        report(person + 1)
    most = max(len(part["actions"]) for part in people)

    def padded(name: str) -> Tensor:
        return torch.stack([_pad(part[name], most) for part in people])

    return ViewTable(
        sites=tuple(supports),
        sizes=sizes,
        index=torch.stack([part["index"] for part in people]),
        belief=padded("belief"),
        values=padded("values"),
        view_actions=padded("actions"),
        view_steps=padded("steps"),
        recorded=demonstrations.actions.clamp(min=0),
        steps=demonstrations.mask,
        view_counts=torch.tensor([len(part["actions"]) for part in people]),
    )


def _sites_read(
    human: HumanModel, demonstrations: Demonstrations, supports: Mapping[str, Tensor]
) -> set[str]:
    observation, told, _ = _round(demonstrations, demonstrations.observation(), 0, 0)
    implants = Readable({name: support[:1] for name, support in supports.items()})
    human.perceive(implants, observation, told)
    return implants.read


def _round(
    demonstrations: Demonstrations, observation: Observation, person: int, number: int
) -> tuple[dict[str, Tensor], dict[str, Tensor], Tensor]:
    """Observation ``[1, T, ...]``, told ``[1, T, K]`` and actions ``[1, T]`` of one round."""
    steps = demonstrations.shape[2]
    seen = {name: value[person, number, :steps][None] for name, value in observation.items()}
    told = {name: value[person, number][None] for name, value in demonstrations.told.items()}
    return seen, told, demonstrations.actions[person, number].clamp(min=0)[None]


def _person(
    human: HumanModel,
    demonstrations: Demonstrations,
    observation: Observation,
    person: int,
    grid: Mapping[str, Tensor],
    alive: Tensor,
    screening: Screening | None,
) -> dict[str, Tensor]:
    """Views of one person's rounds, and index ``[B, M]`` of each combination's view."""
    combinations = max([len(values) for values in grid.values()], default=1)
    index = torch.full((demonstrations.shape[1], combinations), NO_VIEW, device=alive.device)
    rounds: list[dict[str, Tensor]] = []
    resolution = 0.0 if screening is None else screening.resolution
    screen = None if screening is None else _Screen(human, screening, index[0])
    total = 0
    # Somebody without rounds still needs one view, of padding, to be looked up.
    for number in range(max(int(demonstrations.round_counts[person]), 1)):
        seen, told, actions = _round(demonstrations, observation, person, number)
        real = demonstrations.mask[person, number]
        candidates = {name: axis[alive] for name, axis in grid.items()}
        view = human.perceive(candidates, seen, told)
        part, inverse = _views(human, view, seen, actions, real, len(alive), resolution)
        index[number, alive] = total + inverse
        total += len(part["actions"])
        rounds.append(part)
        if screen is not None:
            alive = screen.keep(alive, inverse, part)
    # Only what somebody who was never given up has seen is worth keeping.
    kept = torch.full_like(index, NO_VIEW)
    kept[:, alive] = index[:, alive]
    values = {name: torch.cat([part[name] for part in rounds]) for name in rounds[0]}
    needed, renumbered = torch.unique(kept[kept != NO_VIEW], return_inverse=True)
    kept[kept != NO_VIEW] = renumbered
    return {"index": kept} | {name: value[needed] for name, value in values.items()}


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


class _Screen:
    """Running log-likelihoods ``[ways, M]`` of combinations, and who is still worth following."""

    def __init__(self, human: HumanModel, screening: Screening, combinations: Tensor) -> None:
        self.human = human
        self.screening = screening
        self.score = torch.zeros(screening.ways, len(combinations), device=combinations.device)
        self.sites: dict[str, Tensor] | None = None

    def keep(self, alive: Tensor, inverse: Tensor, part: Mapping[str, Tensor]) -> Tensor:
        log_probabilities = self._act(part["belief"][None], part["values"][None])[:, 0]
        actions = part["actions"].expand(log_probabilities.shape[:-1])
        chosen = log_probabilities.gather(-1, actions[..., None]).squeeze(-1)
        log_likelihood = torch.where(part["steps"], chosen, 0.0).sum(-1)
        self.score[:, alive] += log_likelihood[:, inverse]
        score = self.score[:, alive].amax(0)
        return alive[score >= score.max() - self.screening.margin]

    def _act(self, belief: Tensor, values: Tensor) -> Tensor:
        """Log-probabilities ``[ways, 1, V, T, A]`` under the same drawn ways every time."""
        with (
            torch.random.fork_rng(devices=[]),
            pyro.plate("way", self.screening.ways, dim=-3),
            pyro.plate("person", 1, dim=-2),
            poutine.condition(data=self.sites or {}),
            poutine.trace() as trace,
        ):
            torch.manual_seed(self.screening.seed)
            log_probabilities = self.human.act(self.human.prior(), belief, values)
        if self.sites is None:
            self.sites = latent_values(trace.trace)
        return log_probabilities


def _pad(value: Tensor, length: int) -> Tensor:
    return torch.nn.functional.pad(value, [0, 0] * (value.dim() - 1) + [0, length - len(value)])
