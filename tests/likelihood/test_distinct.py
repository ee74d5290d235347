"""Finding equal rows: against sorting whole rows, and the tables that have no rows to compare."""

import pytest
import torch

from mirror_ppl.row_hashing import as_whole_numbers, distinct_rows, random_keys, uniform_of


def check(rows):
    """The sets are those of torch.unique, and each set's first row is the first that is in it."""
    first, which = distinct_rows(rows)
    expected, same = torch.unique(rows, dim=0, return_inverse=True)
    assert len(first) == len(expected)
    assert which.shape == (len(rows),)
    # The sets may be numbered in another way, but the same rows have to be together.
    assert torch.equal(which[:, None] == which, same[:, None] == same)
    assert torch.equal(rows[first][which], rows)
    for number, place in enumerate(first.tolist()):
        assert place == int((which == number).nonzero()[0])


@pytest.mark.parametrize("values", [1, 2, 5, 1000])
@pytest.mark.parametrize("columns", [1, 2, 3, 8, 40])
@pytest.mark.parametrize("number", [1, 2, 30, 300])
def test_sets_are_those_of_whole_rows(generator, number, columns, values):
    check(torch.randint(values, (number, columns), generator=generator))


def test_numbers_may_be_negative_and_large(generator):
    check(torch.randint(-3, 3, (200, 3), generator=generator))
    # Products with the keys overflow, in the same way for equal rows.
    check(torch.randint(-(2**40), 2**40, (50, 4), generator=generator).repeat(3, 1))


def test_order_within_a_row_matters():
    check(torch.tensor([[1, 2, 3], [3, 2, 1], [2, 1, 3], [1, 2, 3]]))


def test_first_is_the_first_in_the_table_and_not_in_sorted_order():
    rows = torch.tensor([[5], [1], [5], [1], [3]])
    first, which = distinct_rows(rows)
    assert sorted(first.tolist()) == [0, 1, 4]
    assert first[which].tolist() == [0, 1, 0, 1, 4]


def test_rows_that_are_all_equal_or_all_different():
    first, which = distinct_rows(torch.full((6, 3), 7))
    assert first.tolist() == [0]
    assert which.tolist() == [0] * 6
    first, which = distinct_rows(torch.arange(12).view(6, 2))
    assert first[which].tolist() == list(range(6))


def test_rows_without_columns_are_equal():
    first, which = distinct_rows(torch.zeros(4, 0, dtype=torch.long))
    assert first.tolist() == [0]
    assert which.tolist() == [0] * 4


def test_a_table_without_rows_has_no_sets():
    first, which = distinct_rows(torch.zeros(0, 3, dtype=torch.long))
    assert first.shape == (0,)
    assert which.shape == (0,)


def test_keys_are_the_same_each_time_and_leave_global_randomness_alone():
    before = torch.get_rng_state()
    keys = random_keys(100, torch.device("cpu"))
    assert torch.equal(keys, random_keys(100, torch.device("cpu")))
    assert torch.equal(torch.get_rng_state(), before)
    assert keys.dtype == torch.long
    assert len(keys.unique()) == 100
    assert keys.min() >= 0 and keys.max() < 2**62


def test_uniform_numbers_belong_to_their_names():
    draws, paths = torch.arange(300)[:, None], torch.arange(400)
    numbers = uniform_of(3, draws, paths)
    assert numbers.shape == (300, 400)
    assert numbers.min() >= 0 and numbers.max() < 1
    assert torch.equal(uniform_of(3, draws[7], paths[5:9]), numbers[7, 5:9])
    assert not torch.equal(uniform_of(4, draws, paths), numbers)
    assert not torch.equal(uniform_of(3, paths[:300, None], draws[:, 0]), numbers[:, :300].T)
    # Of 120,000 numbers 12,000 are in each tenth, give or take 104 (one standard error).
    counts = torch.histc(numbers, 10, 0, 1)
    assert (counts - 12_000).abs().max() < 5 * 104
    # Neighbours know nothing of each other: correlations have a standard error of .003.
    for first, second in ((numbers[1:], numbers[:-1]), (numbers[:, 1:], numbers[:, :-1])):
        pair = torch.stack([first.flatten(), second.flatten()])
        assert torch.corrcoef(pair)[0, 1].abs() < 0.015


def test_numbers_of_64_bits_stay_different():
    close = torch.tensor([1.0, 1 + 1e-9, 2.0**24, 2.0**24 + 1, 0.0, -0.0], dtype=torch.double)
    found = as_whole_numbers(close)
    assert len(set(found.tolist())) == 5 and found[4] == found[5]
