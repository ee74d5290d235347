"""What networks read at each step, kept once for all steps at which it is the same."""

import torch

from mirror_ppl.baselines.inputs import StepInputs


def some_inputs(generator, rounds, steps):
    """Few different rows, other ones and more of them for the second person."""
    rows = torch.randn(2, 4, 3, generator=generator)
    rows[0, 2:] = rows[0, 0]
    place = torch.randint(4, (2, rounds, steps), generator=generator)
    return torch.stack([own[which] for own, which in zip(rows, place, strict=True)])


def test_different_rows_are_kept_once(generator):
    inputs = some_inputs(generator, 5, 7)
    found = StepInputs.of(inputs)
    assert torch.equal(found.steps, inputs)
    assert found.rows.shape == (2, 4, 3)
    assert [len(own.unique()) for own in found.place] == [2, 4]


def test_rounds_beside_others(generator):
    one, other = some_inputs(generator, 2, 7), some_inputs(generator, 3, 5)
    for first, second in ((one, other), (other, one)):
        found = StepInputs.of(first).beside(StepInputs.of(second)).steps
        rounds, steps = first.shape[1], first.shape[2]
        assert found.shape == (2, 5, 7, 3)
        assert torch.equal(found[:, :rounds, :steps], first)
        assert torch.equal(found[:, rounds:, : second.shape[2]], second)
