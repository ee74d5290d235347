"""Posterior predictive of people's actions, step by step.

Each action is predicted given the earlier actions of its round. Round latents are summed out, with
their posterior given those actions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import pyro
import torch
from pyro import poutine
from torch import Tensor
from torch.nn.functional import pad

from mirror_ppl.likelihood.chain import NEVER, Chain, draws_last, log_sums, scaled_sums
from mirror_ppl.likelihood.densities import PLATES, choices, log_weighted_latents
from mirror_ppl.likelihood.enumeration import conditioned
from mirror_ppl.likelihood.view_table import NO_VIEW, Attention, ViewTable
from mirror_ppl.models.human import HumanModel

MOST_NUMBERS = 4_000_000
"""Numbers in the beliefs that are gathered at once; bounds memory."""
DRAWS = 100
"""Draws for which attention is summed out at once; bounds memory."""


@torch.no_grad()
def predict_actions(human: HumanModel, table: ViewTable, draws: Mapping[str, Tensor]) -> Tensor:
    """Log-probabilities ``[S, P, B, T, A]`` of actions, for each draw of the implants.

    Runs the program of fitting, conditioned on the draws: each person has the views that follow
    from the draw.
    """
    number = next(iter(draws.values())).shape[0]
    if isinstance(table.attention, Chain):
        parts = []
        for begin in range(0, number, DRAWS):
            some = {name: value[begin : begin + DRAWS] for name, value in draws.items()}
            parts.append(_chained(human, table, table.attention, some))
        return torch.cat(parts)
    if table.attention is None:
        each = table.recorded.numel() * table.belief.shape[-1]
        at_once = max(1, MOST_NUMBERS // each)
        parts = []
        for begin in range(0, number, at_once):
            some = {name: value[begin : begin + at_once] for name, value in draws.items()}
            parts.append(_looked_up(human, table, some))
        return torch.cat(parts)
    results = []
    for draw in range(number):
        own = {name: value[draw] for name, value in draws.items()}
        with (
            poutine.block(),
            poutine.condition(data=own),
            pyro.plate("person", table.people, dim=-PLATES),
        ):
            implants = human.prior()
            # Missing rounds take the first view, so that results do not depend on other people.
            sight = table.sight_of(implants).clamp(min=0).expand(table.people, table.rounds)
            results.append(_attentive(human, implants, table, table.attention, sight))
    return torch.stack(results)


def _looked_up(human: HumanModel, table: ViewTable, draws: Mapping[str, Tensor]) -> Tensor:
    """Log-probabilities ``[S, P, B, T, A]`` where a draw has one view of each round."""
    number = len(next(iter(draws.values())))
    person = torch.arange(table.people, device=table.index.device)[:, None]
    with conditioned(draws, number, table.people):
        implants = human.prior()
        # Missing rounds take the first view, so that results do not depend on other people.
        sight = table.sight_of(implants).clamp(min=0).expand(number, table.people, table.rounds)
        moments = table.moments[person, sight].clamp(min=0)  # [S, P, B, T]
        belief, values = (
            part[person[..., None], moments].flatten(2, 3) for part in (table.belief, table.values)
        )
        found = human.act(implants, belief, values)
    return found.expand(*values.shape[:3], -1).unflatten(2, moments.shape[2:])


def _attentive(
    human: HumanModel,
    implants: Mapping[str, Tensor],
    table: ViewTable,
    attention: Attention,
    sight: Tensor,
) -> Tensor:
    """Log-probabilities ``[P, B, T, A]`` given earlier actions, with attention summed out."""
    person = torch.arange(table.people, device=sight.device)[:, None]
    views = attention.sights[person, sight]  # [P, B, G']
    moments = table.moments[person[..., None], views].clamp(min=0)  # [P, B, G', T]
    each, done = choices(human, implants, table.belief, table.values, table.acted, powered=False)
    found = each.expand(table.people, *each.shape[-2:])[person[..., None, None], moments]
    done = done.expand(table.people, -1)[person[..., None, None], moments]
    along = done.cumsum(-1)
    weights = log_weighted_latents(
        human, implants, attention.values, attention.log_weights, attention.covariates
    )
    # Earlier actions inform about attention.
    before = pad(along[..., :-1], [1, 0])
    before = torch.log_softmax(before + attention.shares(weights)[..., None], 2)
    return torch.logsumexp(before[..., None] + found, 2)


def _chained(
    human: HumanModel, table: ViewTable, chain: Chain, draws: Mapping[str, Tensor]
) -> Tensor:
    """Log-probabilities ``[S, P, B, T, A]`` for chained attention, by forward recursion."""
    number = len(next(iter(draws.values())))
    with conditioned(draws, number, table.people):
        implants = human.prior()
        each, chosen = choices(
            human, implants, table.belief, table.values, table.acted, powered=False
        )
        each = each.expand(number, table.people, *each.shape[-2:])
        each = draws_last(each, (number,), 3).flatten(0, 1)  # [P * N, A, S]
        chosen = draws_last(chosen.expand(number, *table.acted.shape), (number,), 2).flatten(0, 1)
        probabilities = chain.log_probabilities(human, implants, table.rounds)
        probabilities = draws_last(probabilities, (number,), 4)
        sight = table.sight_of(implants).expand(number, table.people, table.rounds)
    assert bool((sight[:, table.real] != NO_VIEW).all())  # of the table's combinations
    (people, rounds, steps), moments = table.recorded.shape, table.acted.shape[-1]
    actions = each.shape[1]
    found = each.new_full((people * rounds * steps, actions, number), -math.log(actions))
    each = each.exp()
    so_far = _first_states(chain, sight, table.real)  # [S', S]
    for place, level in enumerate(chain.levels):
        person = level.person[level.state]
        chance = so_far.index_select(0, level.state) + chain.of_level(probabilities, place)
        of_view = table.moments[person, level.view]
        of_view = torch.where(of_view == NO_VIEW, NO_VIEW, of_view + person[:, None] * moments)
        own = person * rounds + level.rounds[level.state]
        chance = _along(of_view, own, chosen, each, chance, found)
        if place + 1 < len(chain.levels):
            so_far = log_sums(chance, level.following, len(chain.levels[place + 1].person))
    return found.permute(2, 0, 1).unflatten(1, (people, rounds, steps)).contiguous()


def _first_states(chain: Chain, sight: Tensor, real: Tensor) -> Tensor:
    """Log-probabilities ``[S', S]`` of the states in which rounds begin.

    Args:
        chain: the chain of P people.
        sight: sight of each draw ``[S, P, B]``.
        real: False for missing rounds ``[P, B]``.
    """
    people, sights = sight.shape[1], chain.sights
    at = torch.arange(people, device=sight.device)[:, None] * sights + sight
    found = torch.full((people * sights, len(sight)), NEVER, device=sight.device)
    found.scatter_(0, at[:, real].T, 0.0)
    return found[chain.places]


def _along(
    moments: Tensor, rounds: Tensor, chosen: Tensor, each: Tensor, chance: Tensor, found: Tensor
) -> Tensor:
    """Forward recursion through the steps of a span.

    Args:
        moments: moment at each step of E courses ``[E, T]``; ``NO_VIEW`` outside of the span.
        rounds: round of each course ``[E]``.
        chosen: log-likelihood of the record at each moment ``[N, S]``.
        each: probability of every action at each moment ``[N, A, S]``.
        chance: log-probability of each course before the span ``[E, S]``.
        found: log-probabilities of actions at the recorded steps of all rounds ``[B T, A, S]``, in
            which those of the span's steps are set.

    Returns:
        Log-probability of each course after the span ``[E, S]``.
    """
    lengths, order = (moments != NO_VIEW).sum(1).sort(descending=True, stable=True)
    moments, rounds, along = moments[order], rounds[order], chance.index_select(0, order)
    begin, (steps, number) = (moments != NO_VIEW).int().argmax(1), (moments.shape[1], len(each))
    counts = (lengths > torch.arange(steps, device=order.device)[:, None]).sum(1).tolist()
    # Step by step, as numbers of one step fit into a cache.
    for offset, going in enumerate(counts):
        if not going:
            break
        now, of_round = along[:going], rounds[:going]
        step = begin[:going] + offset
        moment = moments[:going].gather(1, step[:, None])[:, 0]
        # Many courses share moments.
        pairs, place = ((of_round * steps + step) * number + moment).unique(return_inverse=True)
        share = scaled_sums(now, of_round, place, len(pairs))
        recorded, place = (pairs // number).unique(return_inverse=True)
        total = share.new_zeros(len(recorded), share.shape[-1]).index_add_(0, place, share)
        expected = each.new_zeros(len(recorded), *each.shape[1:])
        expected.index_add_(0, place, share[:, None] * each.index_select(0, pairs % number))
        found[recorded] = (expected / total[:, None]).log()
        now += chosen.index_select(0, moment)
    return torch.empty_like(along).index_copy_(0, order, along)
