"""Building tables of views: which distinct ways there are to have seen the recorded rounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import prod

import pyro
import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.domains import Observation
from mirror_ppl.errors import HumanModelError
from mirror_ppl.inference.sightings import Screening, Sightings
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.sites import Readable, discrete_names, latent_sites
from mirror_ppl.models.view_table import IMPOSSIBLE, NO_VIEW, ViewTable

MAX_COMBINATIONS = 100_000


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
    tables = []
    for person in range(demonstrations.num_people):
        alive = everything if candidates is None else candidates[person]
        sightings = Sightings(human, grid, alive, screening)
        # Somebody without rounds still needs one view, of padding, to be looked up.
        for number in range(max(int(demonstrations.round_counts[person]), 1)):
            one_round = _round(demonstrations, observation, person, number)
            sightings.add(*one_round, demonstrations.mask[person, number])
        tables.append(sightings.table())
        report(person + 1)
    return _joined(tables, demonstrations)


def _joined(tables: Sequence[ViewTable], demonstrations: Demonstrations) -> ViewTable:
    """The table of P people of the tables of each of them."""
    rounds = demonstrations.shape[1]
    views = max(int(table.view_counts) for table in tables)

    def padded(name: str, length: int, value: int = 0) -> Tensor:
        return torch.stack([_pad(getattr(table, name)[0], length, value) for table in tables])

    return ViewTable(
        sites=tables[0].sites,
        sizes=tables[0].sizes,
        index=padded("index", rounds, NO_VIEW),
        belief=padded("belief", views),
        values=padded("values", views),
        view_actions=padded("view_actions", views),
        view_steps=padded("view_steps", views),
        recorded=demonstrations.actions.clamp(min=0),
        steps=demonstrations.mask,
        view_counts=torch.cat([table.view_counts for table in tables]),
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


def _pad(value: Tensor, length: int, fill: int = 0) -> Tensor:
    missing = length - len(value)
    return torch.nn.functional.pad(value, [0, 0] * (value.dim() - 1) + [0, missing], value=fill)
