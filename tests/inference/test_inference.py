"""Inference of implants: exact posteriors, variational ones, their draws and predictions."""

import math
import re
from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from exact import log_joint, log_prior, marginals
from example_views import Few, Sure, log_likelihoods_by_hand, policies, ragged
from pyro.infer import TraceEnum_ELBO, config_enumerate
from scipy.stats import chi2

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.errors import CheckpointError
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.marginal_elbo import MarginalELBO
from mirror_ppl.inference.results.fitting import fit_people
from mirror_ppl.inference.svi import (
    SVIOptions,
    _prune,
    continuous_guide,
    draw_implants,
    fit_implants,
)
from mirror_ppl.likelihood.combinations import log_priors
from mirror_ppl.likelihood.compiled import Compiled, ViewTables
from mirror_ppl.likelihood.enumeration import combination_values, draw_combinations
from mirror_ppl.likelihood.predictive import predict_actions
from mirror_ppl.likelihood.table_program import TableProgram, log_likelihoods
from mirror_ppl.likelihood.tables import build_view_table, combination_scores, restricted
from mirror_ppl.likelihood.view_table import NO_VIEW
from mirror_ppl.models import HumanModel
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.progress import silent

DRIVING = get_domain("driving")
STEPS = DRIVING.horizon
LENGTHS = [[15, 15, 6], [], [15, 9]]
SITES = ("sight_front_own", "assumes_clear")
COMBINATIONS = dict(zip(SITES, torch.unravel_index(torch.arange(14), (7, 2)), strict=True))
PRIOR = torch.outer(torch.arange(1.0, 8) / 28, torch.tensor([0.3, 0.7])).flatten()


class Moody(Few):
    """Few, with discrete sites before and after theirs that perception does not depend on."""

    def prior(self):
        mood = pyro.sample("mood", dist.Categorical(torch.tensor([0.2, 0.5, 0.3])))
        own = super().prior()
        return own | {"mood": mood, "bold": pyro.sample("bold", dist.Bernoulli(0.4))}

    def act(self, implants, belief, values):
        factor = 1 + implants["bold"] + implants["mood"]
        return super().act(
            {**implants, "consistency": implants["consistency"] * factor}, belief, values
        )


class Nested(Few):
    """Few, but how likely each assumption is depends on a continuous site."""

    def prior(self):
        trust = pyro.sample("trust", dist.Beta(2.0, 2.0))
        own = super().prior()
        probabilities = torch.stack([1 - trust, trust], -1)
        own["assumes_clear"] = pyro.sample("assumes_clear_too", dist.Categorical(probabilities))
        return own | {"assumes_clear_too": own["assumes_clear"], "trust": trust}

    def perceive(self, implants, knowledge, observation, told, step):
        own = {site: implants[site] for site in ("sight_front_own", "assumes_clear_too")}
        own["assumes_clear"] = own["assumes_clear_too"]
        return super().perceive(own, knowledge, observation, told, step)


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


@pytest.fixture(scope="module")
def few(self_model):
    return Few(self_model)


@pytest.fixture(scope="module")
def recordings():
    return load_demonstrations(asset_path("driving_fog_paper.nc"))


@pytest.fixture(scope="module")
def rounds(recordings):
    return ragged(recordings, LENGTHS)


@pytest.fixture(scope="module")
def table(few, rounds):
    return build_view_table(few, rounds)


def some_policy(human, people=1):
    return {name: value[0] for name, value in policies(human, 1, people).items()}


def assert_follows(draws, probabilities, tests=1):
    """Draws ``[S]`` of indices follow these probabilities, by a chi-square test.

    Wrong once in 10,000 for all of the ``tests`` together. Cells that expect fewer than 5 are
    taken together.
    """
    expected = probabilities.double() / probabilities.double().sum() * len(draws)
    counts = torch.bincount(draws.flatten(), minlength=len(expected)).double()
    rare = expected < 5
    parts = [expected[~rare], expected[rare].sum()[None]], [counts[~rare], counts[rare].sum()[None]]
    expected, counts = (torch.cat(part) for part in parts)
    assert counts[-1] <= 0 or expected[-1] > 1e-3 * counts[-1]
    statistic = ((counts - expected) ** 2 / expected.clamp(min=1.0)).sum().item()
    assert statistic < chi2.isf(1e-4 / tests, len(expected))


# --- exact ------------------------------------------------------------------------------------


def log_prior_by_hand(policy):
    """Log prior density of the policy's implants, summed over people."""
    priors = {
        "consistency": dist.LogNormal(math.log(3.0), 0.5),
        "lapse": dist.Beta(1.0, 30.0),
        "residual_in": dist.Normal(0.0, 48**-0.5),
        "residual_out": dist.Normal(0.0, 0.1),
    }
    return sum(priors[name].log_prob(value).sum() for name, value in policy.items())


def bound_at(human, table, values):
    """The evidence lower bound with a guide that is certain of the continuous sites."""

    def guide(table):
        with pyro.plate("person", table.people, dim=-2):
            for name, value in values.items():
                pyro.sample(name, dist.Delta(value, event_dim=value.dim() - 2))

    model = config_enumerate(TableProgram(human), "parallel")
    return -TraceEnum_ELBO(max_plate_nesting=2).loss(model, guide, table)


def test_bound_at_a_point_is_the_exact_evidence(few, table):
    policy = some_policy(few, table.people)
    evidence = torch.logsumexp(log_joint(few, table, policy), -1)
    expected = log_prior_by_hand(policy) + evidence.sum()
    assert bound_at(few, table, policy) == pytest.approx(expected.item(), rel=1e-5)


def test_bound_at_a_point_is_the_exact_evidence_of_the_own_model(self_model, rounds):
    human = HumanModel(self_model)
    one = rounds.select_people([0]).select_rounds([0])
    table = build_view_table(human, one, [torch.arange(0, 9604, 7)])
    policy = some_policy(human)
    joint = log_joint(human, table, policy)
    assert (joint > -1e5).sum() == 9604 / 7
    expected = log_prior_by_hand(policy) + torch.logsumexp(joint, -1).sum()
    assert bound_at(human, table, policy) == pytest.approx(expected.item(), rel=1e-5)


def test_prior_of_combinations_by_hand(few, table):
    prior = log_prior(few, table, some_policy(few))
    torch.testing.assert_close(prior, PRIOR.log().expand(3, -1))


def test_prior_of_combinations_may_depend_on_other_sites(self_model, rounds):
    human = Nested(self_model)
    table = build_view_table(human, rounds)
    assert table.sites == ("sight_front_own", "assumes_clear_too")
    policy = some_policy(human, 3) | {"trust": torch.tensor([[0.1], [0.5], [0.8]])}
    trust = policy["trust"]
    probabilities = torch.stack([1 - trust, trust], -1)  # [P, 1, 2]
    expected = (torch.arange(1.0, 8)[:, None] / 28 * probabilities).log().flatten(1)
    torch.testing.assert_close(log_prior(human, table, policy), expected)


def test_marginals_equal_brute_force(few, table, rounds):
    policy = some_policy(few)
    found = marginals(table, log_joint(few, table, policy))
    for person, lengths in enumerate(LENGTHS):
        joint = PRIOR.log().clone()
        for number in range(len(lengths)):
            joint += log_likelihoods_by_hand(few, rounds, person, number, COMBINATIONS, policy)
        weights = joint.exp() / joint.exp().sum()
        for site in SITES:
            by_value = torch.zeros(table.sizes[SITES.index(site)])
            for weight, value in zip(weights, COMBINATIONS[site], strict=True):
                by_value[value] += weight
            torch.testing.assert_close(found[site][person], by_value, rtol=1e-3, atol=1e-5)
    # Of a person without rounds nothing is learned.
    torch.testing.assert_close(found["sight_front_own"][1], torch.arange(1.0, 8) / 28)


def fixed_policy(people, consistency):
    return {
        "consistency": consistency * torch.ones(people, 1),
        "lapse": torch.full((people, 1), 0.02),
        "residual_in": torch.zeros(people, 1, 49, 8),
        "residual_out": torch.zeros(people, 1, 9, 2),
    }


def test_people_of_the_model_are_recognized(few, generator):
    people, policy = 40, fixed_policy(40, 3.0)
    truth = torch.multinomial(PRIOR, people, replacement=True, generator=generator)
    implants = {site: value[truth] for site, value in COMBINATIONS.items()}
    known = policy | {site: value[:, None] for site, value in implants.items()}
    table = build_view_table(few, play_rounds(few, known, 10, "fog", generator))
    found = marginals(table, log_joint(few, table, policy))
    for site in SITES:
        p = found[site].double()
        right = p.gather(-1, implants[site][:, None]).squeeze(-1)
        # Truth and data are drawn together, so the truth is a draw from the posterior: its
        # probability has the mean sum p^2, and the variance sum p^3 - (sum p^2)^2.
        mean, variance = p.square().sum(-1), p.pow(3).sum(-1) - p.square().sum(-1).square()
        assert (right - mean).sum().abs() < 4.5 * variance.sum().sqrt()
        # It has more than half of the mass as often as the posterior itself says, which is for
        # most people.
        expected = torch.where(p.amax(-1) > 0.5, p.amax(-1), 0.0)
        error = 4.5 * (expected * (1 - expected)).sum().sqrt()
        assert ((right > 0.5).sum() - expected.sum()).abs() < error
        assert expected.mean() > 0.5


class Enumerated(ViewTables):
    """Draws discrete sites as programs do that are not compiled."""

    _with_discrete = Compiled._with_discrete


# --- draws ------------------------------------------------------------------------------------


def test_draws_of_combinations_follow_their_weights(few, table):
    joint = log_joint(few, table, some_policy(few))
    draws = draw_combinations(few, table, joint, 4000)
    assert draws["assumes_clear"].shape == (4000, 3, 1)
    combination = table.combination(draws)[..., 0]
    for person in range(3):
        assert_follows(combination[:, person], joint[person].softmax(-1), tests=3)


@pytest.mark.parametrize(("method", "calls"), [(ViewTables, 400), (Enumerated, 250)])
def test_both_ways_of_drawing_follow_the_exact_posterior(few, rounds, method, calls):
    table = build_view_table(few, rounds.select_people([0, 1]))
    policy = some_policy(few, 2)
    given = {name: value.expand(calls, *value.shape) for name, value in policy.items()}
    draws = method(few, table).sample_discrete(given)
    assert set(draws) == {*SITES, *policy}
    for name, value in policy.items():
        assert torch.equal(draws[name], value.expand(len(draws[name]), *value.shape))
    combination = table.combination(draws)[..., 0]
    joint = log_joint(few, table, policy)
    for person in range(2):
        assert_follows(combination[:, person], joint[person].softmax(-1), tests=4)


def test_sites_beyond_perception_are_drawn_with_it(self_model, rounds):
    human = Moody(self_model)
    table = build_view_table(human, rounds.select_people([0]))
    assert table.sites == SITES
    policy = some_policy(human)
    given = {name: value.expand(300, *value.shape) for name, value in policy.items()}
    draws = ViewTables(human, table).sample_discrete(given)
    draws = {name: value[:, 0, 0] for name, value in draws.items()}
    weights = torch.zeros(14, 3, 2)
    for mood, chance in enumerate((0.2, 0.5, 0.3)):
        for bold, other in enumerate((0.6, 0.4)):
            given = {"mood": torch.full((1, 1), mood), "bold": torch.full((1, 1), float(bold))}
            joint = log_joint(human, table, policy | given)[0]
            weights[:, mood, bold] = joint.exp() * chance * other
    index = (table.combination(draws) * 3 + draws["mood"]) * 2 + draws["bold"].long()
    assert_follows(index, weights.flatten())


def test_draws_are_as_many_as_asked_for(few, table):
    with pyro.settings.context(module_local_params=True):
        compiled = ViewTables(few, table)
        draws = draw_implants(compiled, continuous_guide(compiled), 10)
    assert {name: value.shape[:3] for name, value in draws.items()} == dict.fromkeys(
        [*SITES, "consistency", "lapse", "residual_in", "residual_out"], (10, 3, 1)
    )
    assert len(draws["consistency"][:, 0, 0].unique()) == 10  # each a draw of its own


def test_prior_draws_are_those_of_the_program(self_model, rounds):
    human = Moody(self_model)
    table = build_view_table(human, rounds)
    torch.manual_seed(1)
    draws = draw_prior(human, table.people, 2000, seed=4)
    torch.manual_seed(2)
    again = draw_prior(human, table.people, 2000, seed=4)
    assert all(torch.equal(value, again[name]) for name, value in draws.items())
    assert list(draws)[:3] == ["mood", *SITES]
    assert draws["residual_out"].shape == (2000, 3, 1, 9, 2)
    assert_follows(table.combination(draws)[:, 0, 0], PRIOR, tests=3)
    assert_follows(draws["mood"][:, 1, 0], torch.tensor([0.2, 0.5, 0.3]), tests=3)
    assert_follows(draws["bold"][:, 2, 0].long(), torch.tensor([0.6, 0.4]), tests=3)
    # The logarithm of consistency is normal about log 3 with 0.5.
    logs = draws["consistency"].log()
    assert logs.mean().item() == pytest.approx(math.log(3), abs=4.5 * 0.5 / math.sqrt(6000))
    assert logs.std().item() == pytest.approx(0.5, abs=4.5 * 0.5 / math.sqrt(12_000))


def test_predictions_agree_with_perceive_believe_act(few, rounds):
    table = build_view_table(few, rounds)
    combinations = torch.randint(14, (5, 3, 1))
    draws = {site: value[combinations] for site, value in COMBINATIONS.items()}
    draws |= policies(few, 5, 3)
    found = predict_actions(few, table, draws)
    assert found.shape == (5, 3, 3, STEPS, 2)
    torch.testing.assert_close(found.exp().sum(-1), torch.ones(5, 3, 3, STEPS))
    chosen = found.gather(-1, table.recorded[..., None].expand(5, -1, -1, -1, -1)).squeeze(-1)
    chosen = torch.where(table.steps, chosen, 0.0).sum(-1)
    for draw in range(5):
        for person, lengths in enumerate(LENGTHS):
            values = {site: draws[site][draw, person] for site in SITES}
            policy = {
                name: value[draw, person][None]
                for name, value in draws.items()
                if name not in SITES
            }
            for number in range(len(lengths)):
                expected = log_likelihoods_by_hand(few, rounds, person, number, values, policy)
                torch.testing.assert_close(
                    chosen[draw, person, number], expected[0], rtol=1e-4, atol=1e-4
                )


# --- variational ------------------------------------------------------------------------------


TINY = SVIOptions(steps=6, checkpoint_every=2, prune_every=2, prune_margin=1.0)
TINY_SVI = InferenceOptions("svi", 9, TINY)


def tiny(few, table, seed=3, report=silent, checkpoint=None):
    return fit_implants(ViewTables(few, table), TINY, 9, seed, report, checkpoint)


def assert_same(one, other):
    assert one.losses == other.losses
    assert list(one.draws) == list(other.draws)
    for name, value in one.draws.items():
        assert torch.equal(value, other.draws[name]), name


def stop_at(step):
    def report(name, done, total, message):
        if (name, done) == ("fit", step):
            raise KeyboardInterrupt

    return report


@pytest.fixture(scope="module")
def tiny_fit(few, table):
    return tiny(few, table)


def test_vectors_start_as_wide_as_their_prior_and_single_numbers_narrow(few, table):
    guide = continuous_guide(ViewTables(few, table))
    expected = {"residual_in": 48**-0.5, "residual_out": 0.1}
    for name in ("consistency", "lapse"):
        torch.testing.assert_close(getattr(guide.scales, name), torch.full((3, 1), 0.1))
    for name, scale in expected.items():
        found = getattr(guide.scales, name)
        assert found.shape[:2] == (3, 1)
        # Estimated from 100 draws of three people: 4 standard errors are a quarter of it or less.
        assert found.mean().item() == pytest.approx(scale, rel=0.25)
    centre = guide.median()
    assert (centre["consistency"] - 3.0).abs().max() < 1.0  # the median of 15 draws
    assert centre["lapse"].max() < 0.1


def test_fit_depends_on_its_seed_alone(few, table, tiny_fit):
    torch.manual_seed(5)
    state = torch.random.get_rng_state()
    assert_same(tiny(few, table), tiny_fit)
    assert torch.equal(torch.random.get_rng_state(), state)
    other = tiny(few, table, seed=4)
    assert other.losses != tiny_fit.losses
    assert len(other.losses) == 6
    assert not list(pyro.get_param_store().keys())


@pytest.mark.parametrize("stop", [3, 5, 6])
def test_fit_goes_on_from_its_checkpoint_as_if_never_stopped(few, table, tiny_fit, tmp_path, stop):
    checkpoint, steps = (tmp_path / "fit.checkpoint", "this run"), []
    with pytest.raises(KeyboardInterrupt):
        tiny(few, table, 3, stop_at(stop), checkpoint)

    def report(name, done, total, message):
        if name == "fit":
            steps.append(done)

    resumed = tiny(few, table, 3, report, checkpoint)
    assert steps == list(range(2 * ((stop - 1) // 2) + 1, 7))
    assert_same(resumed, tiny_fit)
    # Killed after the last step, before the results were written: only the draws are made again.
    steps.clear()
    assert_same(tiny(few, table, 3, report, checkpoint), tiny_fit)
    assert steps == []


def test_checkpoint_of_another_fit_is_refused(few, recordings, tmp_path):
    path = tmp_path / "fit.checkpoint"
    some = recordings.select_people([0]).select_rounds(range(2))

    def fit(human=few, demonstrations=some, options=TINY_SVI, seed=0, report=lambda *done: None):
        fit_people(human, demonstrations, options, seed, 2, report, path)

    with pytest.raises(KeyboardInterrupt):
        fit(report=stop_at(3))
    content = path.read_bytes()
    for other in (
        {"seed": 1},
        {"options": replace(TINY_SVI, draws=10)},
        {"human": Sure(few.self_model)},
        {"demonstrations": recordings.select_people([1]).select_rounds(range(2))},
    ):
        with pytest.raises(CheckpointError, match="belongs to a run with other"):
            fit(**other)
        assert path.read_bytes() == content
    for damaged in (content[: len(content) // 2], b"", b"nonsense"):
        path.write_bytes(damaged)
        with pytest.raises(CheckpointError, match=re.escape(str(path))):
            fit()


def test_pruning_gives_up_whoever_is_hopeless(few, table):
    policy = some_policy(few, 3)
    one = {name: value[None] for name, value in policy.items()}
    score = combination_scores(table, log_likelihoods(few, policy, table))
    score = score + log_priors(few, combination_values(few, table), one, 3)[0]
    behind = score.amax(-1, keepdim=True) - score
    margin = behind[behind > 0].median().item() + 1e-3
    compiled = ViewTables(few, table)
    _prune(compiled, lambda: policy, margin)
    pruned = compiled.table
    alive = (pruned.index != NO_VIEW).any(1)
    assert torch.equal(alive, behind <= margin)
    assert alive[1].sum() >= alive.sum(1).max()  # nothing is known of them but the prior
    assert 0 < (~alive).sum() < alive.sum()
    # Whoever was given up is never drawn.
    given = {name: value.expand(20, *value.shape) for name, value in policy.items()}
    combination = pruned.combination(compiled.sample_discrete(given))[..., 0]
    some = torch.tensor([0, 2])  # the other one has no rounds, of which views could be given up
    assert alive[some.expand(20, 2), combination[:, some]].all()


def test_fit_recovers_consistency_and_reach(few, generator):
    # One decides nearly at random, the other nearly perfectly; they see 1 cell and everything.
    known = fixed_policy(2, torch.tensor([[0.5], [6.0]]))
    known |= {"sight_front_own": torch.tensor([[1], [6]]), "assumes_clear": torch.ones(2, 1)}
    table = build_view_table(few, play_rounds(few, known, 8, "fog", generator))
    posterior = fit_implants(ViewTables(few, table), SVIOptions(steps=60), 200, seed=0)
    low, high = posterior.draws["consistency"][..., 0].unbind(1)
    assert low.quantile(0.95) < high.quantile(0.05)
    assert sum(posterior.losses[-10:]) < sum(posterior.losses[:10])
    assert (posterior.draws["sight_front_own"][:, 1, 0] >= 4).float().mean() > 0.9


def test_people_without_discrete_implants_can_be_fitted(self_model, recordings):
    human = Sure(self_model)
    some = recordings.select_people([0, 1]).select_rounds(range(3))
    fit = fit_people(human, some, TINY_SVI, seed=0, train_rounds=2)
    assert set(fit.posterior.draws) == {"consistency", "lapse", "residual_in", "residual_out"}
    assert [list(person["implants"]) for person in fit.summary["people"]] == [
        ["consistency", "lapse"]
    ] * 2


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("steps", 0, "steps must be at least 1, not 0"),
        ("prune_every", -3, "prune_every must be at least 1, not -3"),
        ("learning_rate", 0.0, "learning_rate must be above 0 and at most 1, not 0.0"),
    ],
)
def test_impossible_options_are_refused(name, value, message):
    with pytest.raises(ValueError, match=message):
        SVIOptions(**{name: value})


def test_people_are_fitted_in_batches_that_do_not_depend_on_each_other(
    self_model, tmp_path, monkeypatch
):
    from mirror_ppl.inference import batches

    human = HumanModel(self_model)
    recordings = load_demonstrations(asset_path("driving_fog_paper.nc")).select_rounds([0])
    recordings = recordings.select_people([0, 1, 2])
    options = InferenceOptions("svi", 6, SVIOptions(steps=4, checkpoint_every=2))
    monkeypatch.setattr(batches, "PEOPLE_AT_ONCE", 2)
    found = infer(human, recordings, options, 3)
    first = infer(human, recordings.select_people([0, 1]), options, 3)
    last = infer(human, recordings.select_people([2]), options, 3 + 2)
    for name, value in found.draws.items():
        assert torch.equal(value, torch.cat([first.draws[name], last.draws[name]], 1))
    assert found.losses == pytest.approx(
        [one + other for one, other in zip(first.losses, last.losses, strict=True)]
    )
    # Stopped in the second batch and continued, it is the same, and leaves one file.
    path = tmp_path / "some.checkpoint"

    def stop(name, done, total, message):
        if name == "fit" and done == 3 and (tmp_path / "some.checkpoint.2").exists():
            raise KeyboardInterrupt

    def refuse(name, done, total, message):
        raise AssertionError("work was begun")

    with pytest.raises(KeyboardInterrupt):
        infer(human, recordings, options, 3, report=stop, checkpoint=(path, "run"))
    assert len(list(tmp_path.iterdir())) == 2
    again = infer(human, recordings, options, 3, checkpoint=(path, "run"))
    assert all(torch.equal(again.draws[name], value) for name, value in found.draws.items())
    path.write_bytes(b"nonsense")
    with pytest.raises(CheckpointError):
        infer(human, recordings, options, 3, checkpoint=(tmp_path / "some.checkpoint", "run"))
    with pytest.raises(CheckpointError):  # of the second batch, before the first is begun
        infer(human, recordings, options, 3, report=refuse, checkpoint=(path, "another"))


def test_the_marginal_elbo_is_that_of_enumeration(self_model):
    """Loss and gradients, before and after giving up combinations."""
    human = HumanModel(self_model)
    recordings = load_demonstrations(asset_path("driving_fog_paper.nc")).select_people([0, 4])
    table = build_view_table(human, recordings.select_rounds([0, 1]))
    alive = torch.zeros(2, 9604, dtype=torch.bool)
    alive[0, ::97] = alive[1, ::53] = True
    for some in (table, restricted(table, alive)):
        compiled = ViewTables(human, some)
        guide, found = continuous_guide(compiled), []
        enumerated = TraceEnum_ELBO(max_plate_nesting=2, strict_enumeration_warning=False)
        for elbo in (MarginalELBO(compiled), enumerated):
            guide.zero_grad()
            torch.manual_seed(3)
            with pyro.settings.context(module_local_params=True):
                program = config_enumerate(compiled.program, "parallel")
                value = elbo.differentiable_loss(program, guide)
            value.backward()
            found.append([value.detach(), *(p.grad.clone() for p in guide.parameters())])
        for one, other in zip(*found, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3)
