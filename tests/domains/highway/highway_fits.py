"""Fits of a shipped driver with few draws, of a robot with untrained networks."""

import warnings

from example_rounds import first_steps

import mirror_ppl
from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.errors import UnreliableWeights


def quick_fit(human, steps):
    """A fit to the first steps of one round, with another one held out."""
    rounds = load_demonstrations(asset_path("highway_fog_diverse.nc")).select_people([0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnreliableWeights)
        return mirror_ppl.infer(
            first_steps(rounds.select_rounds(range(2)), steps),
            human=human,
            engine="importance",
            settings={"proposals": 64, "enough": 16},
            draws=16,
            train_rounds=1,
            explore=0,
        )
