"""Combinations that nothing recorded tells apart: sets of them, and draws from these."""

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_views import Few
from scipy.stats import chisquare

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.sampler import Sampler
from mirror_ppl.likelihood.combination_sets import EquivalentCombinations, fixed_prior
from mirror_ppl.likelihood.combinations import perceived_sites
from mirror_ppl.likelihood.enumeration import log_joints
from mirror_ppl.likelihood.grid import grid_of
from mirror_ppl.likelihood.tables import build_view_table
from mirror_ppl.models import HumanModel
from mirror_ppl.models.weights import load_self_model, shipped_weights


class Cautious(Few):
    """Few, but one in fifty is cautious, and hardly ever sees far."""

    def prior(self):
        own = super().prior()
        cautious = pyro.sample("cautious", dist.Bernoulli(0.02))
        near = torch.tensor([5.0, 1, 1, 1, 1, 1, 1]).log() * cautious[..., None]
        sight = pyro.sample("sight_of_them", dist.Categorical(logits=near))
        return own | {"cautious": cautious, "sight_of_them": sight}

    def perceive(self, implants, knowledge, observation, told, step):
        own = {"sight_front_own": implants["sight_of_them"]}
        own["assumes_clear"] = implants["assumes_clear"]
        return super().perceive(own, knowledge, observation, told, step)


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


@pytest.fixture(scope="module")
def one():
    recordings = load_demonstrations(asset_path("driving_fog_paper.nc"))
    return recordings.select_people([0]).select_rounds([3])


def prior_of(human):
    return fixed_prior(human, grid_of(perceived_sites(human)))


def test_priors_that_depend_on_others_are_noticed(self_model):
    """Also on a discrete site that is hardly ever 1; the same at every call."""
    assert prior_of(Cautious(self_model)) is None
    state = torch.random.get_rng_state()
    found = prior_of(HumanModel(self_model))
    assert torch.equal(torch.random.get_rng_state(), state)
    assert found is not None
    torch.testing.assert_close(found.exp().sum(), torch.tensor(1.0))
    expected = torch.outer(torch.arange(1.0, 8) / 28, torch.tensor([0.3, 0.7])).flatten().log()
    few = prior_of(Few(self_model))
    assert few is not None
    torch.testing.assert_close(few, expected)


def test_sets_are_those_that_have_seen_the_same(self_model, one):
    human = Few(self_model)
    table = build_view_table(human, one)
    prior = prior_of(human)
    assert prior is not None
    alike = EquivalentCombinations.of(table, prior)
    rows = [tuple(row) for row in table.index[0].T.tolist()]
    sets = {}
    for number, row in enumerate(rows):
        sets.setdefault(row, []).append(number)
    assert 1 < len(sets) < 14
    assert alike.first.tolist() == [members[0] for members in sets.values()]
    begin = 0
    for place, members in enumerate(sets.values()):
        end = int(alike.end[place])
        assert sorted(alike.members[begin:end].tolist()) == members
        assert float(alike.log_prior[place].exp()) == pytest.approx(
            float(prior[members].exp().sum())
        )
        begin = end
    some = torch.arange(len(alike)) % 2 == 0
    kept = alike.kept(some)
    assert kept.first.tolist() == alike.first[some].tolist()
    left = [members for members, chosen in zip(sets.values(), some, strict=True) if chosen]
    assert sorted(kept.members.tolist()) == sorted(sum(left, []))
    assert kept.sizes.tolist() == [len(members) for members in left]


def test_members_are_drawn_by_their_prior(self_model, one):
    human = Few(self_model)
    prior = prior_of(human)
    assert prior is not None
    whole = EquivalentCombinations.of(build_view_table(human, one), prior)
    for alike in (whole, whole.kept(torch.arange(len(whole)) > 0)):
        torch.manual_seed(0)
        sets = torch.arange(len(alike)).repeat_interleave(4000)
        drawn = alike.draw(sets).view(len(alike), 4000)
        begin = alike.end - alike.sizes
        for place in range(len(alike)):
            members = alike.members[begin[place] : alike.end[place]]
            assert torch.isin(drawn[place], members).all()
            probabilities = prior[members].double().softmax(0)
            counts = (drawn[place][:, None] == members).sum(0).double()
            if len(members) > 1:
                assert chisquare(counts.numpy(), (4000 * probabilities).numpy()).pvalue > 1e-4


def test_weights_of_sets_are_those_of_all_combinations(self_model, one):
    human = Few(self_model)
    table = build_view_table(human, one)
    sampler = Sampler(human, table)
    torch.manual_seed(0)
    sampler.draw(20)
    found = sampler.weighted()
    every = log_joints(human, table, found.policy)[:, 0]
    torch.testing.assert_close(found.log_joint.logsumexp(-1), every.logsumexp(-1))
    drawn = found.sample(4000, table.grid)
    probabilities = (found.log_weights.exp()[:, None] * every.double().softmax(-1)).sum(0)
    number = drawn["sight_front_own"] * 2 + drawn["assumes_clear"]
    share = torch.bincount(number.flatten(), minlength=14) / 4000
    # Of 20 draws, resampled: what is left is the noise of drawing combinations.
    assert (share - probabilities).abs().max() < 5 * (0.25 / 4000) ** 0.5


@pytest.mark.filterwarnings("ignore::mirror_ppl.errors.UnreadSite")
def test_rare_policies_stay_rare(self_model, one):
    for seed in range(3):
        found = infer(Cautious(self_model), one, InferenceOptions(draws=400), seed).draws
        assert float((found["cautious"] == 1).double().mean()) < 0.15


def test_values_of_all_kinds_make_one_grid():
    grid = grid_of({"a": torch.tensor([0.0, 1.0]), "b": torch.arange(3)})
    assert grid["a"].tolist() == [0, 0, 0, 1, 1, 1] and grid["b"].tolist() == [0, 1, 2] * 2
    assert grid["a"].is_floating_point() and not grid["b"].is_floating_point()
    assert grid_of({}) == {}
