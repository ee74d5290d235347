"""The views of a round span by span, where it is known when each site of attention is read.

What is left of all that a person may have attended to so far is a belief, what the domain says they
know, and the values that are read throughout the round. Histories that agree in that are one state
(:mod:`mirror_ppl.likelihood.chain`).
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from mirror_ppl.likelihood.attention import attention_sites
from mirror_ppl.likelihood.chain import Chain, Level
from mirror_ppl.likelihood.round_views import ManyViews, Rounds, moments_along, views_of_moments
from mirror_ppl.models.belief_tracking import BeliefState, Memory
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.spans import check_spans
from mirror_ppl.row_hashing import as_whole_numbers, distinct_rows


@torch.no_grad()
def chained_views(
    human: HumanModel, combinations: Mapping[str, Tensor], number: int, one: Rounds
) -> tuple[ManyViews, Chain]:
    """The distinct views of one round, and a chain of one sight for each combination.

    Args:
        human: the model of people; its attention is :attr:`HumanModel.chained`.
        combinations: values ``[M]`` of the discrete implants.
        number: M.
        one: the round, R is 1.

    Raises:
        HumanModelError: ``spans`` breaks its contract.
    """
    so_far, actions = one.so_far(0)
    steps = len(actions)
    supports = attention_sites(human)
    spans = human.spans(so_far)
    check_spans(spans, {site: len(support) for site, support in supports.items()}, steps)
    facts = {name: fact.view(1, 1) for name, fact in human.covariates(so_far).items()}
    device = actions.device
    combination = torch.arange(number, device=device)
    state = BeliefState.initial(human, number, Memory.of_rounds(human, one.observation))
    throughout: dict[str, Tensor] = {}
    levels, rows = [], []
    begins = [0, *(span.first for span in list(spans.values())[1:]), steps]
    done = 0
    for place, (site, span) in enumerate(spans.items()):
        support, shape = supports[site], (1, len(combination), span.values)
        parent = torch.arange(len(combination), device=device).repeat_interleave(span.values)
        combination = combination[parent]
        throughout = {name: own[parent] for name, own in throughout.items()}
        # Sites of other spans are not read at this one: any value will do.
        values = {name: own[:1].expand(len(parent)) for name, own in supports.items()} | throughout
        values[site] = support[: span.values].repeat(shape[1])
        implants = {name: own[combination] for name, own in combinations.items()} | values
        span_steps = range(begins[place], begins[place + 1])
        state, numbers = moments_along(
            state.at(parent), implants, one, torch.zeros_like(parent), span_steps
        )
        if span.last == steps and span.first == 0:
            throughout[site] = values[site]
        others = torch.stack([combination, *map(as_whole_numbers, throughout.values())], -1)
        first, following = distinct_rows(torch.cat([others, state.key()], -1))
        index = torch.arange(span.values, device=device)
        index[-1] += max(len(own) for own in supports.values())  # that value or any later
        levels.append(
            Level(
                view=done + torch.arange(len(numbers), device=device).view(shape),
                value=index.expand(shape),
                following=following.view(shape),
                rounds=torch.zeros(shape[:2], dtype=torch.long, device=device),
            )
        )
        rows.append(numbers)
        done += len(numbers)
        state, combination = state.at(first), combination[first]
        throughout = {name: own[first] for name, own in throughout.items()}
    numbers = torch.cat(rows)
    views, which = views_of_moments(state, numbers, torch.zeros_like(numbers[:, 0]), 1)
    return views, Chain(supports, tuple(levels), facts).of_views(which)
