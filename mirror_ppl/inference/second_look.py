"""Two passes over a person's rounds, for models with sampled attention.

The values of attention are best proposed from the person's posterior
(:mod:`mirror_ppl.likelihood.attention`), which is unknown in the first pass. The first pass gives a
coarse posterior; the second proposes attention from it.
"""

from __future__ import annotations

from mirror_ppl.inference.adaptive_importance import ImportanceOptions, sample_importance
from mirror_ppl.inference.weighted import Weighted
from mirror_ppl.likelihood.round_views import Rounds
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.human import HumanModel

LIKELY_DRAWS = 64
"""Posterior draws that propose attention."""


def looks_twice(human: HumanModel) -> bool:
    """True if attention is sampled, so that a second pass improves its proposal."""
    return human.has_round_latents and not human.chained


def second_look(
    human: HumanModel,
    rounds: Rounds,
    screening: Screening | None,
    options: ImportanceOptions,
    builder: ViewTableBuilder,
    found: Weighted,
) -> tuple[ViewTableBuilder, Weighted]:
    """Run the second pass of one person (global random state).

    Args:
        human: the model of people; see :func:`looks_twice`.
        rounds: all rounds of the person.
        screening: when to drop combinations of discrete sites.
        options: settings of the second pass.
        builder: views of the first pass.
        found: weighted draws of the first pass.

    Returns:
        Views and weighted draws of the second pass.
    """
    likely = found.sample(LIKELY_DRAWS, builder.grid)
    again = ViewTableBuilder(human, screening, likely=likely)
    again.add(rounds)
    return again, sample_importance(human, again.table(), options, found)
