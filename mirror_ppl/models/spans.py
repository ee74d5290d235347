"""Spans: the steps of a round at which each of its latents is read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from mirror_ppl.errors import HumanModelError


@dataclass(frozen=True)
class Span:
    """The steps of a round at which a site of ``round_latents`` is read.

    Attributes:
        first: the first of these steps.
        last: the step after the last of them.
        values: number of leading values of the site's support that differ in what is seen there;
            all later values see what the last of these sees.
    """

    first: int
    last: int
    values: int


def check_spans(spans: Mapping[str, Span], sizes: Mapping[str, int], steps: int) -> None:
    """Check that spans satisfy the contract of `HumanModel.spans`.

    Args:
        spans: by site.
        sizes: number of values of each site of ``round_latents``.
        steps: of the round.

    Raises:
        HumanModelError: they do not.
    """
    if set(spans) != set(sizes):
        raise HumanModelError(
            f"spans has to be of the sites of round_latents, {', '.join(sizes)}; not of "
            f"{', '.join(spans) or 'none'}"
        )
    begin = 0
    for site, span in spans.items():
        throughout = (span.first, span.last) == (0, steps)
        if not begin <= span.first <= span.last <= steps or (throughout and begin > 0):
            raise HumanModelError(
                f'the span of "{site}", steps {span.first} to {span.last} of {steps}, begins '
                "before the one before it is over"
            )
        if not 1 <= span.values <= sizes[site]:
            raise HumanModelError(
                f'"{site}" has {sizes[site]} values, not the {span.values} of its span'
            )
        begin = 0 if throughout else span.last
