"""Best return of the drone of docs/examples/delivery.py, to compare its robot with.

    python -m benchmarks.delivery

All courses on the grid of controls, for as many steps as can still gain, of 400 resets. The tree
moves as the pad does, so of all ways to a place of the pad only the best is followed.
"""

from __future__ import annotations

import itertools

import numpy as np

from mirror_ppl.domains.registry import load_world

RESETS, STEPS = 400, 5
MOVES = np.array(list(itertools.product((-2.0, 0.0, 2.0), repeat=2)))


def best(pad: np.ndarray, tree: np.ndarray, horizon: int) -> float:
    """Return the best return of a round, from places ``[2]`` of pad and tree."""
    pads, apart, earned = pad[None], tree - pad, np.zeros(1)
    found = -0.2 * horizon  # never landing
    for _ in range(STEPS):
        pads = (pads[:, None] - MOVES).reshape(-1, 2)
        landed = np.hypot(*pads.T) < 1
        hit = np.hypot(*(pads + apart).T) < 1
        earned = np.repeat(earned, len(MOVES)) + 4.0 * landed - 3.0 * hit - 0.2
        found = max([found, *earned[landed]])
        pads, earned = pads[~landed], earned[~landed]
        order = np.argsort(-earned, kind="stable")
        _, first = np.unique(pads[order].round(3), axis=0, return_index=True)
        pads, earned = pads[order][first], earned[order][first]
    return float(found)


def main() -> None:
    """Print the mean over resets, and its standard error."""
    world = load_world("docs/examples/delivery.py:Delivery")
    env = world.make()
    each = []
    for seed in range(RESETS):
        env.reset(seed=seed)
        each.append(best(env.unwrapped.pad, env.unwrapped.tree, world.horizon))
    print(f"{np.mean(each):.2f} +- {np.std(each) / RESETS**0.5:.2f}")


if __name__ == "__main__":
    main()
