"""What makes the posterior robust to people who take things for granted: an ablation.

The human model is fitted to simulated people with pieces of it taken away. `held` counts the people
whose 90% interval holds the true threshold, over all four directions.
"""

from __future__ import annotations

import argparse

import torch

from benchmarks.recovery import row
from mirror_ppl.domains import get_domain
from mirror_ppl.inference.engines import InferenceOptions
from mirror_ppl.inference.results.fitting import fit_people
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.implants import perceptual_implants, policy_implants, sight_sites
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import simulate

NEVER = 1e-6


class Ablated(HumanModel):
    """The human model with other priors."""

    assumption_probability = 0.5
    lapse = 1 / 31

    def prior(self) -> dict[str, torch.Tensor]:
        """The usual sites under the priors of the class."""
        like = next(self.self_model.parameters())
        sight = perceptual_implants(self.domain, like, self.assumption_probability)
        return sight | policy_implants(self.domain, self.self_model.latent, like, self.lapse)


class NoLapse(Ablated):
    """Every action follows from the belief."""

    lapse = NEVER


class NothingTaken(Ablated):
    """Nothing is taken for granted: the unseen is unknown to people, as it is to the robot."""

    assumption_probability = NEVER


class Neither(Ablated):
    """No lapses, and nothing taken for granted."""

    lapse = NEVER
    assumption_probability = NEVER


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--populations", nargs="+", default=["paper", "diverse"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 2])
    options = parser.parse_args()
    torch.set_num_threads(1)
    self_model, _ = load_self_model(shipped_weights("driving"))
    domain = get_domain("driving")
    for population in options.populations:
        for seed in options.seeds:
            recordings = simulate("driving", "fog", population, 10, 40, seed)
            for model in (Ablated, NoLapse, NothingTaken, Neither):
                fit = fit_people(model(self_model), recordings, InferenceOptions(), seed)
                line = row(fit.summary, domain.reach_bins, sight_sites(domain))
                print(f"{population:8s} seed {seed} {model.__name__:16s}: {line}", flush=True)


if __name__ == "__main__":
    main()
