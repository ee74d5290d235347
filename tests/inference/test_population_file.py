"""Populations in files: pooled fits, their population as a prior of others, refusals."""

import json

import numpy as np
import pytest
import torch
from running import command

from mirror_ppl.arviz import az
from mirror_ppl.commands import fit
from mirror_ppl.data import load_demonstrations, save_demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.errors import PosteriorError
from mirror_ppl.inference.population.pooling import Pooling
from mirror_ppl.inference.results.export import save_inference_data
from mirror_ppl.inference.results.population_file import load_population
from mirror_ppl.models import HumanModel
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.toy import ToyHuman
from mirror_ppl.models.weights import load_self_model, shipped_weights

TOY = ("--human-model", "toy.py:Toy")
QUICK = ("--demos", "few.nc", *TOY, "--explore", 0)


@pytest.fixture(scope="module")
def toy():
    return ToyHuman(load_self_model(shipped_weights("driving"))[0])


@pytest.fixture(scope="module")
def folder(toy, tmp_path_factory):
    """Recordings of eight people of one kind, one of whom has no rounds, and their fit.

    Four of them, of whom three have rounds, are in a file of their own.
    """
    folder = tmp_path_factory.mktemp("population")
    implants = {
        "reach": torch.full((8, 1), 3),
        "in_sight": torch.full((8, 1), 0.9),
        "otherwise": torch.full((8, 1), 0.03),
    }
    recordings = play_rounds(toy, implants, 4, "fog", torch.Generator().manual_seed(1))
    some = torch.tensor([4, 4, 4, 4, 3, 3, 1, 0])
    variables = recordings.variables()
    begun = torch.arange(4) < some[:, None]
    variables |= {"round_count": some, "length": variables["length"] * begun}
    ragged = type(recordings).from_variables(
        "driving", "fog", recordings.people, variables, recordings.provenance
    )
    save_demonstrations(folder / "some.nc", ragged)
    save_demonstrations(folder / "few.nc", ragged.select_people([0, 1, 2, 7]))
    (folder / "toy.py").write_text("from mirror_ppl.models.toy import ToyHuman as Toy\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        status = command(
            fit, "--demos", "some.nc", *TOY, "--pooling", "partial", "--train-rounds", 4,
            "--draws", 60, "--explore", 0, "--out", "pooled",
        )  # fmt: skip
    assert status == 0
    return folder


@pytest.fixture
def inside(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return folder


def test_a_pooled_fit_holds_its_population_and_a_newcomer(folder, toy):
    data = az.from_netcdf(str(folder / "pooled" / "posterior.nc"))
    assert data["posterior"].attrs["pooling"] == "partial"
    population, newcomer = data["population"], data["newcomer"]
    assert population["reach_probabilities"].dims == ("chain", "draw", "reach_value")
    np.testing.assert_allclose(population["reach_probabilities"].sum("reach_value"), 1, rtol=1e-4)
    assert set(newcomer.data_vars) == set(data["posterior"].data_vars)
    assert {value.shape for value in newcomer.data_vars.values()} == {(1, 60)}
    # Somebody without rounds is not known better than the newcomer, but better than by the prior.
    nobody = data["posterior"].isel(person=7)["reach"]
    for draws in (nobody, newcomer["reach"]):
        assert float((draws == 3).mean()) > 2 / 7
    assert float((data["posterior"].isel(person=0)["reach"] == 3).mean()) > 0.9
    summary = json.loads((folder / "pooled" / "summary.json").read_text())
    assert summary["options"]["pooling"] == "partial"
    effective = [person["effective_draws"] for person in summary["people"]]
    assert all(1 <= value <= 4000 for value in effective)
    told = summary["newcomer"]
    assert told.keys() == {"reach", "in_sight", "otherwise"}
    assert told["in_sight"]["q05"] <= told["in_sight"]["median"] <= told["in_sight"]["q95"]
    values = newcomer["otherwise"].values.ravel()
    assert told["otherwise"]["q95"] == pytest.approx(
        float(np.quantile(values, 0.95, method="inverted_cdf"))
    )


def test_the_population_comes_back_as_it_was(folder, toy):
    pooling = Pooling(toy)
    path = folder / "pooled" / "posterior.nc"
    found = load_population(path, pooling)
    assert len(found) == 60
    group = az.from_netcdf(str(path))["population"]
    np.testing.assert_array_equal(found.probabilities["reach"], group["reach_probabilities"][0])
    for name in toy_rates(found):
        np.testing.assert_array_equal(found.mean[name], group[f"{name}_mean"][0])
        np.testing.assert_array_equal(found.spread[name], group[f"{name}_spread"][0])


def toy_rates(population):
    assert population.mean.keys() == population.spread.keys() == {"in_sight", "otherwise"}
    return population.mean


def test_a_population_is_a_prior_of_others(inside, capsys):
    """Without rounds, people are the newcomer; with rounds, more is known."""
    for rounds, out in ((0, "none"), (1, "one")):
        args = *QUICK, "--draws", 60, "--train-rounds", rounds, "--out", out
        assert command(fit, *args, "--prior-from", "pooled/posterior.nc") == 0
        assert "Prior: the population of pooled/posterior.nc" in capsys.readouterr().out
    before, after = (
        az.from_netcdf(f"{name}/posterior.nc")["posterior"] for name in ("none", "one")
    )
    assert before.attrs["pooling"] == "known population"
    assert float((before["reach"] == 3).mean()) > 2 / 7
    right = (after["reach"] == 3).mean(("chain", "draw"))[:3]
    assert float(right.mean()) > float((before["reach"] == 3).mean())
    capsys.readouterr()
    # By itself, nobody without rounds is known better than by the prior.
    assert command(fit, *QUICK, "--train-rounds", 0, "--out", "own") == 0
    own = az.from_netcdf("own/posterior.nc")["posterior"]["reach"]
    assert abs(float((own == 3).mean()) - 1 / 7) < 0.06  # 800 draws: s.d. 0.012
    assert "Held-out actions" in capsys.readouterr().out


def test_runs_with_and_without_a_population_do_not_continue_each_other(inside, toy):
    from mirror_ppl.inference import engines
    from mirror_ppl.inference.results.fitting import fit_people

    demonstrations = load_demonstrations(inside / "some.nc").select_people([0, 1])
    options = engines.InferenceOptions(draws=20)
    checkpoint = inside / "some.checkpoint"
    fit_people(toy, demonstrations, options, 0, 2, checkpoint=checkpoint)
    known = load_population(inside / "pooled" / "posterior.nc", Pooling(toy))
    after = fit_people(toy, demonstrations, options, 0, 2, checkpoint=checkpoint, population=known)
    alone = fit_people(toy, demonstrations, options, 0, 2, population=known)
    assert after.summary == alone.summary


def test_a_population_of_another_setting_is_refused(folder, toy):
    with pytest.raises(PosteriorError, match="of people in fog, not in clear"):
        load_population(folder / "pooled" / "posterior.nc", Pooling(toy), "clear")


def test_what_the_prior_rules_out_stays_ruled_out(toy):
    import pyro
    import pyro.distributions as dist

    class Short(ToyHuman):
        def prior(self):
            probabilities = torch.tensor([0.5, 0.5, 0, 0, 0, 0, 0])
            return super().prior() | {
                "reach": pyro.sample("short", dist.Categorical(probabilities))
            }

    pooling = Pooling(Short(toy.self_model))
    assert pooling.supports["short"].tolist() == [0, 1]
    assert pooling.prior_probabilities["short"].tolist() == pytest.approx([0.5, 0.5])


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--pooling", "full"), 'unknown pooling "full"; known: none, partial'),
        (
            ("--prior-from", "nowhere.nc"),
            "nowhere.nc: there is no such file; python -m mirror_ppl.fit --pooling",
        ),
        (("--prior-from", "some.nc"), "some.nc: holds no population"),
        (("--prior-from", "toy.py"), "toy.py: is not a netCDF file"),
        (("--prior-from", "pooled/posterior.nc"), "is of human model Toy, not mirror"),
        (("--prior-from", "x.nc", "--pooling", "partial"), "leave out --pooling"),
        (("--train-rounds", "-1"), "--train-rounds must be at least 0, not -1"),
    ],
)
def test_fit_refuses(inside, capsys, args, message):
    assert command(fit, "--demos", "some.nc", "--out", "refused", *args) == 2
    error = capsys.readouterr().err
    assert message in error.replace("ToyHuman", "Toy")
    assert not (inside / "refused").exists()


def test_people_of_a_known_population_are_not_pooled(folder, toy):
    from mirror_ppl.inference.engines import InferenceOptions, infer

    known = load_population(folder / "pooled" / "posterior.nc", Pooling(toy))
    some = load_demonstrations(folder / "some.nc")
    with pytest.raises(ValueError, match="a known population are not pooled"):
        infer(toy, some, InferenceOptions(pooling="partial"), 0, population=known)


def damaged(folder, name, change):
    data = az.from_netcdf(str(folder / "pooled" / "posterior.nc"))
    data["population"] = change(data["population"].copy(deep=True))
    save_inference_data(data, folder / name)
    return folder / name


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda group: group.drop_vars("otherwise_mean"), 'lacks "otherwise_mean"'),
        (lambda group: group.assign(otherwise_mean=group["otherwise_mean"] * np.nan), "no numbers"),
        (lambda group: group.assign(in_sight_spread=-group["in_sight_spread"]), "not positive"),
        (
            lambda group: group.assign(reach_probabilities=2 * group["reach_probabilities"]),
            "no probabilities",
        ),
        (lambda group: group.isel(reach_value=slice(3)), "no probabilities"),
    ],
)
def test_damaged_populations_are_refused(folder, toy, change, message):
    path = damaged(folder, "damaged.nc", change)
    with pytest.raises(PosteriorError, match=message):
        load_population(path, Pooling(toy))


def test_reaches_of_a_population_are_in_the_unit_of_distance(toy):
    """Stored bins of the package's human model are distances; assumptions are 0 and 1."""
    from mirror_ppl.inference.population.pooling import Population
    from mirror_ppl.inference.results.population_file import add_population

    pooling = Pooling(HumanModel(toy.self_model))
    population = Population(
        {name: torch.full((4, len(v)), 1 / len(v)) for name, v in pooling.supports.items()},
        {name: torch.zeros(4) for name in pooling.sites},
        {name: torch.ones(4) for name in pooling.sites},
    )
    data = az.from_dict(posterior={"nothing": np.zeros((1, 4))})
    add_population(data, pooling, population, {"domain": "driving"}, 0)
    bins = get_domain("driving").reach_bins
    assert data["population"]["sight_front_own_value"].values.tolist() == list(bins)
    assert data["population"]["assumes_clear_value"].values.tolist() == [0, 1]
    assert set(np.unique(data["newcomer"]["sight_front_own"])) <= set(bins)
    assert data["newcomer"]["residual_in"].ndim == 4
