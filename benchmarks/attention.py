"""How much likelihoods of people move with the values that stand for all they may attend to.

    python -m benchmarks.attention

Rounds of people of the model ``per-item`` are gone through again and again, each time with other
values of attention. Of twelve people near each truth, the standard deviation over repetitions is
told of log-likelihood ratios to their mean, and of that mean itself, in nats of ten rounds.
"""

from __future__ import annotations

import argparse
from time import perf_counter

import torch
from torch import Tensor

from mirror_ppl.inference.calibration.study import prior_people
from mirror_ppl.likelihood import view_table_builder as builder
from mirror_ppl.likelihood.enumeration import log_joints
from mirror_ppl.likelihood.round_views import Rounds
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.prior import Draws, draw_prior
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.variants import PerItem
from mirror_ppl.models.weights import load_self_model, shipped_weights

NEAR = 12
"""People near each truth."""
WIDTH = 0.3
"""How far from it, in logarithms."""


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--people", type=int, default=6)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--repeats", type=int, default=6)
    options = parser.parse_args()
    torch.set_num_threads(1)
    human = PerItem(load_self_model(shipped_weights("driving"))[0])
    generator = torch.Generator().manual_seed(0)
    people = prior_people(human, options.people, generator)
    recordings = play_rounds(human, people, options.rounds, "fog", generator)
    print("values  kept  ratios  mean  seconds")
    for values, kept in ((64, 64), (256, 256), (512, 512), (512, 96), (1024, 96)):
        builder.KEPT = kept
        found, began = [], perf_counter()
        for person in range(options.people):
            near = _near({name: value[person] for name, value in people.items()}, human, generator)
            scores = [
                _scores(human, rounds_of(recordings, person), near, values, again)
                for again in range(options.repeats)
            ]
            found.append(torch.stack(scores))
        seconds = (perf_counter() - began) / options.people / options.repeats
        scores = torch.stack(found)  # [people, repeats, NEAR]
        mean = scores.mean(-1, keepdim=True)
        ratio = (scores - mean).std(1).square().mean().sqrt()
        spread = mean.std(1).square().mean().sqrt()
        print(f"{values:6d}  {kept:4d}  {ratio:6.2f}  {spread:4.2f}  {seconds:7.2f}")


def _near(truth: Draws, human: PerItem, generator: torch.Generator) -> Draws:
    """People ``[NEAR, 1, 1, ...]`` like a person."""
    near = draw_prior(human, 1, NEAR, 0)
    for name, value in near.items():
        near[name] = truth[name].expand(value.shape).clone()
        if value.is_floating_point() and value.dim() == 3:  # noqa: PLR2004 - one number a person
            moved = torch.exp(WIDTH * torch.randn(value.shape, generator=generator))
            near[name] = near[name] * moved
            if name != "consistency":
                near[name] = near[name].clamp(max=0.98)
    return near


def _scores(human: PerItem, rounds: Rounds, near: Draws, values: int, again: int) -> Tensor:
    """Log-evidence ``[NEAR]``, with values of attention of their own."""
    seen = ViewTableBuilder(human, Screening(), likely=near, values=values)
    number = builder._number_of
    builder._number_of = lambda recorded: (number(recorded) + again * 7919) % 2**62
    seen.add(rounds)
    builder._number_of = number
    table = seen.table()
    policy = {name: value for name, value in near.items() if name not in table.sites}
    return log_joints(human, table, policy)[:, 0].logsumexp(-1)


if __name__ == "__main__":
    main()
