"""The highway among the worlds of the package: recordings and a self-model ship."""

import pytest
import torch

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.domains import DOMAINS, add_domain, get_domain
from mirror_ppl.domains.checking import faults_of
from mirror_ppl.domains.highway import Highway
from mirror_ppl.errors import DomainError
from mirror_ppl.people import act, draw_starts, populations_of, simulated_people

RECORDINGS = [(s, p) for s in Highway.settings for p in ("diverse", "paper")]


def test_it_is_a_sound_world_of_the_package():
    world = get_domain("highway")
    assert isinstance(world, Highway) and DOMAINS["highway"] is world
    assert faults_of(world) == [] and populations_of("highway") == ("diverse", "paper")
    with pytest.raises(DomainError, match="mirror_ppl has a world highway itself"):
        add_domain(Highway)


@pytest.mark.parametrize(("setting", "population"), RECORDINGS)
def test_recordings_are_of_the_drivers_that_a_seed_gives(setting, population):
    """How all of their 40 rounds begin, what they did first in 20 of them, and who they are."""
    recorded = load_demonstrations(asset_path(f"highway_{setting}_{population}.nc"))
    assert (recorded.domain, recorded.setting) == ("highway", setting)
    assert recorded.shape == (10, 40, 48) and int(recorded.lengths.max()) == 48
    world, people = Highway(), simulated_people("highway", setting, population, 10, 0)
    start = draw_starts(10, 40, 0, "rounds", setting, domain=world)
    now = world.observe(start.state)
    for name, value in now.items():
        torch.testing.assert_close(recorded.observation()[name][:, :, 0], value)
    some = {name: value[:, :20] for name, value in now.items()}
    probability, _ = people.step(people.start(20), some)
    first = act(probability, start.action_noise[:, :20, ..., 0])
    # Sums of rewards differ by rounding between batches of other sizes.
    assert (first == recorded.actions[:, :20, 0]).float().mean() > 0.99
    for name, value in people.truth().items():
        assert torch.equal(recorded.truth[name], value)
