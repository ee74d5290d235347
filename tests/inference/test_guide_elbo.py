"""Training of the amortized guide by the ELBO."""

import itertools

import pytest
import torch

from mirror_ppl.inference.amortized_guide import AmortizedGuide, reference_places
from mirror_ppl.models.toy import ToyHuman
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.training import guide_elbo
from mirror_ppl.training.guide import GuideOptions, train_guide
from mirror_ppl.training.guide_elbo import ELBOTraining, simulated_groups


@pytest.fixture(scope="module")
def toy():
    return ToyHuman(load_self_model(shipped_weights("driving"))[0])


@pytest.fixture(scope="module")
def groups(toy):
    found = simulated_groups(toy, (2,), torch.Generator().manual_seed(0))
    return list(itertools.islice(found, 3))


@pytest.fixture(scope="module")
def group(groups):
    return groups[0]


@torch.no_grad()
def surprise(network, groups):
    """Median negative log density of the truth."""
    return torch.cat(
        [
            -network.density(group.log_evidence[:, 0], group.steps[:, 0]).log_prob(group.place)
            for group in groups
        ]
    ).median()


def test_a_group_is_what_was_simulated(toy, group):
    people = guide_elbo.GROUP
    assert group.compiled.people == people
    assert group.log_evidence.shape == (people, 1, 64)
    assert group.place.shape == (people, 2)
    recorded = group.compiled.table.steps.sum((1, 2))
    assert torch.equal(group.steps[:, 0], recorded)


def test_the_elbo_teaches_the_network_where_people_are(toy, groups):
    torch.manual_seed(0)
    network = AmortizedGuide(reference_places(toy)).eval()
    before = surprise(network, groups)
    training = ELBOTraining(network, itertools.cycle(groups), 3e-3)
    losses, distances = [], []
    for step in range(80):
        losses.append(training.step())
        if step >= 50:
            distances.append(surprise(network, groups))
    assert sum(losses[-20:]) / 20 < sum(losses[:5]) / 5
    # It is not told the truth, but gets nearer to it; of 60 people, at steps that are noisy.
    assert sum(distances) / len(distances) < before - 0.1


def test_training_takes_as_many_steps_as_asked(toy, monkeypatch):
    taken = []
    monkeypatch.setattr(ELBOTraining, "step", lambda self: taken.append(1))
    options = GuideOptions(people=10, rounds=(1,), steps=7, elbo_steps=5, together=10)
    train_guide(toy, options, 0)
    assert len(taken) == 5
    with pytest.raises(ValueError, match="elbo_steps must be at least 0, not -1"):
        GuideOptions(elbo_steps=-1)
