"""Construction of tables of views: the distinct ways to see the recorded rounds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from mirror_ppl.data import Demonstrations
from mirror_ppl.likelihood.attention import VALUES
from mirror_ppl.likelihood.chain import Chain
from mirror_ppl.likelihood.grid import Grid
from mirror_ppl.likelihood.round_views import Rounds, RoundViews
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.view_table import IMPOSSIBLE, NO_VIEW, Attention, ViewTable
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.measured import with_measurements


def restricted(table: ViewTable, alive: Tensor) -> ViewTable:
    """Restrict a table to the combinations ``[P, M]`` that are alive, and to their views."""
    index = torch.where(alive[:, None], table.index, NO_VIEW)
    people = []
    for person, row in enumerate(index):
        needed, renumbered = torch.unique(row[row != NO_VIEW], return_inverse=True)
        row[row != NO_VIEW] = renumbered
        people.append(views_of(table, person).kept(needed))
    attention = table.attention
    if isinstance(attention, Chain):
        attention = _joined_chain(people, attention.covariates)
    elif attention is not None:
        attention = replace(attention, **_padded_sights(people))
    return replace(
        table,
        index=index,
        **_padded(people),
        view_counts=torch.tensor([len(views.moments) for views in people]),
        attention=attention,
    )


def views_of(table: ViewTable, person: int) -> RoundViews:
    """One person's views, padding included."""
    attention = table.attention
    if isinstance(attention, Chain):
        chain = attention.of_person(person)
        return RoundViews(
            table.moments[person],
            table.belief[person],
            table.values[person],
            table.acted[person],
            chain=chain,
        )
    return RoundViews(
        table.moments[person],
        table.belief[person],
        table.values[person],
        table.acted[person],
        None if attention is None else attention.sights[person],
        None if attention is None else attention.rounds[person],
    )


def _padded(people: Sequence[RoundViews]) -> dict[str, Tensor]:
    """Views of P people, padded, as fields of a table."""
    views = max(len(own.moments) for own in people)
    moments = max(len(own.acted) for own in people)
    return {
        "moments": torch.stack([_pad(own.moments, views, NO_VIEW) for own in people]),
        "belief": torch.stack([_pad(own.belief, moments) for own in people]),
        "values": torch.stack([_pad(own.values, moments) for own in people]),
        "acted": torch.stack([_pad(own.acted, moments) for own in people]),
    }


def _joined_chain(people: Sequence[RoundViews], covariates: Mapping[str, Tensor]) -> Chain:
    """Stack the chains of P people."""
    chains = [replace(own.chain, covariates={}) for own in people if own.chain is not None]
    return replace(Chain.of_people(chains), covariates=covariates)


def _padded_sights(people: Sequence[RoundViews]) -> dict[str, Tensor]:
    """Sights of P people, padded, as fields of a table."""
    most = max(len(own) for own in people)
    sights = [own.sights for own in people if own.sights is not None]
    widest = max(part.shape[1] for part in sights)
    sights = [pad(part, [0, widest - part.shape[1]]) for part in sights]
    rounds = [own.rounds for own in people if own.rounds is not None]
    return {
        "sights": torch.stack([_pad(part, most) for part in sights]),
        "rounds": torch.stack([_pad(part, most) for part in rounds]),
    }


def combination_scores(
    table: ViewTable, likelihood: Tensor, combinations: Tensor | None = None
) -> Tensor:
    """Log-likelihood ``[..., P, M]`` of each combination, given that of sights.

    Args:
        table: the recorded rounds.
        likelihood: log-likelihood of each sight ``[..., P, U]``, see `log_likelihoods`.
        combinations: numbers ``[M]`` of the combinations; all by default.
    """
    scores = []
    for person, index in enumerate(table.index):
        index = index[table.real[person]]
        if combinations is not None:
            index = index[:, combinations]
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
    likely: Mapping[str, Tensor] | None = None,
    values: int = VALUES,
    grid: Grid | None = None,
) -> ViewTable:
    """Build the table of all distinct views of recorded rounds, with their beliefs.

    Args:
        human: its ``perceive`` and ``believe`` are called (and ``act`` for screening).
        demonstrations: rounds of P people.
        candidates: for each person, the combinations to consider (see
            :meth:`ViewTable.combination`); all by default.
        screening: when to drop combinations during construction; never by default.
        report: called with the number of people done.
        likely: approximate posterior draws ``[S, P, 1, ...]``, see :class:`ViewTableBuilder`.
        values: number of sampled values of attention per round.
        grid: joint values of the sites that perception reads, see :class:`ViewTableBuilder`;
            points are of one person.

    Raises:
        HumanModelError: the model breaks its contract.
    """
    builders = person_builders(
        human, demonstrations, screening, likely, candidates, values, report, grid
    )
    return join_tables([builder.table() for builder in builders], demonstrations.shape)


def person_builders(
    human: HumanModel,
    demonstrations: Demonstrations,
    screening: Screening | None = None,
    likely: Mapping[str, Tensor] | None = None,
    candidates: Sequence[Tensor] | None = None,
    values: int = VALUES,
    report: Callable[[int], None] = lambda people: None,
    grid: Grid | None = None,
) -> Iterator[ViewTableBuilder]:
    """Yield a builder with the rounds of each person in turn; see `build_view_table`.

    Measurements of a person are observed sites of their builder's human model.
    """
    for person in range(demonstrations.num_people):
        own = None
        if likely is not None:
            own = {name: value[:, person : person + 1] for name, value in likely.items()}
        alone = human
        if demonstrations.measurements:
            alone = with_measurements(human, demonstrations.select_people([person]))
        some = None if candidates is None else candidates[person]
        builder = ViewTableBuilder(alone, screening, some, own, values, grid)
        builder.add(rounds_of(demonstrations, person))
        yield builder
        report(person + 1)


def join_tables(
    tables: Sequence[ViewTable], shape: tuple[int, int, int] | None = None
) -> ViewTable:
    """Join the tables of single people to a table of P people.

    Args:
        tables: tables of one person each.
        shape: (P, B, T), to which they are padded; by default the largest of each.
    """
    if shape is None:
        rounds, steps = (max(table.recorded.shape[axis] for table in tables) for axis in (1, 2))
    else:
        _, rounds, steps = shape
    views = [views_of(table, 0).lengthened(steps) for table in tables]
    own = [table.attention for table in tables if isinstance(table.attention, Attention)]
    chains = [table.attention for table in tables if isinstance(table.attention, Chain)]

    def recorded(value: Tensor) -> Tensor:
        return _pad(pad(value, [0, steps - value.shape[1]]), rounds)

    attention = None
    if chains:
        covariates = {
            name: torch.stack([_pad(one.covariates[name][0], rounds) for one in chains])
            for name in chains[0].covariates
        }
        attention = _joined_chain(views, covariates)
    if own:

        def padded(parts: Sequence[Tensor], fill: float = 0) -> Tensor:
            most = max(part.shape[-1] for part in parts)
            parts = [pad(part[0], [0, most - part.shape[-1]], value=fill) for part in parts]
            return torch.stack([_pad(part, rounds) for part in parts])

        attention = Attention(
            values={name: padded([one.values[name] for one in own]) for name in own[0].values},
            log_weights=padded([one.log_weights for one in own], -torch.inf),
            kept=padded([one.kept for one in own]),
            log_kept=padded([one.log_kept for one in own], torch.inf),
            covariates={
                name: torch.stack([_pad(one.covariates[name][0], rounds) for one in own])
                for name in own[0].covariates
            },
            **_padded_sights(views),
        )
    return ViewTable(
        grid=tables[0].grid,
        index=torch.stack([_pad(table.index[0], rounds, NO_VIEW) for table in tables]),
        **_padded(views),
        recorded=torch.stack([recorded(table.recorded[0]) for table in tables]),
        steps=torch.stack([recorded(table.steps[0]) for table in tables]),
        view_counts=torch.cat([table.view_counts for table in tables]),
        attention=attention,
        likely={},
    )


def rounds_of(demonstrations: Demonstrations, person: int) -> Rounds:
    """A person's rounds, as :meth:`ViewTableBuilder.add` takes them.

    A person without rounds has one that is all padding, so that tables are not empty.
    """
    steps = demonstrations.shape[2]
    rounds = max(int(demonstrations.round_counts[person]), 1)
    return Rounds(
        {
            name: value[person, :rounds, :steps]
            for name, value in demonstrations.observation().items()
        },
        {name: mask[person, :rounds] for name, mask in demonstrations.told.items()},
        demonstrations.actions[person, :rounds].clamp(min=0),
        demonstrations.mask[person, :rounds],
    )


def _pad(value: Tensor, length: int, fill: int = 0) -> Tensor:
    missing = length - len(value)
    return pad(value, [0, 0] * (value.dim() - 1) + [0, missing], value=fill)
