"""People of several kinds: a mixture of what each model says by itself."""

from dataclasses import replace

import pytest
import torch
from few_reaches import robot_of_few_reaches

from mirror_ppl.inference import importance
from mirror_ppl.inference.engine import Inferred, Job
from mirror_ppl.inference.kinds import _combinations, models_by_kind
from mirror_ppl.likelihood.combinations import perceived_sites
from mirror_ppl.likelihood.grid import combination_number
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.models import HumanModel
from mirror_ppl.models.family import KIND, LATE, AnyKind, Late
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.simulation import simulate_from_prior
from mirror_ppl.models.variants import VARIANTS
from mirror_ppl.models.weights import load_self_model, shipped_weights


@pytest.fixture(scope="module")
def job():
    human = AnyKind(robot_of_few_reaches())
    rounds = simulate_from_prior(human, 1, 2, "fog", 100)
    return Job(human, rounds, 200, importance.ImportanceOptions(128, 25.0), 1, Screening())


@pytest.fixture(scope="module")
def found(job):
    return importance.infer_by_importance(job)


def test_kinds_are_weighed_by_evidence_and_implants_are_those_of_each(job, found):
    """Systematic draws: of 200 as many as the probability says, to within one."""
    models = models_by_kind(job.human)
    alone = {
        name: importance.infer_by_importance(replace(job, human=model))
        for name, model in models.items()
    }
    evidence = torch.stack([one.log_evidence for one in alone.values()], -1).double()  # pyright: ignore
    prior = torch.tensor([0.6, 0.1, 0.1, 0.1, 0.1], dtype=torch.double)
    joint = evidence + prior.log()
    torch.testing.assert_close(found.log_evidence, joint.logsumexp(-1), atol=1e-6, rtol=1e-6)
    errors = torch.stack([one.evidence_error for one in alone.values()], -1)  # pyright: ignore
    expected = (joint.softmax(-1) * errors).square().sum(-1).sqrt()
    torch.testing.assert_close(found.evidence_error, expected, atol=1e-6, rtol=1e-6)
    for person, shares in enumerate(joint.softmax(-1)):
        kinds = found.draws[KIND][:, person].flatten()
        often = torch.bincount(kinds, minlength=5)
        assert (often - 200 * shares).abs().max() < 1.01
        for kind, own in enumerate(alone.values()):
            rows = kinds == kind
            for site, value in own.draws.items():
                torch.testing.assert_close(
                    found.draws[site][rows, person], value[rows, person], rtol=0, atol=0
                )
        # Lateness of those who are of another kind is as before: 3 times Beta(2, 2) has the
        # mean 1.5 and the standard deviation 3 / 20**.5.
        others = found.draws[LATE][kinds != 1, person]
        assert abs(float(others.mean()) - 1.5) < 4 * 3 / (20 * len(others)) ** 0.5


def test_what_is_probable_of_a_probable_kind_is_probable(job, found):
    sizes = {site: len(support) for site, support in perceived_sites(job.human).items()}
    assert len(found.combinations) == job.rounds.num_people
    for person, probable in enumerate(found.combinations):
        drawn = combination_number({site: found.draws[site][:, person, 0] for site in sizes}, sizes)
        kinds = found.draws[KIND][:, person].flatten()
        often = torch.bincount(kinds, minlength=5) / len(kinds)
        # Systematic draws: a kind whose share is 2% has a probability above 1%.
        assert torch.isin(drawn[often[kinds] >= 0.02], probable).all()
        assert probable.tolist() == sorted({*probable.tolist()})


def test_combinations_of_other_sites_are_not_kept(job):
    shares, found = torch.ones(1, 1), [Inferred({}, combinations=(torch.arange(3),))]
    alike = {"late": Late(job.human.self_model)}
    assert [one.tolist() for one in _combinations(job.human, alike, found, shares)] == [[0, 1, 2]]
    assert _combinations(job.human, alike, [Inferred({})], shares) == ()
    other = {"one-radius": VARIANTS["one-radius"](job.human.self_model)}
    assert _combinations(job.human, other, found, shares) == ()


def test_each_kind_is_its_model_with_what_was_learned_of_the_world():
    robot, _ = load_self_model(shipped_weights("bomb_defusal"), "bomb_defusal")
    human = load_human_model("all", robot)
    human.rule_logits = torch.arange(3)  # pyright: ignore[reportAttributeAccessIssue]
    models = models_by_kind(human)
    assert {name: type(one) for name, one in models.items()} == dict(human.members)  # pyright: ignore
    assert all(one.rule_logits is human.rule_logits for one in models.values())  # pyright: ignore


def test_what_adds_something_of_its_own_is_inferred_as_one_program(job):
    class More(AnyKind):
        def prior(self):
            return super().prior()

    class Mixin(HumanModel):
        def act(self, implants, belief, values):
            return super().act(implants, belief, values)

    class Own(AnyKind):
        members = AnyKind.members

        def prior(self):
            return super().prior()

    class Mixed(Mixin, AnyKind):
        members = AnyKind.members

    class Same(AnyKind):
        members = AnyKind.members

    for changed in (More, Own, Mixed):
        assert models_by_kind(changed(job.human.self_model)) == {}
    assert set(models_by_kind(Same(job.human.self_model))) == set(AnyKind.members)
    assert models_by_kind(Late(job.human.self_model)) == {}
    changed = AnyKind(job.human.self_model)
    object.__setattr__(changed, "prior", job.human.prior)
    assert models_by_kind(changed) == {}
