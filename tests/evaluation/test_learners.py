"""Learners that are compared: what they get to see of whom, and what they make of it."""

import pytest
import torch

from mirror_ppl.baselines import as_one_person, held_out_nll
from mirror_ppl.domains import get_domain
from mirror_ppl.errors import InputError
from mirror_ppl.evaluation.known_sight import known_sight
from mirror_ppl.evaluation.learners import Group, learn
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.models.implants import in_units
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
