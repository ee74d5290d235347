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

from mirror_ppl.likelihood.chain import NEVER, NO_VALUE, Chain
from mirror_ppl.likelihood.densities import PLATES, choices, log_weighted_latents
from mirror_ppl.likelihood.enumeration import conditioned
from mirror_ppl.likelihood.view_table import NO_VIEW, Attention, ViewTable
from mirror_ppl.models.human import HumanModel

MOST_NUMBERS = 4_000_000
"""Numbers in the beliefs that are gathered at once; bounds memory."""
DRAWS = 50
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
    before = torch.nn.functional.pad(along[..., :-1], [1, 0])
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
        each = each.expand(number, table.people, *each.shape[-2:])  # [S, P, N, A]
        chosen = chosen.expand(number, *table.acted.shape)
        probabilities = chain.log_probabilities(human, implants, table.rounds)
        probabilities = probabilities.expand(
            number, table.people, table.rounds, *probabilities.shape[-2:]
        )
        sight = table.sight_of(implants).expand(number, table.people, table.rounds)
    *_, steps = table.recorded.shape
    actions = each.shape[-1]
    shape = (number, table.people, table.rounds, steps, actions)
    found = each.new_full(shape, -math.log(actions))  # in padding
    for person in range(table.people):
        alone = chain.of_person(person)
        own = probabilities[:, person : person + 1]
        by_level = [alone.of_level(own, level)[:, 0] for level in range(len(alone.levels))]
        for place in table.real[person].nonzero().flatten().tolist():
            so_far = each.new_full((number, chain.sights), NEVER)
            so_far.scatter_(1, sight[:, person, place, None], 0.0)
            for level, likely in zip(alone.levels, by_level, strict=True):
                (states,) = (level.rounds[0] == place).nonzero(as_tuple=True)
                real = level.value[0, states] != NO_VALUE  # [H, K]
                moments = table.moments[person, level.view[0, states][real]]  # [E, T]
                log_chance = (likely[:, states] + so_far[:, states, None])[:, real]  # [S, E]
                now = (moments != NO_VIEW).any(0)
                if now.any():
                    done, predicted = _along(
                        moments[:, now], chosen[:, person], each[:, person], log_chance
                    )
                    found[:, person, place, now] = predicted
                    log_chance = log_chance + done
                so_far = _gathered(log_chance, level.following[0, states][real])
    return found


def _along(
    moments: Tensor, chosen: Tensor, each: Tensor, log_chance: Tensor
) -> tuple[Tensor, Tensor]:
    """Forward recursion through the steps of a span.

    Args:
        moments: moments of E courses ``[E, T]``.
        chosen: log-likelihood of the record at each moment ``[S, N]``.
        each: log-probability of every action ``[S, N, A]``.
        log_chance: log-probability of each course before the span ``[S, E]``.

    Returns:
        The log-likelihood of each course ``[S, E]``, and log-probabilities ``[S, T, A]`` of
        actions.
    """
    used, which = moments.unique(return_inverse=True)
    taken = chosen[:, used][:, which]  # [S, E, T]
    total = taken.cumsum(-1)
    weights = torch.softmax(total - taken + log_chance[..., None], 1)
    draws, _, steps = weights.shape
    # Many courses share moments.
    place = torch.arange(steps, device=which.device) * len(used) + which
    share = weights.new_zeros(draws, steps * len(used))
    share.index_add_(1, place.flatten(), weights.flatten(1))
    share = share.view(draws, steps, -1)
    return total[..., -1], (share @ each[:, used].exp()).log()


def _gathered(log_chance: Tensor, following: Tensor) -> Tensor:
    """Log-probabilities ``[S, H]`` of states: sums over courses ``[S, E]`` that lead to them."""
    highest = log_chance.amax(1, keepdim=True)
    total = log_chance.new_zeros(len(log_chance), int(following.max()) + 1)
    total.index_add_(1, following, (log_chance - highest).exp())
    return total.log().clamp(min=NEVER) + highest
