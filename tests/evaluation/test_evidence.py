"""`python -m mirror_ppl.compare --by evidence`: sums, errors and shares by hand, and refusals."""

import json
from functools import partial

import numpy as np
import pytest
from example_posteriors import ACTIONS, PEOPLE, write
from refused import refused
from running import command

import mirror_ppl
from mirror_ppl.commands import compare
from mirror_ppl.evaluation.compared_files import read_evidence
from mirror_ppl.evaluation.evidence import CHAINS, SWEEPS, compare_evidence, model_shares
from mirror_ppl.inference.svi import SVIOptions

QUICK = SVIOptions(steps=2)
EVIDENCE = {
    "a": np.array([-10.0, -20, -30, -40]),
    "b": np.array([-12.0, -19, -33, -49]),
    "c": np.array([-30.0, -40, -50, -60]),
}
ERROR = {"a": np.array([0.3, 0, 0, 0.4]), "b": np.array([0, 0.5, 0, 0]), "c": np.full(4, 0.1)}


@pytest.fixture
def paths(tmp_path):
    return [
        write(tmp_path / f"{name}.nc", evidence=(EVIDENCE[name], ERROR[name])) for name in EVIDENCE
    ]


def compared(paths):
    return compare_evidence([read_evidence(path) for path in paths], [path.stem for path in paths])


# --- shares of the models among people --------------------------------------------------------


def within(draws, level):
    """What the frequency of an event of this probability may be off by once in a million."""
    return 4.9 * (level * (1 - level) / draws) ** 0.5


def exact(evidence):
    """Mean and distribution function of the first of two shares, by integration."""
    share = (np.arange(4000) + 0.5) / 4000
    one, other = np.exp(evidence - evidence.max(-1, keepdims=True)).T
    log_density = np.log(share[:, None] * one + (1 - share[:, None]) * other).sum(-1)
    density = np.exp(log_density - log_density.max())
    density /= density.sum()
    return density @ share, lambda value: density[share <= value].sum()


def test_equal_evidence_leaves_the_prior():
    """The share of one of three models has the distribution function 1 - (1 - x)**2."""
    shares = model_shares(np.zeros((6, 3)))
    np.testing.assert_allclose(shares.followed, 1 / 3, atol=0.02)
    np.testing.assert_allclose(shares.mean, 1 / 3, atol=0.02)
    low, high = shares.interval
    np.testing.assert_allclose(1 - (1 - low) ** 2, 0.05, atol=within(CHAINS, 0.05))
    np.testing.assert_allclose(1 - (1 - high) ** 2, 0.95, atol=within(CHAINS, 0.05))


def test_people_who_surely_follow_a_model_are_counted():
    """With 3 of the first and 1 of the second model the shares are of the Beta(4, 2) distribution,
    whose distribution function at x is 5 x**4 - 4 x**5."""
    evidence = np.array([[0, -900], [0, -900], [0, -900], [-900, 0.0]])
    shares = model_shares(evidence)
    np.testing.assert_allclose(shares.mean, [4 / 6, 2 / 6])
    np.testing.assert_array_equal(shares.followed, [[1, 0], [1, 0], [1, 0], [0, 1]])
    low, high = shares.interval[:, 0]
    # Given the models of all people, draws of the shares are independent.
    bound = within(CHAINS * SWEEPS / 2, 0.05)
    assert abs(5 * low**4 - 4 * low**5 - 0.05) < bound
    assert abs(5 * high**4 - 4 * high**5 - 0.95) < bound
    np.testing.assert_allclose(shares.interval[:, 1], [1 - high, 1 - low])


@pytest.mark.parametrize("spread", [0.3, 1.0, 3.0])
def test_shares_have_the_exact_posterior(rng, spread):
    evidence = rng.normal(0, spread, (20, 2)) - 1000
    shares = model_shares(evidence)
    mean, distribution = exact(evidence)
    # As if each chain were one draw, of a spread of at most one half.
    assert abs(shares.mean[0] - mean) < 4.9 * 0.5 / CHAINS**0.5
    for level, edge in zip((0.05, 0.95), shares.interval[:, 0], strict=True):
        assert abs(distribution(edge) - level) < within(CHAINS, level) + 1 / 4000
    assert abs(model_shares(evidence[:, ::-1]).mean[1] - mean) < 4.9 * 0.5 / CHAINS**0.5


# --- comparisons ------------------------------------------------------------------------------


def test_sums_differences_and_errors_by_hand(paths):
    found = compared(paths[::-1])
    assert [model.label for model in found.models] == ["a", "b", "c"]
    assert (found.people, found.rounds) == (PEOPLE, (3, 1, 0, 3))
    best, second, _ = found.models
    assert (best.log_evidence, best.difference, best.difference_error) == (-100, 0, 0)
    assert best.evidence_error == pytest.approx(0.5)  # of .3 and .4
    assert (second.log_evidence, second.difference) == (-113, -13)
    assert second.difference_error == pytest.approx(0.5 * 2**0.5)
    assert [one.difference for one in second.people] == [-2, 1, -3, -9]
    assert [one.difference_error for one in second.people] == [0.3, 0.5, 0, 0.4]
    shares = model_shares(np.stack(list(EVIDENCE.values()), -1))
    assert [model.share for model in found.models] == shares.mean.tolist()
    for place, model in enumerate(found.models):
        probabilities = [one.probability for one in model.people]
        assert probabilities == shares.followed[:, place].tolist()


def test_the_command_prints_writes_and_draws(paths, tmp_path, capsys):
    outputs = "--json", tmp_path / "x.json", "--figure", tmp_path / "x.png"
    assert command(compare, *paths, "--by", "evidence", "--labels", *EVIDENCE, *outputs) == 0
    shown = capsys.readouterr().out
    assert "driving, fog: evidence, 7 rounds of 4 people" in shown
    assert "-13.0 ±0.7" in shown and "-100.0" in shown and "share of people" in shown
    # Of three models the distribution function of a share is 1 - (1 - x)**2.
    assert "(before any data 0.33 [0.03, 0.78])" in " ".join(shown.split())
    data = json.loads((tmp_path / "x.json").read_text())
    assert (data["by"], data["unit"]) == ("evidence", "nats")
    assert [model["label"] for model in data["models"]] == ["a", "b", "c"]
    assert data["models"][1]["people"][0]["id"] == "ana"
    assert data["models"][1]["people"][0]["difference"] == -2
    assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")


def test_fits_hold_their_evidence():
    people = mirror_ppl.load_recordings().select_people(["person-01", "person-04"])
    fit = mirror_ppl.infer(people, human="no-implants", train_rounds=2, explore=0, draws=20)
    check = fit.data.model_check
    for number, person in enumerate(fit.summary["people"]):
        assert float(check.log_evidence[number]) == person["log_evidence"] < 0
        assert 0 < float(check.evidence_error[number]) == person["evidence_error"] < 0.5
    without = mirror_ppl.infer(people, human="no-implants", engine="svi", settings=QUICK, explore=0)
    assert np.isnan(without.data.model_check.log_evidence).all()
    assert "log_evidence" not in without.summary["people"][0]


# --- refusals ---------------------------------------------------------------------------------


def test_whose_evidence_is_missing_is_named(tmp_path):
    evidence = np.array([-1, np.nan, -3, np.nan])
    path = write(tmp_path / "a.nc", evidence=(evidence, np.zeros(4)))
    message = f"{path}: holds no marginal likelihood of ben, dia; the engines"
    refused(lambda: read_evidence(path), message)
    other = write(tmp_path / "b.nc", evidence=(evidence, np.zeros(4)), likelihood_power=0.25)
    pooled = write(tmp_path / "c.nc", evidence=(evidence, np.zeros(4)), pooling="partial")
    refused(
        lambda: read_evidence(pooled), f"{pooled}: its people were pooled, or have a population"
    )
    message = "each decision counts 0.25 times in it, so that it has no marginal likelihood"
    refused(lambda: read_evidence(other), message)


def test_files_without_evidence_are_refused(tmp_path):
    for path in (write(tmp_path / "a.nc"), write(tmp_path / "b.nc", evidence=())):
        refused(partial(read_evidence, path), f"{path}: has no marginal likelihoods")


def test_evidences_of_other_recordings_are_not_compared(paths, tmp_path):
    evidence = EVIDENCE["a"], ERROR["a"]
    other = write(tmp_path / "other.nc", evidence=evidence, actions=1 - ACTIONS.clip(0))
    message = f"{other}: is of other recordings than {paths[0]}:"
    refused(lambda: compared([paths[0], other]), message)
