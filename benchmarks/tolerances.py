"""What giving up and merging views costs: the same fit with and without, compared.

Printed is, for each threshold, the total variation distance between the two posteriors' marginals,
averaged over people. The last column is the same distance between two fits that differ in nothing
but their random numbers: what is not above it is noise.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

from mirror_ppl.domains import get_domain
from mirror_ppl.inference.adaptive_importance import ImportanceOptions
from mirror_ppl.inference.engines import InferenceOptions
from mirror_ppl.inference.results.fitting import Fit, fit_people
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.implants import sight_sites
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import simulate


def marginal(fit: Fit, site: str, bins: int) -> Tensor:
    """Share ``[P, n]`` of draws in each bin."""
    draws = fit.posterior.draws[site][..., 0]
    return torch.nn.functional.one_hot(draws, bins).double().mean(0)


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--populations", nargs="+", default=["paper", "diverse"])
    parser.add_argument("--people", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args()
    torch.set_num_threads(1)
    self_model, _ = load_self_model(shipped_weights("driving"))
    human = HumanModel(self_model)
    bins = len(get_domain("driving").reach_bins)
    usual = InferenceOptions("importance", 800)
    careful = InferenceOptions(
        "importance",
        800,
        settings=ImportanceOptions(prune_margin=40.0, resolution=0.0),
        screening=Screening(margin=40.0, resolution=0.0),
    )
    for population in options.populations:
        recordings = simulate("driving", "fog", population, options.people, 40, 0)

        default = fit_people(human, recordings, usual, 0, options.rounds)
        other = fit_people(human, recordings, usual, 1, options.rounds)
        strict = fit_people(human, recordings, careful, 0, options.rounds)
        print(population)
        for site in sight_sites(human.domain):
            reference = marginal(default, site, bins)
            distances = [
                float((reference - marginal(another, site, bins)).abs().sum(-1).mean() / 2)
                for another in (strict, other)
            ]
            print(f"  {site:20s} {distances[0]:.3f}  noise {distances[1]:.3f}", flush=True)


if __name__ == "__main__":
    main()
