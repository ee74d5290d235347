"""Check of the spans that a human model declares, on a made-up round."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, map_state
from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.attention import attention_sites
from mirror_ppl.models.dependencies import dependencies
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.spans import Span, check_spans

STEPS = 12


@torch.no_grad()
def check_spans_hold(human: HumanModel, discrete: Mapping[str, Tensor]) -> None:
    """Check that attention can be summed out span by span.

    Args:
        human: the model of people; its attention is :attr:`HumanModel.chained`.
        discrete: values ``[1]`` of the discrete implants of a person.

    Raises:
        HumanModelError: spans break the contract of :meth:`HumanModel.spans`: they overlap, a site
            is read outside of its span, values declared equivalent differ in the percept, or a site
            depends on another one.
    """
    domain = human.domain
    device = next(human.parameters()).device
    generator = torch.Generator(device).manual_seed(0)
    state, observed, steps = domain.initial(1, generator), [], min(STEPS, domain.horizon)
    while len(observed) < steps and not bool(domain.over(state)):
        observed.append(domain.observe(state))
        # Every other action is the first one, so that the round does not end at once.
        action = torch.randint(len(domain.actions), (1,), generator=generator, device=device)
        state = domain.transition(state, action * (len(observed) % 2))
    so_far = {name: torch.cat([one[name] for one in observed]) for name in observed[0]}
    spans = human.spans(so_far)
    _check_independence(human)
    supports = attention_sites(human)
    check_spans(spans, {name: len(support) for name, support in supports.items()}, len(observed))
    # A site may hide at its first value what it shows at its last.
    for place in (0, -1):
        others = {name: own[place].view(1) for name, own in supports.items()}
        _check_looks(human, spans, supports, {**discrete, **others}, observed)


def _check_looks(
    human: HumanModel,
    spans: Mapping[str, Span],
    supports: Mapping[str, Tensor],
    usual: Mapping[str, Tensor],
    observed: Sequence[Observation],
) -> None:
    """Check that no value of a site changes the percept outside of what its span declares."""
    knowledge = human.nothing_known(1, device=observed[0]["ego"].device)
    for step, now in enumerate(observed):
        can_be = human.domain.communicable(now)
        told = {name: torch.zeros_like(mask) for name, mask in can_be.items()}
        for site, span in spans.items():
            inside = span.first <= step < span.last
            some = supports[site][span.values - 1 if inside else 0 :]
            number = len(some)

            def repeated(part: Tensor, number: int = number) -> Tensor:
                return part.expand(number, *part.shape[1:])

            sites = {name: repeated(value) for name, value in usual.items()}
            known = map_state(repeated, knowledge)
            view, _ = human.perceive({**sites, site: some}, known, now, told, step)
            numbers = view.map(repeated).numbers()
            if bool((numbers != numbers[:1]).any()):
                what = (
                    f"its values from number {span.values - 1} on differ in what is seen"
                    if inside
                    else "it is read outside of it"
                )
                raise HumanModelError(
                    f'the span of "{site}" is steps {span.first} to {span.last}, but at step '
                    f"{step} {what}"
                )
        _, knowledge = human.perceive(usual, knowledge, now, told, step)


def _check_independence(human: HumanModel) -> None:
    """Check that no site of attention depends on another."""
    found = dependencies(human).round_latents
    for site, parents in found.items():
        if parents & found.keys():
            raise HumanModelError(
                f'"{site}" of round_latents depends on another of its sites, so that spans '
                "cannot be summed out one after another"
            )
