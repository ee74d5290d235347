"""People who follow a human model choose as its program does, step by step."""

import pytest
import torch

from mirror_ppl.domains import get_domain
from mirror_ppl.errors import HumanModelError, InputError, UnknownNameError
from mirror_ppl.models import SelfModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.simulation import simulate_from_prior
from mirror_ppl.models.sizes import Sizes
from mirror_ppl.people import has_oracle, people_from_prior, simulate, simulated_people


def human_of(world, name):
    """An untrained self-model is enough, as all compute the same."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        sizes = Sizes(latent=8, encoder=16, q_network=16)
        return load_human_model(name, SelfModel(get_domain(world), sizes))


@pytest.mark.parametrize(
    ("world", "name"),
    [
        ("driving", "mirror"),
        ("driving", "late"),
        ("driving", "hard-of-hearing"),
        ("driving", "all"),
        ("search_rescue", "forgetting"),
        ("highway", "noticing"),
    ],
)
def test_they_choose_as_the_program_does(world, name):
    """In recorded rounds, with messages, their choices have the entropy that was recorded."""
    human = human_of(world, name)
    recorded = simulate_from_prior(human, 3, 2, seed=7, told=0.3)
    people = people_from_prior(human, 3, 7)
    for site, value in people.truth().items():
        torch.testing.assert_close(value, recorded.truth[site], rtol=0, atol=0)
    observation, memory = recorded.observation(), people.start(2)
    for step in range(recorded.actions.shape[-1]):
        action = recorded.actions[:, :, step]
        probability, memory = people.step(
            memory,
            {part: value[:, :, step] for part, value in observation.items()},
            {part: mask[:, :, step] for part, mask in recorded.told.items()},
        )
        entropy, real = torch.special.entr(probability).sum(-1), action >= 0
        expected = recorded.action_entropy[:, :, step]
        torch.testing.assert_close(entropy[real], expected[real], rtol=0, atol=1e-4)
        memory = people.acted(memory, action.clamp(min=0))


def test_each_is_alone_as_among_others():
    human = human_of("driving", "late")
    two, four = people_from_prior(human, 2, 3), people_from_prior(human, 4, 3)
    joined = two.join([four.select([0]), four.select([1])])
    for site, value in two.implants.items():
        torch.testing.assert_close(value, four.implants[site][:2], rtol=0, atol=0)
        torch.testing.assert_close(value, joined.implants[site], rtol=0, atol=0)
    observation = human.domain.observe(human.domain.initial(4, torch.Generator().manual_seed(0)))
    every = {part: value[:, None] for part, value in observation.items()}
    alone = {part: value[1:2] for part, value in every.items()}
    found, _ = four.step(four.start(1), every)
    one = four.select([1])
    torch.testing.assert_close(one.step(one.start(1), alone)[0], found[1:2])
    seen = four.sees(every)["visual"]
    torch.testing.assert_close(one.sees(alone)["visual"], seen[1:2])


def test_a_population_may_be_the_prior_of_a_human_model():
    people = simulated_people("driving", "fog", "prior of Late", 2, 3)
    assert type(people.modelled()[0]).__name__ == "Late"
    assert "late" in people.truth() and has_oracle("driving", "prior of Late")
    for population in ("prior of Late", "martians"):
        with pytest.raises(UnknownNameError, match=f'unknown population "{population}"'):
            simulate("driving", "fog", population, 2, 1)
    with pytest.raises(UnknownNameError, match='unknown setting "rain"'):
        simulated_people("driving", "rain", "prior of Late", 2, 3)
    with pytest.raises(
        InputError, match="people are of your own human model Mine, which has to be given"
    ):
        simulated_people("driving", "fog", "prior of Mine", 2, 3)
    with pytest.raises(HumanModelError, match="has round_latents, which are drawn anew in each"):
        simulated_people("bomb_defusal", "unlabelled", "prior of BombDefusalHuman", 2, 3)
