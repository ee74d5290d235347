"""Global random states."""

import torch

from mirror_ppl.randomness import forked, seed_everything


def test_seeding_gives_the_numbers_that_torch_gives_and_keeps_nothing():
    with forked():
        torch.manual_seed(7)
        expected = torch.rand(3), torch.randint(100, (3,))
        kept = len(torch.cuda._queued_calls)
        seed_everything(7)
        assert torch.equal(torch.rand(3), expected[0])
        assert torch.equal(torch.randint(100, (3,)), expected[1])
    if not torch.cuda.is_available():
        assert len(torch.cuda._queued_calls) == kept
