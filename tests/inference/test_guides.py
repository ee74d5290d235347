"""Every guide against a person whose posterior is known exactly, and guides that are trained."""

import json
import math
from dataclasses import replace
from functools import partial

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_draws import DRAWS, bound, options_of
from example_views import ragged
from running import command
from scipy import stats

from mirror_ppl.commands import calibrate as calibrate_command
from mirror_ppl.commands import fit, simulate, train
from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.errors import AssetError, HumanModelError
from mirror_ppl.inference.adaptive_importance import ImportanceOptions
from mirror_ppl.inference.amortized import AmortizedOptions, evidence_of, sample_amortized
from mirror_ppl.inference.amortized_guide import AmortizedGuide, guide_screening, reference_places
from mirror_ppl.inference.calibration.study import CalibrationOptions, calibrate, prior_people
from mirror_ppl.inference.engines import InferenceOptions, Inferred, infer
from mirror_ppl.inference.nuts import NUTSOptions
from mirror_ppl.inference.sampler import Sampler
from mirror_ppl.likelihood.table_program import log_likelihoods
from mirror_ppl.likelihood.tables import build_view_table, rounds_of
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models import HumanModel
from mirror_ppl.models.prior import scalar_sites, unconstrained
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.toy import RATES, ToyHuman, toy_posterior
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.training import guide as guide_training
from mirror_ppl.training.guide import GuideOptions, train_guide
from mirror_ppl.training.guide_file import load_guide, network_for, save_guide

TRAINING = GuideOptions(people=100, rounds=(1, 3), steps=200, batch=64, together=50)


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


@pytest.fixture(scope="module")
def toy(self_model):
    return ToyHuman(self_model)


@pytest.fixture(scope="module")
def recordings(toy):
    generator = torch.Generator().manual_seed(3)
    return play_rounds(toy, prior_people(toy, 6, generator), 3, "fog", generator)


@pytest.fixture(scope="module")
def trained(toy):
    return train_guide(toy, TRAINING, seed=0)


@pytest.fixture(scope="module")
def network(trained):
    return trained[0]


QUICK = {
    "importance": ImportanceOptions(256, 100.0),
    "amortized": AmortizedOptions(256, ImportanceOptions(256, 100.0)),
}
"""Settings of the engines that are calibrated here."""


# --- against the exact posterior --------------------------------------------------------------


@pytest.mark.parametrize("guide", ["importance", "amortized"])
def test_importance_finds_the_exact_posterior(toy, recordings, network, guide):
    found = infer(toy, recordings, options_of(guide), 1, network)
    exact = toy_posterior(toy, recordings)
    # Resampled draws count for less than independent ones.
    worth = DRAWS / 4
    for site in RATES:
        value = found.draws[site][..., 0].double()
        assert value.shape == (DRAWS, 6)
        off = (value.mean(0) - exact.mean(site)).abs()
        assert (off < bound(exact.variance(site), worth)).all()
        assert (value.var(0) / exact.variance(site) - 1).abs().max() < 0.8
    bins = torch.arange(exact.reach.shape[1])[:, None, None]
    share = (found.draws["reach"][..., 0] == bins).double().mean(1).T
    assert (
        (share - exact.reach).abs() < bound(exact.reach * (1 - exact.reach) + 1e-4, worth)
    ).all()
    assert (found.pareto_k < 0.7).all()
    # An average of weights, whose relative variance is at most 1 / worth.
    assert (found.log_evidence - exact.log_evidence).abs().max() < bound(1.0, worth)


def test_variational_posteriors_are_about_right(toy, recordings):
    found = infer(toy, recordings, replace(options_of("svi"), draws=100), 1)
    exact = toy_posterior(toy, recordings)
    bins = torch.arange(exact.reach.shape[1])[:, None, None]
    share = (found.draws["reach"][..., 0] == bins).double().mean(1).T
    assert (share - exact.reach).abs().sum(-1).max() / 2 < 0.3
    for site in RATES:
        off = (found.draws[site][..., 0].double().mean(0) - exact.mean(site)).abs()
        assert (off < 1.0 * exact.variance(site).sqrt()).all()
    assert found.pareto_k is None and len(found.losses) == 400


def test_hamiltonian_draws_are_of_the_exact_posterior(toy, recordings):
    one = recordings.select_people([0])
    found = infer(toy, one, InferenceOptions("nuts", 100, NUTSOptions(warmup=40)), 1)
    exact = toy_posterior(toy, one)
    for site in RATES:
        off = (found.draws[site][..., 0].double().mean(0) - exact.mean(site)).abs()
        assert (off < bound(exact.variance(site), 100 / 5)).all()
    bins = torch.arange(exact.reach.shape[1])[:, None, None]
    share = (found.draws["reach"][..., 0] == bins).double().mean(1).T
    assert (share - exact.reach).abs().sum(-1).max() / 2 < 0.35
    assert list(found.draws) == ["reach", *RATES]


def test_the_exact_posterior_by_hand(toy, recordings):
    """The program, run for every bin and a grid of rates, gives one person's exact posterior."""
    one = recordings.select_people([2]).select_rounds([0, 1])
    table = build_view_table(toy, one)
    exact = toy_posterior(toy, one)
    grid = (torch.arange(60) + 0.5) / 60
    first, second = torch.meshgrid(grid, grid, indexing="ij")
    sampler = Sampler(toy, table)
    policy = {"in_sight": first.reshape(-1, 1, 1), "otherwise": second.reshape(-1, 1, 1)}
    joint = sampler._joint(policy, 3600).double()
    for site, (a, b) in RATES.items():
        joint = joint + dist.Beta(a, b).log_prob(policy[site].flatten())[:, None]
    weight = torch.softmax(joint.flatten(), 0).view(joint.shape)
    # Bins that show nothing different in these rounds are one set.
    sets = sampler.combinations
    reach = torch.stack(
        [part.sum() for part in exact.reach[0][sets.members].split(sets.sizes.tolist())]
    )
    torch.testing.assert_close(weight.sum(0), reach, atol=2e-3, rtol=0)
    for site in RATES:
        mean = (weight.sum(1) * policy[site].flatten()).sum()
        torch.testing.assert_close(mean, exact.mean(site)[0], atol=2e-3, rtol=0)


WRONG = {
    "narrow": lambda value: value.mean(0) + 0.5 * (value - value.mean(0)),
    "shifted": lambda value: value + 0.5 * value.std(0),
}


@pytest.mark.parametrize("guide", ["importance", "amortized"])
def test_importance_is_calibrated_and_wrong_posteriors_are_noticed(toy, network, guide):
    """The people are inferred once; posteriors are as found, too narrow, and shifted."""
    kept = {}

    def infer_once(recordings, seed, change=lambda value: value):
        if seed not in kept:
            options = InferenceOptions(guide, 99, QUICK[guide])
            kept[seed] = infer(toy, recordings, options, seed, network)
        draws = {
            name: value if name == "reach" else change(value)
            for name, value in kept[seed].draws.items()
        }
        return Inferred(draws, kept[seed].pareto_k)

    options = CalibrationOptions(people=60, rounds=(3,), batch=60)
    result = calibrate(toy, infer_once, options, "fog", seed=5)
    assert result.table()["p_value"].min() > 1e-5
    for change in WRONG.values():
        result = calibrate(toy, partial(infer_once, change=change), options, "fog", seed=5)
        assert {site for site, _ in result.rejected} == set(RATES)
    assert len(kept) == 1


def test_nobody_s_rounds_leave_the_prior(toy, recordings, network):
    nobody = ragged(recordings, [[]] * 6)
    for guide in ("importance", "amortized"):
        found = infer(toy, nobody, options_of(guide), 2, network)
        values = found.draws["otherwise"][..., 0].flatten()
        assert stats.kstest(values.numpy(), stats.beta(1, 4).cdf).pvalue > 1e-4
        counts = torch.bincount(found.draws["reach"].flatten(), minlength=7)
        assert stats.chisquare(counts.numpy()).pvalue > 1e-5


def test_people_do_not_depend_on_the_other_people(toy, recordings, network):
    for guide in ("importance", "amortized"):
        together = infer(toy, recordings.select_people([0, 1]), options_of(guide), 0, network)
        alone = infer(toy, recordings.select_people([0]), options_of(guide), 0, network)
        for name, value in alone.draws.items():
            assert torch.equal(together.draws[name][:, :1], value)
            assert value.dtype == (torch.long if name == "reach" else torch.float)


def test_the_package_s_own_model_and_its_prior(self_model):
    human = HumanModel(self_model)
    some = load_demonstrations(asset_path("driving_fog_paper.nc"))
    some = some.select_people([0]).select_rounds([0, 1])
    found = infer(
        human, some, InferenceOptions("importance", 50, settings=ImportanceOptions(128, 10.0)), 0
    )
    assert list(found.draws)[:4] == [f"sight_{name}" for name in human.domain.directions]
    assert found.draws["residual_in"].shape[:3] == (50, 1, 1)
    guide = AmortizedGuide(reference_places(human))
    assert guide.ways.shape == (64, 2)
    untrained = sample_amortized(human, guide, sightings_of(human, some, 0, [0, 1]))
    assert untrained.effective > 10  # weights make up for what it has not learned


# --- what the amortized guide reads -----------------------------------------------------------


def sightings_of(human, recordings, person, order):
    builder = ViewTableBuilder(human, guide_screening())
    rounds = rounds_of(recordings, person)
    for number in order:
        builder.add(rounds.at(number, number + 1))
    return builder


def test_the_order_of_rounds_does_not_matter(toy, recordings, network):
    forward = sightings_of(toy, recordings, 0, [0, 1, 2])
    backward = sightings_of(toy, recordings, 0, [2, 0, 1])
    one, other = evidence_of(forward), evidence_of(backward)
    torch.testing.assert_close(one.log_evidence, other.log_evidence)
    assert one.steps == other.steps == 45
    found = []
    for builder in (forward, backward):
        torch.manual_seed(4)
        found.append(sample_amortized(toy, network, builder))
    torch.testing.assert_close(found[0].log_weights, found[1].log_weights, atol=1e-4, rtol=1e-3)


def test_evidence_adds_up_by_hand(toy, recordings):
    builder = sightings_of(toy, recordings, 3, [0, 1])
    evidence = evidence_of(builder)
    exact = torch.zeros(64)
    two = recordings.select_people([3]).select_rounds([0, 1])
    table = build_view_table(toy, two)
    for way in range(64):
        policy = {name: value[way] for name, value in evidence.ways.items()}
        likelihood = log_likelihoods(toy, policy, table)[0]
        views = table.index[0]
        exact[way] = torch.logsumexp(likelihood[views].sum(0) - math.log(7), 0)
    torch.testing.assert_close(evidence.log_evidence, exact, atol=1e-3, rtol=0)


def test_a_guide_learns_and_starts_at_the_prior_s_place(trained):
    guide, quality = trained
    assert quality["learned"] == pytest.approx(quality["prior_loss"] - quality["loss"])
    assert quality["learned"] > 0.3
    place = guide.density(torch.zeros(64), torch.tensor(0)).sample((2000,))
    assert place.shape == (2000, 2) and place.isfinite().all()


def test_the_guide_is_a_program_with_the_density_it_says(toy, recordings, network):
    evidence = evidence_of(sightings_of(toy, recordings, 0, [0]))
    log_evidence, steps = evidence.log_evidence[None], torch.tensor([evidence.steps])
    sites = scalar_sites(toy)
    trace = pyro.poutine.trace(network).get_trace(sites, log_evidence, steps)
    values = {site: trace.nodes[site]["value"] for site in RATES}
    place = unconstrained(sites, {site: value[None] for site, value in values.items()})
    expected = network.density(evidence.log_evidence, steps[0]).log_prob(place)
    for column, site in enumerate(sites.values()):
        value = site(place[:, column])
        expected = expected - site.log_abs_det_jacobian(place[:, column], value)
    found = trace.log_prob_sum()
    torch.testing.assert_close(found, expected.sum(), atol=1e-4, rtol=1e-4)


# --- files ------------------------------------------------------------------------------------


def test_a_guide_is_read_as_it_was_written(toy, network, tmp_path):
    path = tmp_path / "toy.safetensors"
    save_guide(network, toy, path, {"quality": {"loss": 1.0}})
    again, card = load_guide(path, toy)
    assert card == {"quality": {"loss": 1.0}}
    for name, value in network.state_dict().items():
        assert torch.equal(again.state_dict()[name], value)
    assert network_for("importance", path, toy) is None
    assert isinstance(network_for("amortized", path, toy), AmortizedGuide)


def test_auto_takes_importance_where_the_network_is_for_another_prior(monkeypatch):
    self_model, _ = load_self_model(shipped_weights("driving"), "driving")
    human = HumanModel(self_model)
    assert isinstance(network_for("auto", None, human), AmortizedGuide)
    record = replace(self_model.domain.record, consistency=4.0)
    monkeypatch.setattr(self_model.domain, "record", record, raising=False)
    assert network_for("auto", None, human) is None
    with pytest.raises(AssetError, match="is for another prior; .* or use the engine importance"):
        network_for("amortized", None, human)


def test_guides_of_something_else_are_refused(toy, network, tmp_path):
    path = tmp_path / "toy.safetensors"
    save_guide(network, toy, path, {})
    other = HumanModel(toy.self_model)
    with pytest.raises(AssetError, match="is for human model ToyHuman, not mirror; train a"):
        load_guide(path, other)
    less = ToyHuman(toy.self_model)
    less.likelihood_power = 0.25
    with pytest.raises(AssetError, match=r"is for likelihood power 1, not 0\.25; train a"):
        load_guide(path, less)

    class Changed(ToyHuman):
        def prior(self):
            rate = pyro.sample("in_sight", dist.Beta(5.0, 2.0))
            with pyro.poutine.block(hide=["in_sight"]):
                return super().prior() | {"in_sight": rate}

    Changed.__name__ = "ToyHuman"
    with pytest.raises(AssetError, match="is for another prior"):
        load_guide(path, Changed(toy.self_model))
    with pytest.raises(AssetError, match="not a guide of this program"):
        load_guide(shipped_weights("driving"), toy)
    path.write_bytes(b"nonsense")
    with pytest.raises(AssetError, match="cannot be read"):
        load_guide(path, toy)


def test_train_makes_a_guide_that_fit_and_calibrate_use(tmp_path, monkeypatch, capsys):
    (tmp_path / "toy.py").write_text(
        "from mirror_ppl.models.toy import ToyHuman\n\n\nclass Toy(ToyHuman):\n    pass\n"
    )
    monkeypatch.setattr(
        guide_training,
        "GuideOptions",
        lambda people, **others: replace(TRAINING, people=people, steps=50),
    )
    path, human = tmp_path / "guide.safetensors", ("--human-model", f"{tmp_path / 'toy.py'}:Toy")
    assert command(train, "--what", "guide", "--people", 40, *human, "--out", path) == 0
    out = capsys.readouterr().out
    assert "--what guide" in out and "--people 40" in out and "--phases" not in out
    assert "learned" in out
    assert command(train, "--card", path) == 0
    assert "nats a person" in capsys.readouterr().out
    assert [each.name for each in tmp_path.iterdir() if "checkpoint" in each.name] == []
    guide = ("--guide", "amortized", "--guide-file", path)
    small = ("--people", 10, "--rounds", 1, "--draws", 9, "--jobs", 1)
    assert command(calibrate_command, *human, *guide, *small, "--out", tmp_path / "c") == 0
    demos = tmp_path / "some.nc"
    assert command(simulate, "--people", 1, "--rounds", 2, "--out", demos) == 0
    fit_args = ("--demos", demos, "--draws", 9, "--explore", 0, "--out", tmp_path / "f")
    assert command(fit, *human, *guide, *fit_args) == 0
    summary = json.loads((tmp_path / "f" / "summary.json").read_text())
    assert summary["guide"] == "amortized"
    assert "pareto_k" in summary["people"][0]


def test_guides_are_trained_with_the_rules_learned_first(tmp_path, monkeypatch):
    """As fits infer people: the rules of the world are not up to the person."""
    trained = []

    def stop(human, *others):
        trained.append(human)
        raise HumanModelError("enough")

    monkeypatch.setattr(guide_training, "train_guide", stop)
    out = tmp_path / "guide.safetensors"
    assert command(train, "--what", "guide", "--domain", "bomb_defusal", "--out", out) == 2
    assert (trained[0].rule_logits.softmax(-1).amax(-1) > 0.9).all()


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--what", "nothing"), "--what must be self-model or guide, not nothing"),
        (("--what", "guide", "--dropout", "1"), "--dropout must be at least 0 and below 1, not 1"),
        (("--dropout", "0.5"), "--dropout is for --what guide"),
        (("--what", "guide", "--people", "3"), "--people must be at least 10, not 3"),
        (("--what", "guide", "--device", "cuda"), "--device is for --what self-model"),
        (("--what", "guide", "--phases", "3"), "--phases is for --what self-model"),
        (("--people", "30"), "--people is for --what guide"),
        (("--what", "guide", "--out", "."), "it is not a regular file"),
    ],
)
def test_impossible_trainings(args, message, tmp_path, capsys):
    assert command(train, "--out", tmp_path / "x", *args) == 2
    assert message in " ".join(capsys.readouterr().err.replace("│", " ").split())
