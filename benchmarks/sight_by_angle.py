r"""Two priors of how far highway drivers see: four thresholds, or a smooth function of the angle.

    python -m benchmarks.sight_by_angle --people 10

Drivers of seed 0 in fog, 20 rounds to learn from and six held out, are fitted with the human models
`mirror` and `by-angle`. This writes a row for each driver and model to
docs/results/sight_by_angle.csv; those that are there are not done again. Without `--people` it
prints the table of docs/highway.md.

`log_evidence` is of the likelihood that fits use, in which a decision counts a quarter
(`likelihood_power`), so differences are conservative.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from statistics import mean, stdev
from time import process_time

import torch

from benchmarks._rows import rows_in
from mirror_ppl.data import Demonstrations, asset_path, load_demonstrations
from mirror_ppl.domains.highway.human_variants import LOG_REACH, reach_in_bins
from mirror_ppl.domains.highway.world import DIRECTION_OF, KNOTS
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.results.posterior_predictive import (
    chosen_log_probability,
    predict_rounds,
)
from mirror_ppl.models.implants import sight_sites
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.weights import load_self_model, shipped_weights

ROWS = Path(__file__).parents[1] / "docs/results/sight_by_angle.csv"
MODELS = "mirror", "by-angle"
LEARNED, HELD_OUT = range(20), range(30, 36)


def measured(name: str, self_model: SelfModel, one: Demonstrations) -> dict[str, str]:
    """Return the row of a human model and the recordings of one driver."""
    human, began = load_human_model(name, self_model), process_time()
    found = infer(human, one.select_rounds(LEARNED), InferenceOptions("importance"), 0)
    seconds, draws = process_time() - began, found.draws
    assert found.log_evidence is not None and found.evidence_error is not None
    assert found.pareto_k is not None
    test = one.select_rounds(HELD_OUT)
    chosen = chosen_log_probability(predict_rounds(human, test, draws), test)[:, test.mask]
    mixed = chosen.logsumexp(0) - math.log(len(chosen))
    bins, sites = torch.tensor(KNOTS), sight_sites(human.domain)
    if LOG_REACH in draws:
        reach = reach_in_bins(draws[LOG_REACH][:, 0, 0])
    else:
        each = torch.stack([bins[draws[site][:, 0, 0]] for site in sites], -1)
        reach = each[:, list(DIRECTION_OF)]
    true = torch.stack([one.truth[site][0] for site in sites])[list(DIRECTION_OF)]
    low, high = torch.quantile(reach, torch.tensor([0.05, 0.95]), 0)
    return {
        "person": one.people[0],
        "human_model": name,
        "log_evidence": f"{float(found.log_evidence[0]):.3f}",
        "evidence_error": f"{float(found.evidence_error[0]):.3f}",
        "pareto_k": f"{float(found.pareto_k[0]):.2f}",
        "nll": f"{float(-mixed.mean()):.4f}",
        "sectors_held": f"{int(((low <= true) & (true <= high)).sum())}",
        "width": f"{float((high - low).mean()):.2f}",
        "seconds": f"{seconds:.0f}",
    }


def table(rows: Sequence[dict[str, str]]) -> str:
    """Return the table of the page; differences are of pairs of the same driver."""
    lines = [
        "| Prior of sight | Log evidence, above four thresholds | Held-out NLL, nats an action | "
        "90% intervals hold the truth, of 36 sectors | Mean width, m | Pareto *k* above .7 |",
        "|---" * 6 + "|",
    ]
    found = {(row["person"], row["human_model"]): row for row in rows}
    for name in MODELS:
        own = [row for (_, model), row in found.items() if model == name]
        more = [
            float(row["log_evidence"]) - float(found[row["person"], MODELS[0]]["log_evidence"])
            for row in own
        ]
        error = stdev(more) / math.sqrt(len(more)) if len(more) > 1 else math.nan
        gain = f"{mean(more):.1f} ± {error:.1f}" if name != MODELS[0] else ""
        wide = sum(float(row["pareto_k"]) > 0.7 for row in own)
        cells = [
            f"`{name}`",
            gain,
            f"{mean(float(row['nll']) for row in own):.3f}",
            f"{mean(float(row['sectors_held']) for row in own):.1f}",
            f"{mean(float(row['width']) for row in own):.1f}",
            f"{wide} of {len(own)}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Measure the drivers that are missing, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--people", type=int, default=0, help="number of drivers, at most ten")
    number = parser.parse_args().people
    torch.set_num_threads(1)
    rows = rows_in(ROWS) if ROWS.exists() else []
    done = {(row["person"], row["human_model"]) for row in rows}
    self_model, _ = load_self_model(shipped_weights("highway"))
    recordings = load_demonstrations(asset_path("highway_fog_diverse.nc"))
    for person in recordings.people[:number]:
        for name in MODELS:
            if (person, name) not in done:
                rows.append(measured(name, self_model, recordings.select_people([person])))
                rows_in(ROWS, rows)
                print(rows[-1], flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
