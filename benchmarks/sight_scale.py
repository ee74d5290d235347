r"""How strongly the prior should tie drivers' reaches to the sides to those straight on.

    python -m mirror_ppl.simulate --domain highway --setting fog --population diverse \
        --people 12 --rounds 26 --seed 100 --out runs/highway_100.nc
    python -m mirror_ppl.fit --demos runs/highway_100.nc --train-rounds 20 --explore 0 \
        --out runs/highway_100
    python -m benchmarks.sight_scale runs/highway_100

The last command writes docs/results/sight_scale.csv; without a folder it prints what is there.

Log Bayes factors of other values of `Record.sight_scale` against the highway's, for all drivers of
a fit together: ``log mean_s p(reach_s | other scale) / p(reach_s | scale)`` over draws. Those of
larger scales, and of none, are too low if draws leave out what only they make probable.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import arviz as az
import numpy as np
import torch

from benchmarks._rows import rows_in
from mirror_ppl.domains.highway import Highway
from mirror_ppl.models.implants import alike, sight_sites

ROWS = Path(__file__).parents[1] / "docs/results/sight_scale.csv"
SCALES = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 4.0, math.inf)


def log_bayes_factors(path: Path, scale: float) -> np.ndarray:
    """Return log Bayes factors ``[P]`` of a scale against the highway's own.

    Args:
        path: of a posterior of highway drivers under the highway's own scale.
        scale: number of bins; infinite for a uniform prior.
    """
    world, bins = Highway(), np.array(Highway.reach_bins)
    assert world.record.sight_scale is not None
    own = alike(len(bins), world.record.sight_scale)
    ratio = (alike(len(bins), scale) / own).log().double()
    draws = az.from_netcdf(path)["posterior"]
    reach = [
        torch.tensor(np.abs(draws[site].values[0][..., None] - bins).argmin(-1))
        for site in sight_sites(world)
    ]  # each [S, P]
    total = torch.stack(
        [
            ratio[reach[first], reach[place]]
            for first, *others in world.direction_groups
            for place in others
        ]
    ).sum(0)
    return (total.logsumexp(0) - math.log(len(total))).numpy()


def main() -> None:
    """Write the rows of a fit, if one is given, and print a row for each scale."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", nargs="?", type=Path, help="folder of a fit")
    folder = parser.parse_args().folder
    new = [
        {"scale": f"{scale:g}", "person": str(person), "log_bayes_factor": f"{factor:.4f}"}
        for scale in SCALES * bool(folder)
        for person, factor in enumerate(log_bayes_factors(folder / "posterior.nc", scale), 1)
    ]
    rows = [(float(row["scale"]), float(row["log_bayes_factor"])) for row in rows_in(ROWS, new)]
    for scale in dict.fromkeys(scale for scale, _ in rows):
        own = [factor for other, factor in rows if other == scale]
        print(f"scale {scale:4g}: {sum(own):6.2f}  (lowest {min(own):.2f})")


if __name__ == "__main__":
    main()
