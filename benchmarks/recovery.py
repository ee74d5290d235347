"""How well implants are recovered and held-out actions predicted: the numbers of the README.

For each population, number of training rounds and seed, ten simulated people are fitted. Printed
are, for each threshold, how many people's 90% interval holds the truth and how many intervals are
at most two bins wide; and the mean negative log-likelihood of held-out actions with its floor.
"""

from __future__ import annotations

import argparse
from statistics import mean
from time import monotonic
from typing import Any

import torch

from mirror_ppl.domains import get_domain
from mirror_ppl.inference.fitting import fit_people
from mirror_ppl.inference.guides import InferenceOptions
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.implants import sight_sites
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import simulate


def bin_of(bins: tuple[float, ...], value: float) -> int:
    """Index of the sight bin that holds a distance."""
    return max(index for index, edge in enumerate(bins) if edge <= value)


def row(summary: dict[str, Any], bins: tuple[float, ...], sites: tuple[str, ...]) -> str:
    """One line of results."""
    people = summary["people"]
    parts = []
    for site in sites:
        held = narrow = 0
        for person in people:
            implant = person["implants"][site]
            low, high, truth = (bin_of(bins, implant[key]) for key in ("q05", "q95", "truth"))
            held += low <= truth <= high
            narrow += high - low + 1 <= 2
        parts.append(f"{site.removeprefix('sight_')} {held:2d}/{narrow:2d}")
    nll = mean(person["test"]["nll"] for person in people)
    floor = mean(person["test"]["floor"] for person in people)
    accuracy = mean(person["test"]["accuracy"] for person in people)
    return (
        f"{'  '.join(parts)}  nll {nll:.3f}  floor {floor:.3f}  above {nll - floor:.3f}  "
        f"accuracy {accuracy:.3f}"
    )


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--setting", default="fog")
    parser.add_argument("--populations", nargs="+", default=["paper", "diverse"])
    parser.add_argument("--rounds", nargs="+", type=int, default=[20, 5, 1])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    options = parser.parse_args()
    torch.set_num_threads(1)
    self_model, _ = load_self_model(shipped_weights("driving"))
    human = HumanModel(self_model)
    domain = get_domain("driving")
    print("held/narrow: people whose 90% interval holds the truth / is at most two bins wide")
    for population in options.populations:
        for rounds in options.rounds:
            for seed in options.seeds:
                began = monotonic()
                recordings = simulate("driving", options.setting, population, 10, 40, seed)
                fit = fit_people(human, recordings, InferenceOptions(), seed, rounds)
                line = row(fit.summary, domain.reach_bins, sight_sites(domain))
                name = f"{population:8s} {rounds:2d} rounds, seed {seed}"
                print(f"{name}: {line}  {monotonic() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main()
