"""Pooled logistic regression: its mode by its gradient, and what sharing does."""

from dataclasses import replace

import pytest
import torch
from example_rounds import alternate, anything, avoid, rounds_of

from mirror_ppl.baselines import LogisticOptions, fit_pooled_logistic
from mirror_ppl.baselines.logistic import _inputs, _mode
from mirror_ppl.baselines.training import mean_nll
from mirror_ppl.data import concatenate
from mirror_ppl.domains import get_domain
from mirror_ppl.domains.driving import SWITCH
from mirror_ppl.errors import DemonstrationsError, UnknownNameError


def parts(data, *ends):
    return [data.select_rounds(slice(*pair)) for pair in ends]


def group(rule, generator, people, rounds):
    return concatenate(
        [rounds_of(rule, generator, rounds, f"person {place}") for place in range(people)]
    )


def test_at_the_mode_the_gradient_of_the_log_posterior_is_zero(generator):
    """Found by differentiating the sum over all steps, without anything that fitting uses."""
    torch.manual_seed(0)
    data = group(anything, generator, 2, 6)
    inputs, precisions = _inputs(get_domain(data.domain), "setting", data).double(), (0.3, 2.0)
    weights = _mode(inputs, data.actions, 2, precisions)
    # With own = weights - shared, the best shared weights are a weighted mean of all weights.
    shared = weights.sum(0) * precisions[1] / (precisions[0] + 2 * precisions[1])
    own = weights - shared
    total = (shared + own).requires_grad_()
    log_probabilities = torch.einsum("pbti,pia->pbta", inputs, total).log_softmax(-1)
    log_probabilities.gather(-1, data.actions[..., None]).sum().backward()
    assert total.grad is not None
    torch.testing.assert_close(total.grad, precisions[1] * own.detach(), atol=0.02, rtol=0)


@pytest.mark.parametrize("rule", [avoid, alternate])
def test_solves_a_task_that_it_must(rule, generator):
    train, validation, test = parts(rounds_of(rule, generator, 80), (0, 40), (40, 50), (50, 80))
    model = fit_pooled_logistic(train, validation)
    rate = (train.actions == SWITCH).float().mean()
    knowing_nothing = float(torch.special.entr(torch.stack([rate, 1 - rate])).sum())
    found = model.log_probabilities(test)
    assert mean_nll(found, test.actions).item() < 0.4 * knowing_nothing
    assert (found.argmax(-1) == test.actions).float().mean() > 0.95


def test_similar_people_share_weights(generator):
    data = group(avoid, generator, 4, 14)
    train, validation, test = parts(data, (0, 1), (1, 6), (6, 14))
    together = fit_pooled_logistic(train, validation)
    nll = mean_nll(together.log_probabilities(test), test.actions).mean()
    alone = [
        mean_nll(
            fit_pooled_logistic(
                *(part.select_people([name]) for part in (train, validation))
            ).log_probabilities(test.select_people([name])),
            test.select_people([name]).actions,
        )
        for name in train.people
    ]
    assert nll < 0.8 * torch.stack(alone).mean()


def test_people_who_differ_keep_weights_of_their_own(generator):
    data = concatenate(
        [rounds_of(avoid, generator, 60, "a"), rounds_of(alternate, generator, 60, "b")]
    )
    train, validation, test = parts(data, (0, 40), (40, 50), (50, 60))
    found = fit_pooled_logistic(train, validation).log_probabilities(test)
    assert ((found.argmax(-1) == test.actions).float().mean((1, 2)) > 0.9).all()


def test_the_precisions_are_those_that_validate_best(generator):
    data = group(avoid, generator, 3, 30)
    train, validation = parts(data, (0, 10), (10, 30))
    options = LogisticOptions(shared=(0.1, 30.0), own=(0.1, 30.0))
    chosen = fit_pooled_logistic(train, validation, options)
    best = mean_nll(chosen.log_probabilities(validation), validation.actions).mean()
    for shared in options.shared:
        for own in options.own:
            one = replace(options, shared=(shared,), own=(own,))
            other = fit_pooled_logistic(train, validation, one)
            nll = mean_nll(other.log_probabilities(validation), validation.actions).mean()
            assert best <= nll + 1e-6


def test_what_makes_no_sense_is_refused(generator):
    with pytest.raises(UnknownNameError, match="sight"):
        LogisticOptions(sight="nothing")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"^own must be positive numbers, not \(1.0, 0.0\)$"):
        LogisticOptions(own=(1.0, 0.0))
    train, validation = parts(rounds_of(avoid, generator, 8), (0, 4), (4, 8))
    model = fit_pooled_logistic(train, validation)
    with pytest.raises(DemonstrationsError) as error:
        model.log_probabilities(rounds_of(avoid, generator, 2, "somebody"))
    assert str(error.value) == "demonstrations of driving, somebody; expected driving, a"
