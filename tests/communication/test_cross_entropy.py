"""The cross-entropy method against answers set by hand and against trying all sequences."""

import itertools

import pytest
import torch

from mirror_ppl.cross_entropy import CrossEntropyOptions, best_sequences

# Without smoothing every sequence is drawn with probability 2**-H each time; at H = 5 the chance
# that one given sequence is not among 4 * 256 draws is (31/32)**1024 = 8e-15.
UNIFORM = CrossEntropyOptions(samples=256, smoothing=0.0, start_probability=0.5)
# The first iteration alone misses a given sequence of 4 actions with probability
# (15/16)**256 = 7e-8; all 16 are there but for one run in a million.
MOVING = CrossEntropyOptions(samples=256, elites=32, smoothing=0.7, start_probability=0.5)


def all_sequences(horizon):
    return torch.tensor(list(itertools.product([False, True], repeat=horizon)))


def table_value(table):
    """Values of sequences looked up in a table [..., 2**H]."""

    def value(sequences):
        horizon = sequences.shape[-1]
        index = (sequences * 2 ** torch.arange(horizon - 1, -1, -1)).sum(-1)
        return table.gather(-1, index)

    return value


def matches(target):
    """How many actions of a sequence are those of the target [..., H]."""
    return lambda sequences: (sequences == target[..., None, :]).sum(-1).float()


@pytest.mark.parametrize(("horizon", "options"), [(5, UNIFORM), (4, MOVING), (4, UNIFORM)])
def test_finds_what_trying_all_sequences_finds(horizon, options, generator):
    table = torch.randn(40, 3, 2**horizon, generator=generator)
    best, value = best_sequences(table_value(table), (40, 3), horizon, generator, options)
    highest, index = table.max(-1)
    assert torch.equal(value, highest)
    assert torch.equal(best, all_sequences(horizon)[index])


def test_a_given_first_action_is_kept_and_the_rest_searched(generator):
    table = torch.randn(40, 1, 16, generator=generator).expand(40, 2, 16)
    first = torch.tensor([False, True]).expand(40, 2)
    best, value = best_sequences(table_value(table), (40, 2), 4, generator, MOVING, first)
    assert torch.equal(best[..., 0], first)
    assert torch.equal(value, table[:, 0].unflatten(-1, (2, 8)).amax(-1))


def test_finds_a_needle_that_drawing_at_random_would_not(generator):
    # 15 * 256 random sequences of 20 actions hold one given sequence with probability 0.004.
    target = torch.rand(20, 20, generator=generator) < 0.5
    options = CrossEntropyOptions(256, 32, 15, 0.5, 0.5)
    best, value = best_sequences(matches(target), (20,), 20, generator, options)
    assert torch.equal(best, target)
    assert (value == 20).all()


def test_more_iterations_are_never_worse(generator):
    target = torch.rand(30, 15, generator=generator) < 0.5
    values = [
        best_sequences(
            matches(target),
            (30,),
            15,
            torch.Generator().manual_seed(1),
            CrossEntropyOptions(16, 4, iterations),
        )[1]
        for iterations in (1, 2, 3, 4)
    ]
    for fewer, more in itertools.pairwise(values):
        assert (more >= fewer).all()
    assert values[-1].mean() > values[0].mean()


def test_the_value_is_that_of_the_sequence(generator):
    table = torch.randn(10, 256, generator=generator)
    options = CrossEntropyOptions(samples=8, elites=2, iterations=2)
    best, value = best_sequences(table_value(table), (10,), 8, generator, options)
    assert torch.equal(table_value(table)(best[:, None])[:, 0], value)


def test_an_element_gets_the_same_answer_alone_and_in_a_batch(generator):
    table = torch.randn(10, 256, generator=generator)
    options = CrossEntropyOptions(samples=8, elites=2, iterations=3)

    def search(part):
        same = torch.Generator().manual_seed(3)
        return best_sequences(table_value(part), (len(part),), 8, same, options)

    best, value = search(table)
    for row in range(10):
        alone, its_value = search(table[row : row + 1])
        assert torch.equal(alone[0], best[row])
        assert torch.equal(its_value[0], value[row])


def test_all_sequences_equally_good(generator):
    best, value = best_sequences(lambda tried: torch.zeros(2, tried.shape[-2]), (2,), 3, generator)
    assert best.shape == (2, 3)
    assert torch.equal(value, torch.zeros(2))


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"elites": 0}, "elites"),
        ({"samples": 4, "elites": 5}, "elites"),
        ({"iterations": 0}, "iterations"),
        ({"smoothing": 1.5}, "smoothing"),
        ({"start_probability": 0.0}, "start_probability"),
    ],
)
def test_impossible_options_are_refused(wrong, named):
    with pytest.raises(ValueError, match=named):
        CrossEntropyOptions(**wrong)


def test_a_value_of_the_wrong_shape_is_refused(generator):
    with pytest.raises(ValueError, match=r"\(2, 256\), not \(256,\)"):
        best_sequences(lambda tried: torch.zeros(256), (2,), 3, generator)
