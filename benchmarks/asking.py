"""How long a posterior takes: a round more and asking again, and a person from nothing.

For each guide, in the same run: the median and the slowest over people of adding the n-th round and
asking for 200 draws again, and what all rounds take from nothing. Besides, how many of the proposed
draws count (effective draws) and how far marginals of thresholds are from those of ``importance``.
"""

from __future__ import annotations

import argparse
from time import perf_counter

import torch

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.inference.online import OnlinePosterior
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.implants import sight_sites
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.training.guide_file import load_guide, shipped_guide

DRAWS = 4000
"""For distances of marginals."""


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--people", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=21)
    parser.add_argument("--population", default="paper")
    options = parser.parse_args()
    torch.set_num_threads(1)
    human = HumanModel(load_self_model(shipped_weights("driving"))[0])
    network, _ = load_guide(shipped_guide("driving"), human)
    recordings = load_demonstrations(asset_path(f"driving_fog_{options.population}.nc"))
    seconds = {"amortized": [], "importance": []}
    marginals = {"amortized": [], "importance": []}
    worst = dict.fromkeys(seconds, 0.0)
    # The first asking of a process loads libraries.
    warm = OnlinePosterior(human, network)
    warm.add(recordings.select_people([0]).select_rounds([0]))
    warm.draws()
    for person in range(options.people):
        one = recordings.select_people([person])
        for name, guide in (("amortized", network), ("importance", None)):
            online, taken = OnlinePosterior(human, guide), []
            for number in range(options.rounds):
                began = perf_counter()
                online.add(one.select_rounds([number]))
                online.draws()
                taken.append(1000 * (perf_counter() - began))
            worst[name] = max(worst[name], online.pareto_k)
            draws = online.draws(DRAWS)
            bins = len(get_domain("driving").reach_bins)
            marginals[name].append(
                torch.stack(
                    [
                        torch.bincount(draws[site].flatten(), minlength=bins) / DRAWS
                        for site in sight_sites(human.domain)
                    ]
                )
            )
            began = perf_counter()
            whole = OnlinePosterior(human, guide)
            whole.add(one.select_rounds(range(options.rounds - 1)))
            whole.draws()
            seconds[name].append([*taken, 1000 * (perf_counter() - began)])
    for name, table in seconds.items():
        each = torch.tensor(table)
        print(f"{name}: ms for one round more and 200 draws, median over people (slowest)")
        for number in (1, 2, 3, 5, 8, 13, 21):
            if number <= options.rounds:
                column = each[:, number - 1]
                print(f"  round {number:2d}: {column.median():5.0f} ({column.max():.0f})")
        more = each[:, 1 : options.rounds]
        share = 100 * (more < 100).float().mean()  # noqa: PLR2004 - the bar
        print(f"  all rounds after the first: {more.median():.0f}, under 100 ms: {share:.0f}%")
        print(f"  {options.rounds - 1} rounds from nothing: {each[:, -1].median():.0f}")
        print(f"  largest Pareto k: {worst[name]:.2f}", flush=True)
    one, other = (torch.stack(marginals[name]) for name in seconds)
    distance = (one - other).abs().sum(-1) / 2
    print(f"marginals of thresholds: total variation {distance.mean():.3f}, at most ", end="")
    print(f"{distance.max():.3f}")


if __name__ == "__main__":
    main()
