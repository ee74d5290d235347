"""`python -m mirror_ppl.compare`: which human model describes the same people best."""

from __future__ import annotations

import os
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from mirror_ppl.console import console_for_tables
from mirror_ppl.errors import OptionError
from mirror_ppl.limits import check_picture

if TYPE_CHECKING:
    from rich.table import Table

    from mirror_ppl.evaluation.comparison import Comparison
    from mirror_ppl.evaluation.evidence import EvidenceComparison

WIDTH = 80
PROGRAM = "python -m mirror_ppl.compare"
DESCRIPTION = """Compare human models that were fitted to the same recordings, by how well they
predict rounds that they did not learn from or by their marginal likelihoods, and print how far each
is behind the best, with the standard error of the difference."""
EXAMPLES = {
    "two fits of the same recordings": "runs/demo runs/mine",
    "by marginal likelihoods, with a picture": (
        "runs/demo runs/mine --by evidence --figure runs/compare.png"
    ),
}
"""Arguments, by what they are for."""


@dataclass(frozen=True)
class Options:
    """What to compare, how, and where the results go."""

    posteriors: Positional[tuple[Path, ...]] = ()
    """Two or more posteriors of python -m mirror_ppl.fit: files, or the folders that hold them."""
    by: str = "loo"
    """The measure: loo (predictions of each round learned from, as if it had been left out),
    heldout (of the rounds that were held out) or evidence (marginal likelihoods of all rounds
    learned from: log Bayes factors, and the share of people whom each model describes)."""
    labels: tuple[str, ...] = ()
    """What to call the models, in the same order; by their name and folder unless given."""
    json: Path | None = None
    """Write the results as data, also those of each person."""
    figure: Path | None = None
    """Draw the differences of each person and of all: a file that ends in .png, .pdf or .svg."""

    def __post_init__(self) -> None:
        number = len(self.posteriors)
        if number < 2:  # noqa: PLR2004 - a comparison takes two
            raise OptionError(f"give at least two posteriors to compare, not {number}")
        if self.by not in ("loo", "heldout", "evidence"):
            raise OptionError(f'--by must be loo, heldout or evidence, not "{self.by}"')
        if self.labels:
            if len(self.labels) != number:
                raise OptionError(
                    f"--labels must be as many as posteriors, {number}, not {len(self.labels)}"
                )
            if len({label.strip() for label in self.labels} - {""}) < number:
                raise OptionError("--labels must be different from each other and not empty")
        check_picture(self.figure, "--figure")


def main(options: Options) -> None:
    """Compare, write the results, and print what was found.

    Raises:
        MirrorError: what was asked for cannot be done; nothing is written then.
    """
    from mirror_ppl.evaluation.compared_files import label_models, read_evidence, read_fit
    from mirror_ppl.evaluation.comparison import compare_fits
    from mirror_ppl.evaluation.evidence import compare_evidence
    from mirror_ppl.files import json_text, lock_of, output_folder, write_together
    from mirror_ppl.plots.comparison import plot_comparison

    _check_outputs(options)
    _require_different(options.posteriors)
    if options.by == "evidence":
        files = [read_evidence(path) for path in options.posteriors]
        comparison = compare_evidence(files, options.labels or label_models(files))
    else:
        files = [read_fit(path, options.by) for path in options.posteriors]
        comparison = compare_fits(files, options.labels or label_models(files), options.by)
    contents = {}
    if options.json is not None:
        contents[options.json] = json_text({"command": PROGRAM} | comparison.as_data())
    if options.figure is not None:
        picture = plot_comparison(comparison.table(), comparison.by)
        contents[options.figure] = picture.content(options.figure.suffix[1:].lower())
    with ExitStack() as stack:
        for path in contents:
            stack.enter_context(output_folder(path.parent, [path.name], lock_of(path)))
        write_together(contents)
    console_for_tables(WIDTH).print(_table(comparison))
    what = ((options.json, "the numbers, also of each person"), (options.figure, "the differences"))
    for path, content in what:
        if path is not None:
            print(f"{path}: {content}")


def _require_different(posteriors: tuple[Path, ...]) -> None:
    """Refuse a posterior that is given twice, whose difference to itself says nothing."""
    from mirror_ppl.inference.results.posterior_file import posterior_at

    seen = set()
    for path in posteriors:
        real = os.path.realpath(posterior_at(path))
        if real in seen:
            raise OptionError(f"{path} is given twice")
        seen.add(real)


def _check_outputs(options: Options) -> None:
    from mirror_ppl.files import require_files_of_their_own
    from mirror_ppl.inference.results.posterior_file import posterior_at

    inputs = {"a posterior": [posterior_at(path) for path in options.posteriors]}
    require_files_of_their_own({"--json": options.json, "--figure": options.figure}, inputs)


def _table(comparison: Comparison | EvidenceComparison) -> Table:
    from mirror_ppl.evaluation.comparison import Comparison

    if isinstance(comparison, Comparison):
        return _predictions(comparison)
    return _evidences(comparison)


def _predictions(comparison: Comparison) -> Table:
    from rich.text import Text

    left_out = comparison.by == "loo"
    rounds = comparison.models[0].total.rounds
    measured = f"leave-one-out, {rounds} rounds" if left_out else f"{rounds} held-out rounds"
    caption = "nats an action, higher is better; difference: to the best, ± standard error, paired"
    caption += (
        " over rounds; weight: of each in the mixture that predicts best, which a few rounds "
    )
    caption += "more may change where differences are within errors"
    if left_out:
        caption += "; doubtful: rounds whose estimate rests on few draws (Pareto k too high)"
        if any(4 * (model.total.doubtful or 0) > rounds for model in comparison.models):
            caption += ", here many: compare held-out rounds in their place (--by heldout)"
    columns = "log density", "difference", *(["doubtful"] if left_out else []), "weight"
    table = _empty(comparison, measured, caption, columns)
    for rank, model in enumerate(comparison.models, 1):
        score = model.total
        error = "" if score.difference_se is None else f" ±{score.difference_se:.4f}"
        table.add_row(
            f"{rank}",
            Text(model.label),
            f"{score.log_density:z.4f}",
            # The best has no difference to itself, nor any error of it.
            "-" if rank == 1 else f"{score.difference:z.4f}{error}",
            *([] if score.doubtful is None else [f"{score.doubtful} of {score.rounds}"]),
            f"{model.weight:.2f}",
        )
    return table


def _evidences(comparison: EvidenceComparison) -> Table:
    from rich.text import Text

    from mirror_ppl.evaluation.evidence import prior_share

    caption = "log evidence: log marginal likelihood of what all people did, nats; difference: to "
    caption += "the best (log Bayes factor if all people follow one model), ± standard error of "
    caption += (
        "the estimate alone; share: of people who follow the model if each follows one, with "
    )
    mean, low, high = prior_share(len(comparison.models))
    caption += f"a 90% interval (before any data {mean:.2f} [{low:.2f}, {high:.2f}])"
    columns = "log evidence", "difference", "share of people"
    table = _empty(comparison, f"evidence, {sum(comparison.rounds)} rounds", caption, columns)
    for rank, model in enumerate(comparison.models, 1):
        low, high = model.share_interval
        table.add_row(
            f"{rank}",
            Text(model.label),
            f"{model.log_evidence:z.1f}",
            "-" if rank == 1 else f"{model.difference:z.1f} ±{model.difference_error:.1f}",
            f"{model.share:.2f} [{low:.2f}, {high:.2f}]",
        )
    return table


def _empty(
    comparison: Comparison | EvidenceComparison,
    measured: str,
    caption: str,
    columns: tuple[str, ...],
) -> Table:
    """A table without rows."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    attributes = comparison.attributes
    table = Table(
        # As text: names in square brackets are no markup.
        title=Text(
            f"{attributes.get('domain')}, {attributes.get('setting')}: {measured} of "
            f"{len(comparison.people)} people"
        ),
        caption=Text(caption),
        title_justify="left",
        caption_justify="left",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    table.add_column("", justify="right", no_wrap=True)
    table.add_column("model", overflow="fold")
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    return table
