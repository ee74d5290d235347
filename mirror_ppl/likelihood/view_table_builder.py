"""Builder of the table of views of one person's rounds.

Every joint value of what perception reads (:mod:`mirror_ppl.likelihood.grid`), a *combination*, is
a candidate. After some rounds, candidates are dropped whose likelihood is far below the best one's
under every policy. Later rounds need no views of them, and sums stay cheap. A candidate is kept if
recorded actions are impossible under it and some policy: with other policies it may be the most
probable one. It is also kept if it is not far below under
:mod:`mirror_ppl.likelihood.likely_policies`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import pad

from mirror_ppl.likelihood.attention import KEPT, VALUES, AttentionValues, Proposal
from mirror_ppl.likelihood.chain import NEVER, Chain
from mirror_ppl.likelihood.chained_views import chained_views
from mirror_ppl.likelihood.combination_sets import fixed_prior
from mirror_ppl.likelihood.combinations import log_priors, require_own_attention
from mirror_ppl.likelihood.densities import require_compilable
from mirror_ppl.likelihood.grid import Grid
from mirror_ppl.likelihood.likely_policies import LikelyPolicies
from mirror_ppl.likelihood.points import whole_grid
from mirror_ppl.likelihood.policies import draw_policies, within
from mirror_ppl.likelihood.policy_likelihoods import PolicyLikelihoods
from mirror_ppl.likelihood.round_views import ManyViews, Rounds, RoundViews, views_of_rounds
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.telling import MANY, some_of, telling_first
from mirror_ppl.likelihood.view_table import NO_VIEW, Attention, ViewTable
from mirror_ppl.limits import require_memory
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.row_hashing import distinct_rows, seed_of

SCREENED_ROWS, MOST_ROWS = 4096, 32768
"""Combinations times rounds that are processed at once. With screening,
the number at which they take as long as the calls' overhead: later rounds have fewer left."""
CHAINED_ROUNDS = 32
"""Rounds that are processed at once where attention is summed out exactly."""
FEW_ROUNDS = 2
"""Number of rounds up to which they are processed in the given order."""
GROWTH = 3
"""With screening, largest ratio of the rounds processed at once to those before them."""
PROPOSING_POLICIES = 64
"""Draws from the prior that propose attention without screening."""
TEMPERATURE = 4.0


class ViewTableBuilder:
    """Accumulates the views of a person's rounds.

    Args:
        human: its ``perceive`` and ``believe`` are called (and ``act`` for screening).
        screening: when to drop combinations; never if ``None``.
        candidates: numbers of the combinations to consider (see :meth:`ViewTable.combination`);
            all by default.
        likely: approximate posterior draws ``[S, 1, 1, ...]`` of the person, from which attention
            is proposed; by default prior draws weighted by earlier rounds.
        values: number of sampled values of attention per round.
        grid: joint values of the sites that perception reads; by default :func:`whole_grid`.

    Raises:
        HumanModelError: see :func:`whole_grid` and :func:`require_own_attention`.

    Attributes:
        grid: joint values ``[M, ...]`` of the sites that perception reads, or *combinations*.
        alive: numbers of the combinations that are left.
        score: log-likelihood ``[policies, M]`` of each combination under each policy.
        policies: these policies, see :func:`draw_policies`; ``likely``, if given.
    """

    def __init__(
        self,
        human: HumanModel,
        screening: Screening | None,
        candidates: Tensor | None = None,
        likely: Mapping[str, Tensor] | None = None,
        values: int = VALUES,
        grid: Grid | None = None,
    ) -> None:
        require_compilable(human)
        device = next(human.parameters()).device
        self.human = human
        self.screening = screening
        self.grid = whole_grid(human) if grid is None else grid
        self.alive = torch.arange(self.grid.number, device=device)
        if candidates is not None:
            self.alive = candidates
        self.policies: dict[str, Tensor] = {}
        if screening is not None and likely is not None:
            some = torch.arange(screening.policies, device=device)
            self.policies = {name: value[some % len(value)] for name, value in likely.items()}
        elif screening is not None:
            found = draw_policies(human, self.grid, screening.policies, screening.seed)
            self.policies = found or {}
            if found is None:  # no representative policies for screening
                self.screening = screening = None
        number = 0 if screening is None else screening.policies
        if self.policies:
            number = len(next(iter(self.policies.values())))
        self.score = torch.zeros(number, self.grid.number, device=device)
        self._likelihoods = PolicyLikelihoods(human, self.policies, number)
        self._rounds: list[RoundViews] = []
        self._seen: list[tuple[Tensor, Tensor]] = []
        self._recorded: list[tuple[Tensor, Tensor]] = []
        self._attended: list[AttentionValues] = []
        self._proposal: Proposal | None = None
        # Policies are not compared with sampled attention, nor if there are some for each kind.
        self._likely: LikelyPolicies | None = None
        if (
            self.policies
            and likely is None
            and not (human.has_round_latents or human.stratified_by)
        ):
            assert screening is not None
            self._likely = LikelyPolicies(human, self.grid, screening.seed + 1)
        if human.has_round_latents:
            require_own_attention(human, self.grid)
        if human.has_round_latents and not human.chained:
            known = {} if likely is not None else self.policies
            anybody = known or draw_prior(human, 1, PROPOSING_POLICIES, 0)
            self._proposal = Proposal(human, anybody, likely, values)

    @torch.no_grad()
    def add(self, rounds: Rounds) -> None:
        """Add rounds: the fewer combinations are left, the more rounds at once."""
        order, before = self._order(rounds), len(self._rounds)
        if order is None:
            self._go_through(rounds)
            return
        self._go_through(rounds.chosen(order))
        place = torch.tensor(order).argsort().tolist()
        for parts in (self._rounds, self._seen, self._recorded):
            parts[before:] = [parts[before + one] for one in place]

    def _go_through(self, rounds: Rounds) -> None:
        first = 0
        while first < len(rounds):
            some = rounds.at(first, first + self._at_once())
            if self.human.chained:
                self._add_chained(some)
            else:
                self._add_together(some)
            first += len(some)

    def _order(self, rounds: Rounds) -> list[int] | None:
        """Order in which rounds are processed: the most informative about combinations first.

        ``None`` for the given order, if there are few combinations or attention is proposed from
        earlier rounds.
        """
        number = len(rounds)
        as_they_are = self.human.has_round_latents or len(self.alive) < MANY
        if self.screening is None or as_they_are or number <= FEW_ROUNDS:
            return None
        some = some_of(self.alive)
        candidates = {name: repeated(axis[some], number) for name, axis in self.grid.items()}
        row = torch.arange(number, device=some.device).repeat_interleave(len(some))
        views, which = views_of_rounds(self.human, candidates, row, rounds)
        # The policies that distinguish moments suffice to distinguish rounds.
        policies = self._likelihoods.merging(self.screening)
        found = self._likelihoods.of_views(views, policies)[:, which].unflatten(-1, (number, -1))
        if bool(found.isneginf().any()):
            return None
        prior = (self.score + self.log_prior)[: len(found), some]
        return telling_first(found, prior, self.screening.margin_after(1))

    def _at_once(self) -> int:
        """Number of rounds that are processed before combinations are dropped."""
        if self._proposal is not None:  # proposed from earlier rounds
            return 1
        if self.human.chained:
            return CHAINED_ROUNDS
        if self.screening is None:
            return max(1, MOST_ROWS // len(self.alive))
        # Few at first, since the first rounds rule out most combinations.
        return max(1, min(GROWTH * len(self._rounds), SCREENED_ROWS // len(self.alive)))

    def _add_together(self, rounds: Rounds) -> None:
        alive = self.alive
        candidates = {name: axis[alive] for name, axis in self.grid.items()}
        attended, each, seed = None, 1, 0
        if self._proposal is not None:
            attended, seed = self._attended_in(rounds, self._proposal)
            each = len(attended)
            candidates = {
                name: value.repeat_interleave(each, 0) for name, value in candidates.items()
            }
            values = attended.values.items()
            candidates |= {name: value.repeat(len(alive)) for name, value in values}
            if alive.device.type == "cpu":
                require_memory(
                    len(alive) * each * rounds.actions.shape[1] * _bytes_of_a_view(self.human),
                    f"views of {len(alive):,} combinations of discrete sites with {each} values of "
                    "round_latents each (fewer sites take less)",
                )
        number = len(alive) * each
        row = torch.arange(len(rounds), device=alive.device).repeat_interleave(number)
        candidates = {name: repeated(own, len(rounds)) for name, own in candidates.items()}
        views, which = views_of_rounds(self.human, candidates, row, rounds)
        if self.screening is not None and self.screening.resolution > 0:
            views, place = self._merged(views, self.screening)
            which = place[which]
        found = None if self.screening is None else self._likelihoods.of_views(views)
        total = torch.zeros(len(self.score), len(alive), device=alive.device)
        for one, (own, part), seen in zip(
            rounds.each(), views.split(), which.view(len(rounds), number), strict=True
        ):
            seen, sights = seen - own.start, None
            if attended is not None:
                of_each = seen.view(len(alive), -1)
                first, seen = distinct_rows(of_each)
                sights = of_each[first]  # [U, G]
            if found is not None:
                likelihoods = found[:, own]
                if attended is not None and sights is not None:
                    joint = self._likelihoods.with_attention(likelihoods[:, sights], attended)
                    useful = torch.softmax(joint, -1).nan_to_num(0.0).mean(1)
                    likelihoods = torch.logsumexp(joint, -1)
                    attended = attended.thinned(self._weights() @ useful, KEPT, seed)
                    sights = sights[:, attended.kept]
                total = total + likelihoods[:, seen]
            if attended is not None:
                self._attended.append(attended)
                part = replace(part, sights=sights)
                part = part.kept(torch.arange(len(part), device=alive.device))
            self._take(one, part, seen, alive)
        if self.screening is not None:
            self._screen(total, self.screening)

    def _merged(self, views: ManyViews, screening: Screening) -> tuple[ManyViews, Tensor]:
        """Merge moments that some policies do not tell apart; also the new number of each view."""
        policies = self._likelihoods.merging(screening)
        return self._likelihoods.merged(views, policies, screening.resolution)

    def _attended_in(self, one: Rounds, proposal: Proposal) -> tuple[AttentionValues, int]:
        """Sampled values of attention in a round, and the round's seed."""
        so_far, actions = one.so_far(0)
        recorded = {**one.observation, "actions": one.actions}
        seed = seed_of({name: value[:, one.real[0]] for name, value in recorded.items()})
        covariates = self.human.covariates(so_far)
        attended = proposal.values(
            self._weights(),
            seed,
            {name: value.view(1, 1) for name, value in covariates.items()},
            self.human.log_proposal(so_far, actions),
        )
        return attended, seed

    def _add_chained(self, rounds: Rounds) -> None:
        """Add rounds whose attention is summed out exactly."""
        alive = self.alive
        candidates = {name: axis[alive] for name, axis in self.grid.items()}
        views, chains = chained_views(self.human, candidates, len(alive), rounds)
        if self.screening is not None and self.screening.resolution > 0:
            before = [own.start for own, _ in views.split()]
            views, place = self._merged(views, self.screening)
            begins = [own.start for own, _ in views.split()]
            chains = [
                chain.of_views(place[first:] - begin)
                for chain, first, begin in zip(chains, before, begins, strict=True)
            ]
        parts = views.split()
        every = torch.arange(len(alive), device=alive.device)
        for one, chain, (_, part) in zip(rounds.each(), chains, parts, strict=True):
            self._take(one, replace(part, chain=chain), every, alive)
        if self.screening is not None:
            likelihoods = self._likelihoods.of_views(views)[:, None]
            together = Chain.one_after_another(chains, [len(part.moments) for _, part in parts])
            with self._likelihoods.conditioned():
                probabilities = together.log_probabilities(
                    self.human, self.human.prior(), len(rounds)
                )
            found = together.marginal(likelihoods, probabilities)[:, 0]
            found = found.masked_fill(found <= NEVER, -torch.inf)
            self._screen(found.unflatten(-1, (len(rounds), -1)).sum(1), self.screening)

    def _take(self, one: Rounds, part: RoundViews, seen: Tensor, alive: Tensor) -> None:
        """Store a round, with the view of each combination that was alive."""
        self._rounds.append(part)
        self._seen.append((alive, seen))
        self._recorded.append((one.actions[0], one.real[0]))

    def _screen(self, found: Tensor, screening: Screening) -> None:
        """Add log-likelihoods ``[policies, M']`` of those alive; drop those far behind."""
        alive = self.alive
        score = self.score[:, alive] + found
        self.score[:, alive] = score
        # With the prior, whose factors and observed sites may rule combinations out.
        joint = score + self.log_prior[:, alive]
        margin = screening.margin_after(len(self._rounds))
        keep = score.isneginf().any(0) & self.log_prior[:, alive].isfinite().any(0)
        keep |= within(self.human, joint, margin)
        if self._likely is not None:
            rounds = list(zip(self._rounds, self._seen, strict=True))
            more = self._likely.log_joint(rounds, alive, joint.amax(0))
            keep |= within(self.human, torch.cat([joint, more]), margin)
        self.alive = alive[keep]

    def table(self) -> ViewTable:
        """Build the table of the views that are left; needs at least one round."""
        index, rounds, sights, views, moments = [], [], 0, 0, 0
        shifted, attended, chains, counts = [], [], [], []
        steps = max(len(real) for _, real in self._recorded)
        for part, (combination, view) in zip(self._rounds, self._seen, strict=True):
            # Keep only views of combinations that were never dropped.
            row = torch.full((self.grid.number,), NO_VIEW, device=self.alive.device)
            row[combination] = view
            needed, place = torch.unique(row[self.alive], return_inverse=True)
            row = torch.full_like(row, NO_VIEW)
            row[self.alive] = sights + place
            part = part.kept(needed).lengthened(steps)
            index.append(row)
            rounds.append(part)
            shifted.append(torch.where(part.moments == NO_VIEW, NO_VIEW, part.moments + moments))
            if part.sights is not None:
                attended.append(part.sights + views)
            if part.chain is not None:
                chains.append(part.chain)
                counts.append(len(part.moments))
            sights, views = sights + len(part), views + len(part.moments)
            moments = moments + part.acted.numel()
        attention = None
        if chains:
            attention = Chain.one_after_another(chains, counts)
        elif attended:
            attention = Attention.of_rounds(self._attended, attended)
        return ViewTable(
            grid=self.grid,
            index=torch.stack(index)[None],
            moments=torch.cat(shifted)[None],
            belief=torch.cat([part.belief for part in rounds])[None],
            values=torch.cat([part.values for part in rounds])[None],
            acted=torch.cat([part.acted for part in rounds])[None],
            recorded=self._padded_to(steps, 0)[None],
            steps=self._padded_to(steps, 1)[None],
            view_counts=torch.tensor([views]),
            attention=attention,
            likely={} if self._likely is None else self._likely.policies,
        )

    def _weights(self) -> Tensor:
        """Weights of the policies given the rounds so far ``[policies]``."""
        if self.screening is None:
            number = PROPOSING_POLICIES
            return torch.full((number,), 1 / number, device=self.alive.device)
        joint = (self.score + self.log_prior)[:, self.alive].logsumexp(-1)
        if not bool(joint.isfinite().any()):
            joint = torch.zeros_like(joint)
        # Tempered: else few policies, none of them the person, would have all the weight.
        return torch.softmax(joint / TEMPERATURE, 0)

    def _padded_to(self, steps: int, which: int) -> Tensor:
        """Recorded actions (0) or real steps (1) of all rounds, ``[B, T]``."""
        parts = [recorded[which] for recorded in self._recorded]
        return torch.stack([pad(part, [0, steps - len(part)]) for part in parts])

    @cached_property
    def fixed_prior(self) -> Tensor | None:
        """Log prior ``[M]`` of each combination; ``None`` if it depends on the other implants."""
        return fixed_prior(self.human, self.grid)

    @cached_property
    def log_prior(self) -> Tensor:
        """Log prior probability of each combination under each policy, ``[policies, M]``."""
        others = {name: policy for name, policy in self.policies.items() if name not in self.grid}
        return log_priors(self.human, self.grid, others, 1)[:, 0]


def repeated(values: Tensor, number: int) -> Tensor:
    """Repeat values ``[M, ...]`` one after the other, ``[number M, ...]``."""
    return values.repeat(number, *[1] * (values.dim() - 1))


def _bytes_of_a_view(human: HumanModel) -> int:
    """Memory for what is perceived at a step, about; masks, assumed numbers, and copies."""
    numbers = sum(len(m.items) * (1 + len(m.features)) for m in human.domain.modalities)
    return 4 * 4 * numbers  # copies as measured in driving
