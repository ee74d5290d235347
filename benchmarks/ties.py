"""How far a robot's values separate actions that are equally good, in units of choices.

    python -m benchmarks.ties

Rounds are played with one random action in five. At each decision with several actions that are
exactly the best for an observer with some view, the robot's values of these actions differ by
errors of its network; choices multiply this by the person's consistency. A model of a person takes
a difference of .05 or more for evidence about sight and choices. Consistency is the mean over the
posterior of ten simulated people (20 rounds, seed 0, the setting in which they see most), of whom
the median is taken. The table of docs/self_model.md is printed.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from torch import Tensor

import mirror_ppl
from mirror_ppl.domains import get_domain
from mirror_ppl.domains.base import roll_out
from mirror_ppl.evaluation.self_model import TIE, exact_values, robot_values, views_of
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.training.experience import drive

WORLDS = "driving", "search_rescue", "bomb_defusal"
ROUNDS, DISCOUNT, EPSILON = 400, 0.9, 0.2
AIM = 0.05


def separations(exact: Tensor, values: Tensor) -> np.ndarray:
    """Range of the robot's values ``[n]`` of the best actions, where these are several.

    Args:
        exact: exact action values ``[..., A]``.
        values: the robot's values ``[..., A]``.
    """
    best = exact >= exact.amax(-1, keepdim=True) - TIE
    high = values.masked_fill(~best, -torch.inf).amax(-1)
    low = values.masked_fill(~best, torch.inf).amin(-1)
    return (high - low)[best.sum(-1) > 1].numpy()


def consistency(world: str) -> float:
    """Median over ten people of the posterior mean of consistency."""
    recordings = mirror_ppl.load_recordings(domain=world, setting=get_domain(world).settings[0])
    fit = mirror_ppl.infer(recordings, train_rounds=20, explore=0, jobs=-1)
    return float(fit.posterior.draws["consistency"].mean(0).median())


@torch.no_grad()
def lines(world: str, seed: int) -> list[str]:
    """Rows of the table of a world."""
    self_model, _ = load_self_model(shipped_weights(world), world)
    domain = self_model.domain.as_believed
    generator = torch.Generator().manual_seed(seed)
    start = domain.initial(ROUNDS, generator)
    factor, found = consistency(world), []
    for name, plan in views_of(domain, ROUNDS, generator).items():
        if not domain.settled and name not in ("full", "clear"):
            continue
        actions = drive(self_model, start, plan, domain.horizon, generator, epsilon=EPSILON)
        under_way = ~domain.over(roll_out(domain, start, actions))[:, :-1]
        exact = exact_values(domain, start, actions, plan, DISCOUNT)[under_way]
        apart = separations(exact, robot_values(self_model, start, actions, plan)[under_way])
        share, times = len(apart) / len(exact), factor * apart
        cells = ["", "", "", ""]
        if len(apart):
            numbers = apart.mean(), times.mean(), np.quantile(times, 0.9)
            cells = [f"{number:.3f}" for number in numbers] + [f"{100 * (times < AIM).mean():.0f}%"]
        found.append(f"| {world}, {name} | {factor:.1f} | {100 * share:.0f}% | {' | '.join(cells)} |")
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", nargs="*", default=WORLDS, help="worlds with exact values")
    parser.add_argument("--seed", type=int, default=3, help="of the rounds")
    given = parser.parse_args()
    print(
        "| World, view | Consistency | Decisions with equally good actions | Difference of the "
        f"robot's values, mean | times consistency, mean | 90% below | below {AIM} |"
    )
    print(f"|{'---|' * 7}")
    for world in given.worlds:
        print(*lines(world, given.seed), sep="\n", flush=True)


if __name__ == "__main__":
    main()
