"""Sums that the marginalization of attention is made of, against those of torch."""

import torch

from mirror_ppl.likelihood.chain import NEVER, _later, log_sums


def test_later_values_are_exact_far_into_the_tail():
    own = torch.tensor([[-0.1, -40.0, -300.0, -600.0, -601.0], [-5.0, -0.1, -4.0, NEVER, NEVER]])
    expected = own.double().flip(-1).logcumsumexp(-1).flip(-1)
    found = _later(own)
    torch.testing.assert_close(found[0], expected[0].float())
    torch.testing.assert_close(found[1, :3], expected[1, :3].float())
    assert found.isfinite().all() and (found[1, 3:] < -600).all()


def test_sums_in_groups_are_those_of_torch_with_gradients():
    values = 30 * torch.randn(40, 6, generator=torch.Generator().manual_seed(0))
    groups = torch.arange(40) // 7
    one, other = (values.clone().requires_grad_() for _ in range(2))
    found = log_sums(one, groups, 6)
    expected = torch.stack([other[groups == group].logsumexp(0) for group in range(6)])
    torch.testing.assert_close(found, expected)
    found.sum().backward()
    expected.sum().backward()
    torch.testing.assert_close(one.grad, other.grad, atol=1e-6, rtol=1e-4)
