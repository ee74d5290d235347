"""How much of a fit's time the matrix products that it makes would take alone.

    python -m benchmarks.floor

Ten people of each world are fitted by the default engine in one process with one thread, as
`mirror_ppl.fit --explore 0` does without files and pictures. Printed are processor seconds, the
operations of all matrix products (of a second run that counts them), the seconds that these would
take at the rate of a product of the size that beliefs are inferred in, and the ratio.
"""

from __future__ import annotations

from time import process_time

import torch
from torch.utils.flop_counter import FlopCounterMode

import mirror_ppl
from mirror_ppl.data import Demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.models.belief_tracking import CHUNK

WIDTH, REPEATS = 128, 200
WORLDS = "driving", "search_rescue", "bomb_defusal"


def rate() -> float:
    """Operations a second in products of `CHUNK` beliefs with a layer of a network."""
    beliefs, layer = torch.randn(CHUNK, WIDTH), torch.randn(WIDTH, WIDTH)
    beliefs @ layer
    began = process_time()
    for _ in range(REPEATS):
        beliefs @ layer
    return 2 * REPEATS * CHUNK * WIDTH * WIDTH / (process_time() - began)


def fit(recordings: Demonstrations) -> None:
    """Fit as the command does."""
    mirror_ppl.infer(recordings, train_rounds=20, explore=0, jobs=1)


def main() -> None:
    """Measure and print the table."""
    torch.set_num_threads(1)
    print("| Ten people, 20 rounds | processor s | operations, 10⁹ | floor, s | ratio |")
    print("|---|---|---|---|---|")
    for world in WORLDS:
        recordings = mirror_ppl.load_recordings(
            domain=world, setting=get_domain(world).settings[-1]
        )
        fit(recordings.select_people(recordings.people[:1]))  # imports
        began = process_time()
        fit(recordings)
        seconds = process_time() - began
        with FlopCounterMode(display=False) as counter:
            fit(recordings)
        operations = counter.get_total_flops()
        floor = operations / rate()
        print(
            f"| {world} | {seconds:.1f} | {operations / 1e9:.1f} | {floor:.2f} "
            f"| {seconds / floor:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
