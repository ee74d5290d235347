"""Variants of the human model: what each is the special case of."""

import json

import pytest
import torch
from running import command

from mirror_ppl.commands import assist, fit, simulate
from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.combinations import perceived_sites
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.likelihood.grid import combination_number
from mirror_ppl.likelihood.table_program import log_likelihoods
from mirror_ppl.likelihood.tables import build_view_table, combination_scores
from mirror_ppl.models import HumanModel
from mirror_ppl.models.implants import NOTICES, assumption_sites, sight_sites
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import sample_sites
from mirror_ppl.models.variants import VARIANTS
from mirror_ppl.models.weights import load_self_model, shipped_weights

POLICY = {"consistency", "lapse", "residual_in", "residual_out"}
PREFERENCES = {"shares_goal", "prefers_switch"}


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


@pytest.fixture(scope="module")
def rounds():
    recordings = load_demonstrations(asset_path("driving_fog_diverse.nc"))
    return recordings.select_people([0, 1]).select_rounds([0, 1])


@pytest.mark.parametrize("name", VARIANTS)
def test_variants_keep_the_contract(self_model, name):
    human = load_human_model(name, self_model)
    check_contract(human)
    assert human.domain.name == "driving"
    beliefs = {"late": 4, "noticing": 4, "forgetting": 4, "all": 10}
    assert human.belief_size == beliefs.get(name, 1) * self_model.latent


def test_the_sites_of_each(self_model):
    domain = self_model.domain
    sights, assumed = set(sight_sites(domain)), set(assumption_sites(domain))
    choice = {"consistency", "lapse"}
    expected = {
        "mirror": sights | assumed | POLICY,
        "one-radius": {"sight_radius"} | assumed | POLICY,
        "per-item": {NOTICES + car for car in domain.modalities[0].items} | assumed | POLICY,
        "perceptual-only": sights | assumed | choice,
        "policy-only": POLICY,
        "no-implants": choice,
        "late": sights | assumed | POLICY | {"late"},
        "noticing": sights | assumed | POLICY | {"notices"},
        "forgetting": sights | assumed | POLICY | {"forgets"},
        "preferring": sights | assumed | POLICY | PREFERENCES,
        "hard-of-hearing": sights | assumed | POLICY | {"hears_visual", "hears_verbal"},
        "all": sights | assumed | POLICY | PREFERENCES | {"late", "notices", "forgets", "kind"},
    }
    found = {name: set(sample_sites(VARIANTS[name](self_model), 1)) for name in VARIANTS}
    assert found == expected
    read = {name: len(perceived_sites(VARIANTS[name](self_model))) for name in VARIANTS}
    assert list(read.values()) == [6, 3, 2, 6, 0, 0, 6, 6, 6, 6, 8, 6]


def scores(human, rounds, policy, combinations=None):
    table = build_view_table(human, rounds, combinations)
    return combination_scores(table, log_likelihoods(human, policy, table))


def test_variants_are_special_cases(self_model, rounds):
    human = HumanModel(self_model)
    policy = {
        name: node["value"] for name, node in sample_sites(human, 2).items() if name in POLICY
    }
    sizes = {name: len(support) for name, support in perceived_sites(human).items()}
    sights, assumed = sight_sites(human.domain), assumption_sites(human.domain)
    # One radius: thresholds that are all the same.
    radius, clear, closing = torch.meshgrid(
        torch.arange(7), torch.arange(2), torch.arange(2), indexing="ij"
    )
    same = dict.fromkeys(sights, radius.flatten())
    same |= dict(zip(assumed, (clear.flatten(), closing.flatten()), strict=True))
    number = combination_number(same, sizes)
    expected = scores(human, rounds, policy, [number.unique()] * 2)[:, number]
    found = scores(VARIANTS["one-radius"](self_model), rounds, policy)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
    assert found.std(-1).min() > 0.1
    # Policy only: sees everything, so that there is nothing to be assumed.
    everything = {site: torch.tensor([6]) for site in sights}
    everything |= {site: torch.tensor([0]) for site in assumed}
    number = combination_number(everything, sizes)
    expected = scores(human, rounds, policy, [number] * 2)[:, number]
    found = scores(VARIANTS["policy-only"](self_model), rounds, policy)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
    # Without a residual: one whose weights are zero.
    zero = policy | {name: 0 * policy[name] for name in ("residual_in", "residual_out")}
    choice = {name: policy[name] for name in ("consistency", "lapse")}
    some = [torch.arange(0, 9604, 97)] * 2
    torch.testing.assert_close(
        scores(VARIANTS["perceptual-only"](self_model), rounds, choice, some)[:, some[0]],
        scores(human, rounds, zero, some)[:, some[0]],
        rtol=1e-4,
        atol=1e-4,
    )
    found = scores(VARIANTS["no-implants"](self_model), rounds, choice)
    expected = scores(human, rounds, zero, [number] * 2)[:, number]
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("guide", ["importance", "svi"])
def test_a_variant_is_fitted_and_advises(tmp_path, monkeypatch, guide):
    """``no-implants``, ``per-item`` and ``one-radius`` are fitted; the last two also advise.

    What advises is a posterior file, which does not depend on the guide.
    """
    monkeypatch.chdir(tmp_path)
    assert command(simulate, "--people", 1, "--rounds", 2, "--out", "people.nc") == 0
    advises = ("per-item", "one-radius") if guide == "importance" else ()
    for name in dict.fromkeys(("no-implants", "one-radius", *advises)):
        given = "--human-model", name, "--demos", "people.nc"
        quick = ("--steps", 2) if guide == "svi" else ()
        status = command(
            fit, *given, "--guide", guide, "--train-rounds", 1, "--draws", 8, *quick,
            "--explore", 0, "--out", name,
        )  # fmt: skip
        assert status == 0
    people = json.loads((tmp_path / "one-radius" / "summary.json").read_text())["people"]
    bins = load_self_model(shipped_weights("driving"))[0].domain.reach_bins
    assert {person["implants"]["sight_radius"]["median"] for person in people} <= set(bins)
    for name in advises:
        status = command(
            assist, "--posterior", f"{name}/posterior.nc", "--human-model", name, "--rounds", 1,
            "--communicator", "none", "mirror", "--jobs", 1, "--draws", 8, "--horizon", 2,
        )  # fmt: skip
        assert status == 0


def test_names_that_are_no_variant(self_model):
    with pytest.raises(HumanModelError, match="none of mirror, one-radius, per-item, perc"):
        load_human_model("two-radii", self_model)
