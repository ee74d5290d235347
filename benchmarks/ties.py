"""How far values of a robot and of its human model separate actions that are equally good.

    python -m benchmarks.ties

Rounds are played with one random action in five. At each decision with several actions that are
exactly the best for an observer with some view, the robot's values of these actions differ by
errors of its network. Choices multiply what the human model leaves of these differences
(`Record.value_error`) by the person's consistency: a product of .05 or more is evidence where there
is none. Consistency is the mean over the posterior of ten simulated people (20 rounds, seed 0, the
setting in which they see most), of whom the median is taken. The table of docs/self_model.md is
printed.
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
from mirror_ppl.models.value_errors import beyond_errors
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.training.experience import drive
from mirror_ppl.training.self_model_options import SelfModelOptions

WORLDS = "driving", "search_rescue", "bomb_defusal"
ROUNDS, EPSILON = 400, 0.2
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
    discount = domain.record.training.get("discount", SelfModelOptions.discount)
    for name, plan in views_of(domain, ROUNDS, generator).items():
        if not domain.settled and name not in ("full", "clear"):
            continue
        actions = drive(self_model, start, plan, domain.horizon, generator, epsilon=EPSILON)
        under_way = ~domain.over(roll_out(domain, start, actions))[:, :-1]
        exact = exact_values(domain, start, actions, plan, discount)[under_way]
        values = robot_values(self_model, start, actions, plan)[under_way]
        apart = separations(exact, values)
        left = factor * separations(exact, beyond_errors(values, domain.record.value_error))
        cells = [f"{100 * len(apart) / len(exact):.0f}%", "", "", ""]
        if len(apart):
            cells[1:] = (f"{number:.3f}" for number in (apart.mean(), left.mean()))
            cells.append(f"{100 * (left < AIM).mean():.0f}%")
        found.append(f"| {world}, {name} | {factor:.1f} | {' | '.join(cells)} |")
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", nargs="*", default=WORLDS, help="worlds with exact values")
    parser.add_argument("--seed", type=int, default=3, help="of the rounds")
    given = parser.parse_args()
    print(
        "| World, view | Consistency | Decisions with equally good actions | Difference of the "
        "robot's values, mean | Of the human model's, times consistency, mean | of these below "
        f"{AIM} |"
    )
    print(f"|{'---|' * 6}")
    for world in given.worlds:
        print(*lines(world, given.seed), sep="\n", flush=True)


if __name__ == "__main__":
    main()
