"""How well implants are recovered and held-out actions predicted: the numbers of the pages.

For each population, number of training rounds and seed, ten simulated people are fitted. Printed
are, for each implant of which the truth is known, how many people's 90% interval holds it, and how
many posteriors are near: intervals of thresholds at most two bins wide, medians of probabilities
within a factor of 1.5 of the truth; the same in all; and the mean negative log-likelihood of
held-out actions with its floor.
"""

from __future__ import annotations

import argparse
from statistics import mean
from time import monotonic
from typing import Any

import torch

from mirror_ppl.domains import get_domain
from mirror_ppl.inference.engines import InferenceOptions
from mirror_ppl.inference.results.fitting import fit_people
from mirror_ppl.models.implants import sight_sites
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import simulate

FACTOR = 1.5


def bin_of(bins: tuple[float, ...], value: float) -> int:
    """Index of the sight bin that holds a distance."""
    return max(index for index, edge in enumerate(bins) if edge <= value)


def recovered(implant: dict[str, float], bins: tuple[float, ...] | None) -> tuple[bool, bool]:
    """Whether the 90% interval of an implant holds the truth, and whether it is near.

    Args:
        implant: of a summary.
        bins: of a threshold; ``None`` of a probability.
    """
    low, high, truth = (implant[key] for key in ("q05", "q95", "truth"))
    if bins is None:
        ratio = implant["median"] / truth
        return low <= truth <= high, 1 / FACTOR <= ratio <= FACTOR
    low, high, truth = (bin_of(bins, value) for value in (low, high, truth))
    return low <= truth <= high, high - low + 1 <= 2


def row(summary: dict[str, Any], bins: tuple[float, ...], thresholds: tuple[str, ...]) -> str:
    """One line of results."""
    people = summary["people"]
    first = people[0]["implants"]
    parts, total = [], [0, 0, 0]
    for site in (name for name in first if first[name]["truth"] is not None):
        own = bins if site in thresholds else None
        found = [recovered(person["implants"][site], own) for person in people]
        held, near = (sum(each) for each in zip(*found, strict=True))
        parts.append(f"{site.removeprefix('sight_').removeprefix('notices_')} {held:2d}/{near:2d}")
        total = [total[0] + held, total[1] + near, total[2] + len(found)]
    parts.append(f"all {total[0]}/{total[1]} of {total[2]}")
    nll = mean(person["test"]["nll"] for person in people)
    floor = mean(person["test"]["floor"] for person in people)
    accuracy = mean(person["test"]["accuracy"] for person in people)
    doubtful = sum((person.get("pareto_k") or 0.0) > 0.7 for person in people)  # noqa: PLR2004
    return (
        f"{'  '.join(parts)}  nll {nll:.3f}  floor {floor:.3f}  above {nll - floor:.3f}  "
        f"accuracy {accuracy:.3f}  k above .7: {doubtful}"
    )


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--domain", default="driving")
    parser.add_argument("--setting", help="default: the one in which people see less")
    parser.add_argument("--populations", nargs="+", default=["paper", "diverse"])
    parser.add_argument("--rounds", nargs="+", type=int, default=[20, 5, 1])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--self-model", help="weights; those that ship unless given")
    options = parser.parse_args()
    torch.set_num_threads(1)
    domain = get_domain(options.domain)
    setting = options.setting or domain.settings[-1]
    weights = options.self_model or shipped_weights(options.domain)
    self_model, _ = load_self_model(weights, options.domain)
    print("held/near: people whose 90% interval holds the truth / whose posterior is near it")
    for population in options.populations:
        for rounds in options.rounds:
            for seed in options.seeds:
                began = monotonic()
                recordings = simulate(options.domain, setting, population, 10, 40, seed)
                human = load_human_model(None, self_model)
                fit = fit_people(human, recordings, InferenceOptions(), seed, rounds)
                line = row(fit.summary, domain.reach_bins, sight_sites(domain))
                name = f"{population:8s} {rounds:2d} rounds, seed {seed}"
                print(f"{name}: {line}  {monotonic() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main()
