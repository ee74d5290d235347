"""Going through a person's rounds twice, where what they attend to differs from round to round.

What stands for all that they may have attended to is chosen by who they are
(:mod:`mirror_ppl.likelihood.attention`), which is not known when their rounds are seen for the
first time. The first look tells roughly; the second chooses by that.
"""

from __future__ import annotations

from dataclasses import replace

from mirror_ppl.inference.adaptive_importance import ImportanceOptions, sample_importance
from mirror_ppl.inference.sampler import Weighted
from mirror_ppl.likelihood.round_views import Rounds
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.human import HumanModel

LIKELY_DRAWS, COARSE_DRAWS = 64, 256
"""Draws of the person by which attention is chosen, and proposals of a stage of the first look."""


def looks_twice(human: HumanModel) -> bool:
    """Whether what stands for all that people may attend to depends on who they are."""
    return human.has_round_latents and not human.chained


def coarse(options: ImportanceOptions) -> ImportanceOptions:
    """Settings under which one learns roughly who somebody is."""
    return replace(
        options,
        proposals=min(COARSE_DRAWS, options.proposals),
        enough=min(LIKELY_DRAWS, options.enough),
    )


def second_look(
    human: HumanModel,
    rounds: Rounds,
    screening: Screening | None,
    options: ImportanceOptions,
    builder: ViewTableBuilder,
    found: Weighted,
) -> tuple[ViewTableBuilder, Weighted]:
    """Weighted draws of one person, from the global random state.

    Args:
        human: the model of people; see :func:`looks_twice`.
        rounds: all that is recorded of the person.
        screening: when to give up combinations of discrete sites.
        options: settings of the second time.
        builder: of the first time.
        found: of the first time.

    Returns:
        The rounds as seen the second time, and what they say.
    """
    likely = found.sample(LIKELY_DRAWS, builder.grid)
    again = ViewTableBuilder(human, screening, likely=likely)
    again.add(rounds)
    return again, sample_importance(human, again.table(), options, found)
