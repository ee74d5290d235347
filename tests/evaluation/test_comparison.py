"""`python -m mirror_ppl.compare`: exact scores of tiny posteriors, weights and names."""

import warnings
from itertools import permutations

import numpy as np
import pytest
from example_posteriors import (
    ACTIONS,
    LENGTHS,
    REAL,
    compared,
    standard_error,
    three_values,
    write,
    write_three,
)
from running import command

from mirror_ppl.arviz import az
from mirror_ppl.commands import compare
from mirror_ppl.evaluation.compared_files import label_models, read_fit


@pytest.fixture
def values(rng):
    return three_values(rng)


@pytest.fixture
def paths(tmp_path, values):
    return write_three(tmp_path, values)


# --- leave-one-out ----------------------------------------------------------------------------


def test_where_all_draws_agree_leave_one_out_is_what_they_say(paths, values):
    comparison = compared(*paths)
    assert [model.label for model in comparison.models] == ["a", "b", "c"]
    for model, value in zip(comparison.models, values, strict=True):
        total = model.total
        assert (total.rounds, total.actions, total.doubtful) == (7, 22, 0)
        assert total.log_density == pytest.approx(value[REAL].sum() / 22)
        assert total.log_density_se == pytest.approx(standard_error(value[REAL]) / 22)


def test_differences_are_paired_over_rounds(paths, values):
    comparison = compared(*paths)
    for model, value in zip(comparison.models, values, strict=True):
        behind = value - values[0]
        assert model.total.difference == pytest.approx(behind[REAL].sum() / 22)
        error = standard_error(behind[REAL]) / 22
        assert model.total.difference_se == pytest.approx(error)
        for person, score in enumerate(model.people):
            own = REAL[person]
            if not own.any():
                assert score is None
                continue
            number = LENGTHS[person].sum()
            assert (score.rounds, score.actions) == (own.sum(), number)
            assert score.log_density == pytest.approx(value[person, own].sum() / number)
            assert score.difference == pytest.approx(behind[person, own].sum() / number)
            # Of a single round nobody knows how much another would differ.
            alone = own.sum() == 1
            error = None if alone else standard_error(behind[person, own]) / number
            assert score.difference_se == (None if alone else pytest.approx(error))
    assert comparison.models[0].total.difference == comparison.models[0].total.difference_se == 0


def test_the_best_of_all_is_not_the_best_for_everybody(tmp_path):
    ana = np.arange(4)[:, None] + np.zeros(3) == 0
    first = write(tmp_path / "a.nc", np.where(ana, -6.0, -1.0))
    second = write(tmp_path / "b.nc", np.where(ana, -4.0, -7.0))
    best, behind = compared(first, second).models
    assert best.label == "a"
    # Three rounds with 9 actions, and one with 4.
    assert behind.people[0].difference == pytest.approx(2 * 3 / 9)
    assert behind.people[1].difference == pytest.approx(-6 / 4)


def test_draws_are_weighted_by_how_little_they_expected_a_round(tmp_path, rng):
    # Of eight draws no tail can be smoothed: what is left is the harmonic mean.
    likelihood = -rng.uniform(0.1, 3.0, (8, 4, 3))
    other = likelihood - 1
    comparison = compared(write(tmp_path / "a.nc", likelihood), write(tmp_path / "b.nc", other))
    expected = -np.log(np.exp(-likelihood).mean(0))
    assert comparison.models[0].total.log_density == pytest.approx(expected[REAL].sum() / 22)
    assert comparison.models[1].total.difference == pytest.approx(-7 / 22)
    assert comparison.models[0].total.doubtful == 7


def test_it_agrees_with_arviz(tmp_path, rng):
    likelihood = rng.normal(-2, 0.5, (2, 400, 4, 3)) - rng.uniform(0, 1, (2, 1, 4, 3))
    paths = [write(tmp_path / f"{model}.nc", likelihood[model]) for model in range(2)]
    comparison = compared(*paths)
    data = {
        str(model): az.from_dict(
            posterior={"lapse": np.zeros((1, 400))},
            log_likelihood={"action": likelihood[model][:, REAL][None]},
        )
        for model in range(2)
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        table = az.compare(data)
    assert [model.label for model in comparison.models] == list(table.index)
    for model in comparison.models:
        row, total = table.loc[model.label], model.total
        scores = (total.log_density, total.log_density_se, -total.difference, total.difference_se)
        expected = row[["elpd_loo", "se", "elpd_diff", "dse"]].to_numpy(float) / 22
        assert scores == pytest.approx(expected)
        assert model.weight == pytest.approx(row["weight"], abs=1e-6)
        assert model.good_k == pytest.approx(1 - 1 / np.log10(400))


def test_rounds_that_depend_on_few_draws_are_doubtful(tmp_path, capsys):
    # Draws at the quantiles of what is told, so that nothing depends on chance.
    level = (np.arange(200) + 0.5) / 200
    tail = np.log(level)  # weights of exponent k have a Pareto tail of shape k
    likelihood = np.full((200, 4, 3), -1.0)
    likelihood[:] += 0.2 * tail[:, None, None]
    likelihood[:, 0, 1] = 1.5 * tail
    likelihood[:, 3, :2] = 1.2 * tail[:, None]
    good = write(tmp_path / "good.nc", np.full((200, 4, 3), -0.9) + 0.2 * tail[:, None, None])
    one, other = compared(good, write(tmp_path / "bad.nc", likelihood)).models
    assert (one.label, one.total.doubtful) == ("good", 0)
    assert (other.label, other.total.doubtful) == ("bad", 3)
    doubtful = [None if score is None else score.doubtful for score in other.people]
    assert doubtful == [1, 0, None, 2]
    assert command(compare, good, tmp_path / "bad.nc") == 0
    assert "here many: compare held-out rounds" in " ".join(capsys.readouterr().out.split())
    assert one.good_k == pytest.approx(1 - 1 / np.log10(200))


def test_padding_does_not_count(tmp_path, paths, values, rng):
    padded = np.where(REAL, values, np.nan)
    padded[1][~REAL] = rng.uniform(-9, 9, (~REAL).sum())
    others = [write(tmp_path / "x" / f"{path.name}", padded[m]) for m, path in enumerate(paths)]
    one, other = compared(*paths), compared(*others)
    assert [model.total for model in one.models] == [model.total for model in other.models]
    assert [model.people for model in one.models] == [model.people for model in other.models]


def test_the_order_of_the_arguments_makes_no_difference(paths):
    expected = compared(*paths)
    for some in permutations(paths):
        assert compared(*some) == expected


def test_equal_models_stand_in_the_order_of_their_names(tmp_path, values):
    same = [write(tmp_path / f"{name}.nc", values[0]) for name in "ab"]
    assert compared(*same) == compared(*reversed(same))


@pytest.mark.parametrize("by", ["loo", "heldout"])
def test_a_model_is_not_better_than_itself(tmp_path, rng, by):
    right = rng.uniform(0.2, 0.9, (20, 4, 3, 4))
    path = write(tmp_path / "a.nc", -rng.uniform(0.1, 2, (20, 4, 3)), right)
    one, other = compared(path, path, by=by, labels=["once", "again"]).models
    assert (one.label, other.label) == ("again", "once")
    assert (other.total.difference, other.total.difference_se) == (0, 0)
    assert one.total == other.total
    assert (one.weight, other.weight) == pytest.approx((0.5, 0.5))


# --- held-out rounds --------------------------------------------------------------------------


def test_held_out_actions_are_predicted_by_the_average_of_draws(tmp_path, rng):
    right = rng.uniform(0.05, 0.95, (2, 5, 4, 3, 4))
    right[1] *= 0.5
    paths = [write(tmp_path / f"{model}.nc", right=right[model]) for model in range(2)]
    comparison = compared(*paths, by="heldout")
    steps = ACTIONS >= 0
    rounds = np.where(steps, np.log(right.mean(1)), 0).sum(-1)[:, REAL]
    assert [model.label for model in comparison.models] == ["0", "1"]
    for model, value in zip(comparison.models, rounds, strict=True):
        assert model.total.log_density == pytest.approx(value.sum() / 22)
        assert model.total.difference == pytest.approx((value - rounds[0]).sum() / 22)
        error = standard_error(value - rounds[0]) / 22
        assert model.total.difference_se == pytest.approx(error)
        assert (model.total.doubtful, model.good_k) == (None, None)
    assert comparison.models[1].people[2] is None


def test_chains_are_read_one_after_the_other(tmp_path, rng):
    likelihood = -rng.uniform(0.1, 2, (30, 4, 3))
    paths = [write(tmp_path / f"{n}.nc", likelihood, chains=n) for n in (1, 3)]
    one, other = compared(*paths).models
    assert one.total == other.total


# --- weights ----------------------------------------------------------------------------------


@pytest.mark.parametrize("shift", [0.0, -2000.0])
def test_weights_are_those_of_the_best_mixture(tmp_path, shift):
    # Probabilities .9 and .1 the one way in five rounds, the other way in two; the best weight w
    # solves 5 (.9 - .8 w) = 2 (.1 + .8 w).
    mostly = np.where(np.arange(7) < 5, 0.9, 0.1)
    likelihood = np.zeros((2, 4, 3))
    likelihood[0][REAL], likelihood[1][REAL] = np.log(mostly), np.log(1 - mostly)
    # However long rounds are, and however small so their probability.
    paths = [write(tmp_path / f"{m}.nc", likelihood[m] + shift) for m in range(2)]
    one, other = compared(*paths).models
    assert one.label == "0"
    expected = (5 * 0.9 - 2 * 0.1) / (7 * 0.8)
    assert one.weight == pytest.approx(expected, abs=1e-3)
    assert one.weight + other.weight == pytest.approx(1)


def test_a_model_that_is_worse_in_every_round_has_no_weight(paths):
    weights = [model.weight for model in compared(*paths).models]
    assert weights == pytest.approx([1, 0, 0], abs=1e-6)
    assert all(0 <= weight <= 1 for weight in weights)


# --- names ------------------------------------------------------------------------------------


def labels_of(*files):
    return label_models([read_fit(path) for path in files])


def test_models_are_called_by_their_class_and_by_their_path_where_that_is_needed(tmp_path):
    def model(place, name="HumanModel"):
        return write(tmp_path / place, np.zeros((4, 3)), human_model=name)

    late = model("late/posterior.nc", "LatePerson")
    first, second = model("x/fog/posterior.nc"), model("x/clear/posterior.nc")
    third, plain = model("y/fog/posterior.nc"), model("y/some.nc")
    unknown = model("z/posterior.nc", None)
    assert labels_of(late, first) == ("LatePerson", "mirror")
    assert labels_of(first, late, second) == ("mirror fog", "LatePerson", "mirror clear")
    assert labels_of(first, third, plain) == (
        "mirror x/fog",
        "mirror y/fog",
        "mirror y/some.nc",
    )
    # A folder stands for the file in it.
    assert labels_of(first.parent, second.parent) == ("mirror fog", "mirror clear")
    assert labels_of(first, late, first) == ("mirror (1)", "LatePerson", "mirror (2)")
    assert labels_of(first, second, first)[::2] == ("mirror fog (1)", "mirror fog (2)")
    assert labels_of(late, unknown) == ("LatePerson", "unknown")
