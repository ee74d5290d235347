"""At which steps of a round each of its latents is read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from mirror_ppl.errors import HumanModelError


@dataclass(frozen=True)
class Span:
    """The steps of a round at which a site of ``round_latents`` is read.

    Attributes:
        first: the first of them.
        last: the step after the last.
        values: how many values of the site's support differ in what is seen there, from the first
            on; all that follow see what the last of these does.
    """

    first: int
    last: int
    values: int


def check_spans(spans: Mapping[str, Span], sizes: Mapping[str, int], steps: int) -> None:
    """Make sure that spans are as `HumanModel.spans` says.

    Args:
        spans: by site.
        sizes: number of values of each site of ``round_latents``.
        steps: of the round.

    Raises:
        HumanModelError: they are not.
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
