"""Recordings for the tests of demonstrations and their files."""

from functools import cache

import torch

from mirror_ppl.data import asset_path, load_demonstrations

NAN = float("nan")


def fields(lengths, names="abcdefgh", seed=0):
    """Arguments of Demonstrations: rounds of these lengths for each person, anything in padding."""
    g = torch.Generator().manual_seed(seed)
    P, B = len(lengths), max(1, *map(len, lengths))
    T = max([1, *(length for rounds in lengths for length in rounds)])
    padded = [list(rounds) + [0] * (B - len(rounds)) for rounds in lengths]

    def numbers(*shape):
        return torch.randn(P, B, *shape, generator=g)

    def below(end, *shape):
        return torch.randint(end, (P, B, *shape), generator=g)

    return {
        "domain": "driving",
        "setting": "fog",
        "people": tuple(names[:P]),
        "ego": numbers(T + 1, 1),
        "observations": {"visual": numbers(T + 1, 4, 2), "verbal": numbers(T + 1, 4, 3)},
        "actions": below(2, T),
        "round_counts": torch.tensor([len(rounds) for rounds in lengths]),
        "lengths": torch.tensor(padded),
        "told": {"visual": below(2, T, 4), "verbal": below(2, T, 4)},
        "rewards": numbers(T),
        "scenarios": below(8),
        "truth": {"reach": torch.randn(P, generator=g), "bias": torch.full((P,), NAN)},
        "action_entropy": 0.69 * torch.rand(P, B, T, generator=g),
        "provenance": {"command": "test", "seed": 3, "temperature": 0.1},
    }


loaded = cache(load_demonstrations)


def shipped(domain, setting, people, rounds, population="paper"):
    """Recordings that ship: to simulate others takes long on the highway."""
    every = loaded(asset_path(f"{domain}_{setting}_{population}.nc"))
    return every.select_people(range(people)).select_rounds(range(rounds))


RAGGED = [[3, 1], [], [2, 4, 1]]


def put(path, index, value):
    """A change of one entry (index) or of a whole field (index None) of the arguments."""

    def change(arguments):
        place = arguments
        for key in path[:-1]:
            place = place[key]
        if index is None:
            place[path[-1]] = value
        else:
            place[path[-1]] = place[path[-1]].double()
            place[path[-1]][index] = value

    return change
