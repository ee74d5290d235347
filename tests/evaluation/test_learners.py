"""Learners that are compared: what they get to see of whom, and what they make of it."""

import math
from dataclasses import astuple, replace

import pytest
import torch
from example_groups import FOG, FewReaches, Shipped, worst

from mirror_ppl.baselines import NetworkPerson, as_one_person, held_out_nll
from mirror_ppl.baselines.training import mean_nll
from mirror_ppl.domains import DOMAINS, get_domain
from mirror_ppl.domains.bomb_defusal import BombDefusal
from mirror_ppl.domains.bomb_defusal.panel import OLD_RULES, RULES
from mirror_ppl.errors import InputError
from mirror_ppl.evaluation import learners
from mirror_ppl.evaluation.known_sight import known_sight
from mirror_ppl.evaluation.learned import NETWORK_DRAWS
from mirror_ppl.evaluation.learners import TEST, Group, learn
from mirror_ppl.evaluation.study import Prediction, predict
from mirror_ppl.inference.engines import InferenceOptions, Inferred, infer
from mirror_ppl.inference.results.fitting import fit_people
from mirror_ppl.inference.svi import SVIOptions
from mirror_ppl.models.implants import in_units
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.world_knowledge import planning_domain
from mirror_ppl.people import simulate

GROUP = Group("driving", "fog", "diverse", 3, 100)


def test_everybodys_rounds_are_one_persons():
    rounds = GROUP.recordings().select_rounds(slice(2))
    together = as_one_person(rounds)
    assert (together.people, together.shape[1]) == (("everybody",), 6)
    for person in range(3):
        own = slice(2 * person, 2 * person + 2)
        assert torch.equal(together.actions[0, own], rounds.actions[person])
        assert torch.equal(together.ego[0, own], rounds.ego[person])
    assert together.truth == {}


def test_a_pooled_network_learns_from_everybody_and_is_everybodys():
    """Others' rounds change what is predicted, and people alike are predicted alike."""
    test = GROUP.recordings().select_rounds(slice(30, 31))
    pooled = learn("bc-pooled", GROUP, 2, 0)
    first, second, third = pooled.ensemble[0].weights["output"]  # pyright: ignore
    assert torch.equal(first, second)
    assert torch.equal(second, third)
    alone = learn("bc", GROUP, 2, 0)
    assert not torch.allclose(pooled.log_predictive(test), alone.log_predictive(test))


def test_an_ensemble_predicts_the_mean_of_its_networks():
    test = GROUP.recordings().select_rounds(slice(30, 32))
    found = learn("bc", GROUP, 1, 0, members=3)
    each = [one.log_probabilities(test).exp() for one in found.ensemble]  # pyright: ignore
    assert not torch.allclose(each[0], each[1])
    torch.testing.assert_close(found.log_predictive(test).exp(), sum(each) / 3)
    assert held_out_nll(found.ensemble[0], test).shape == (3,)  # pyright: ignore
    # The first is the network that is compared by itself.
    alone = learn("bc", GROUP, 1, 0)
    torch.testing.assert_close(alone.log_predictive(test).exp(), each[0])


def test_base_rates_are_counts_with_half_an_action_more():
    train = GROUP.recordings().select_rounds(slice(2))
    found = learn("base-rate", GROUP, 2, 0).log_predictive(train).exp()
    stayed = (train.actions[0] == 0).sum() + 0.5
    assert found[0, 1, 3, 0] == pytest.approx(float(stayed / (train.mask[0].sum() + 1)))
    torch.testing.assert_close(found.sum(-1), torch.ones(train.shape))


def test_without_rounds_there_is_the_prior():
    found = learn("no-implants", GROUP, 0, 0)
    spread = found.draws["consistency"].log().std()  # pyright: ignore[reportAttributeAccessIssue]
    assert spread == pytest.approx(0.5, abs=0.05)  # its standard error is .5 / sqrt(2 * 600) = .014


def test_whose_sight_is_known_has_it():
    """Drawn as it is, and what is left is inferred: the threshold is that of the recording."""
    one = GROUP.recordings().select_rounds(slice(1)).select_people([0])
    human = known_sight(GROUP.self_model, one)
    drawn = infer(human, one, InferenceOptions("importance", draws=20), 0).draws
    for site, value in in_units(get_domain("driving"), drawn).items():
        if site in one.truth and site != "consistency":
            assert torch.equal(value.double().unique(), one.truth[site].double()), site
    assert len(drawn["consistency"].unique()) > 1


def test_of_whom_it_is_not_known_what_they_see_is_refused():
    one = simulate("bomb_defusal", None, "paper", 1, 1, 100)
    with pytest.raises(InputError) as error:
        known_sight(Group("bomb_defusal", "unlabelled", "paper", 1, 0).self_model, one)
    assert str(error.value) == "recordings of bomb_defusal lack the truth of what people see"


def test_mirror_predicts_what_a_fit_predicts():
    """NLL and floor of the study agree with the summary of `fit_people` with the same seed."""
    group = FewReaches(*astuple(FOG))  # which is quick
    human = load_human_model(None, group.self_model)
    fit = fit_people(human, group.recordings(), InferenceOptions(), seed=3, train_rounds=2)
    rows = predict(Prediction(group, "mirror", 2))
    assert [row["person"] for row in rows] == ["person-01", "person-02"]
    found = learn("mirror", group, 2, 3)
    test = group.recordings().select_rounds(TEST)
    own = found.log_predictive(test).gather(-1, test.actions[..., None]).squeeze(-1)
    for number, person in enumerate(fit.summary["people"]):
        assert -own[number].mean().item() == pytest.approx(person["test"]["nll"], abs=1e-5)
    assert {row["floor"] for row in rows} == {p["test"]["floor"] for p in fit.summary["people"]}


def in_few_steps(human, rounds, options, *args, **others):
    """Infer as asked, but with fewer gradient steps, which suffice to learn something."""
    if options.engine == "svi":
        options = replace(options, settings=SVIOptions(steps=30))
    return infer(human, rounds, options, *args, **others)


@pytest.mark.parametrize(
    ("name", "domain"),
    [
        # On the highway it takes minutes; tests/domains/highway infers a driver.
        *(("perceptual-only", domain) for domain in DOMAINS if domain != "highway"),
        *(("policy-only", domain) for domain in DOMAINS),
        *(("no-implants", domain) for domain in DOMAINS),
        *(("logistic", domain) for domain in DOMAINS),
        *(("bc", domain) for domain in DOMAINS),
        # Others take long, and share their code with these.
        ("mirror-amortized", "driving"),
        ("mirror-svi", "driving"),
        ("mirror-svi", "search_rescue"),
        ("sqil", "driving"),
    ],
)
def test_everybody_learns_everywhere(name, domain, monkeypatch):
    """One person, one round (eight, where there is much to learn): probabilities of all actions of
    held-out rounds, and better ones than if all were alike."""
    monkeypatch.setattr(learners, "infer", in_few_steps)
    group = Shipped(domain, worst(domain), "paper", 1, 0)
    test, actions = group.recordings().select_rounds(slice(30, 32)), get_domain(domain).actions
    few = 8 if name == "bc" or (name, domain) == ("logistic", "highway") else 1
    found = learn(name, group, few, 0).log_predictive(test)
    assert found.shape == (*test.shape, len(actions))
    torch.testing.assert_close(found.exp().sum(-1), torch.ones(test.shape), rtol=0, atol=1e-4)
    assert mean_nll(found, test.actions).item() < math.log(len(actions))


@pytest.mark.parametrize(
    ("name", "guide"),
    [("mirror", "importance"), ("mirror-amortized", "amortized")]
    + [(f"mirror-{guide}", guide) for guide in ("svi", "nuts")],
)
def test_mirror_is_inferred_by_the_guide_of_its_name(name, guide, monkeypatch):
    asked = []

    def noted(human, rounds, options, *args, **others):
        asked.append(options.engine)
        return Inferred({})

    monkeypatch.setattr("mirror_ppl.evaluation.learners.infer", noted)
    learn(name, FOG, 1, 0)
    assert asked == [guide]


def test_a_population_is_learned_from_others(monkeypatch):
    """One population, of as many people in the same setting, is the prior for all seeds."""
    asked = []

    def spying(human, rounds, options, seed, network=None, population=None):
        asked.append((rounds, options.pooling, population))
        return Inferred({}, population="theirs")  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(learners, "infer", spying)
    learners.population_of.cache_clear()
    try:
        for seed in (4, 5):
            learn("mirror-population", replace(FOG, seed=seed), 3, 0)
    finally:
        learners.population_of.cache_clear()
    (others, pooling, unknown), *own = asked
    assert (pooling, unknown) == ("partial", None)
    assert others.shape[:2] == (2, 20) and others.setting == "fog"
    for (rounds, pooling, known), seed in zip(own, (4, 5), strict=True):
        assert (pooling, known) == ("none", "theirs")
        expected = replace(FOG, seed=seed).recordings().select_rounds(slice(3))
        assert torch.equal(rounds.actions, expected.actions)
        assert not torch.equal(others.actions[:, :3], rounds.actions)


def test_baselines_know_what_rewards_identify_of_the_world(monkeypatch):
    """Recorded rewards say that the robot's rules are out of date; each planner gets to know it."""
    baselines = {"bc": {"epochs": 1}}  # actions do not say it
    monkeypatch.setattr(BombDefusal, "record", replace(BombDefusal.record, baselines=baselines))
    group = Group("bomb_defusal", "unlabelled", "paper", 2, 0)
    person = learn("bc", group, 20, 0).person(1, 3)  # pyright: ignore[reportAttributeAccessIssue]
    assert isinstance(person.human, NetworkPerson)
    assert person.human.networks.people == ("person-02",)
    assert person.number == 3
    more = learn("bc", group, 1, 0, 3).person(1, 64)  # pyright: ignore[reportAttributeAccessIssue]
    assert more.number == NETWORK_DRAWS < 64 and more.cycle == 3
    world = planning_domain(person.human, person.draws)
    assert world.rules == RULES  # pyright: ignore[reportAttributeAccessIssue]
    assert world.rules != OLD_RULES  # pyright: ignore[reportAttributeAccessIssue]
