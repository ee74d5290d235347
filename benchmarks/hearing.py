"""Whether recordings with messages identify drivers whom messages do not reach: for docs/trust.md.

    python -m benchmarks.hearing --seeds 0 1 2 3

Drivers in fog whose channels reach them or not, each with probability one half; other implants are
from the prior of ``hard-of-hearing``. At each step each item that may be communicated is so with
probability .1. Fitted to 20 rounds are ``hard-of-hearing`` and ``mirror``, which takes all messages
for heard. This writes a row for each driver to docs/results/hearing.csv; seeds that are there are
not done again. The table of all rows is printed.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch

import mirror_ppl
from benchmarks._rows import rows_in
from mirror_ppl.models.family import HardOfHearing
from mirror_ppl.models.implants import reach, sight_sites
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.weights import load_self_model, shipped_weights

ROWS = Path(__file__).parents[1] / "docs/results/hearing.csv"
PEOPLE, ROUNDS, TOLD = 5, 20, 0.1


def measured(human: HardOfHearing, seed: int) -> list[dict[str, str]]:
    """Return a row for each driver of a seed."""
    implants = {name: value[0] for name, value in draw_prior(human, PEOPLE, 1, seed).items()}
    generator = torch.Generator().manual_seed(seed)
    recordings = play_rounds(human, implants, ROUNDS, "fog", generator, told=TOLD)
    fits = {
        name: mirror_ppl.infer(
            recordings,
            human=name,
            seed=seed,
            engine="importance",
            train_rounds=ROUNDS,
            explore=0,
        )
        for name in ("hard-of-hearing", "mirror")
    }
    sites, hears = sight_sites(human.domain), [m.name for m in human.domain.modalities]
    truth = reach(human.domain, implants)[:, 0]
    rows = []
    for person in range(PEOPLE):
        own = {name: fit.summary["people"][person] for name, fit in fits.items()}
        row = {"seed": str(seed), "person": recordings.people[person]}
        draws = fits["hard-of-hearing"].data["posterior"].isel(person=person)
        for channel in hears:
            site = f"hears_{channel}"
            row[site] = str(int(implants[site][person]))
            row[f"p_{site}"] = f"{float(draws[site].mean()):.3f}"
        evidence = [own[name]["log_evidence"] for name in ("hard-of-hearing", "mirror")]
        row["log_bayes_factor"] = f"{evidence[0] - evidence[1]:.2f}"
        for name, fitted in own.items():
            held = (
                fitted["implants"][site]["q05"] <= float(value) <= fitted["implants"][site]["q95"]
                for site, value in zip(sites, truth[person], strict=True)
            )
            row[f"held_by_{name}"] = str(sum(held))
        rows.append(row)
    return rows


def table(rows: Sequence[dict[str, str]]) -> str:
    """Return the table of docs/trust.md."""
    channels = [name.removeprefix("p_") for name in rows[0] if name.startswith("p_")]
    each = [(row[name] == "1", float(row[f"p_{name}"])) for row in rows for name in channels]
    sure = [(reaches, p) for reaches, p in each if abs(p - 0.5) > 0.45]
    hears = [all(row[name] == "1" for name in channels) for row in rows]
    favours = [float(row["log_bayes_factor"]) > 0 for row in rows]
    pairs = list(zip(hears, favours, strict=True))
    held = {
        name: sum(int(row[f"held_by_{name}"]) for row in rows)
        for name in ("hard-of-hearing", "mirror")
    }

    def right(some: Sequence[tuple[bool, float]]) -> int:
        return sum(reaches == (p > 0.5) for reaches, p in some)

    counts = {
        "channels of which the more probable answer is right": (right(each), len(each)),
        "the same, of channels with a probability above .95 or below .05": (right(sure), len(sure)),
        "drivers with a channel that does not reach them, for whom `hard-of-hearing` is more "
        "probable than `mirror`": (sum(not a and b for a, b in pairs), len(rows) - sum(hears)),
        "drivers whom both reach, for whom `mirror` is more probable": (
            sum(a and not b for a, b in pairs),
            sum(hears),
        ),
        **{
            f"thresholds held by 90% intervals of `{name}`": (count, 4 * len(rows))
            for name, count in held.items()
        },
    }
    lines = [f"| {name} | {count} of {number} |" for name, (count, number) in counts.items()]
    return "\n".join(["| Count | |", "|---|---|", *lines])


def main() -> None:
    """Measure the seeds that are missing, and print the summary."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=[], help="of drivers and rounds")
    given = parser.parse_args()
    torch.set_num_threads(1)
    human = HardOfHearing(load_self_model(shipped_weights("driving"))[0])
    rows = rows_in(ROWS) if ROWS.exists() else []
    for seed in given.seeds:
        if str(seed) not in {row["seed"] for row in rows}:
            rows = rows_in(ROWS, rows + measured(human, seed))
            print(f"seed {seed} is done", flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
