"""Messages to firefighters: which items are worth looking at, and what each costs beside others."""

import torch

from mirror_ppl.communication import Channels, Person, PlanningContext, RoundSoFar
from mirror_ppl.domains import get_domain
from mirror_ppl.models import HumanModel
from mirror_ppl.models.self_model import SelfModel

WORLD = get_domain("search_rescue")
CHANNELS = Channels(WORLD)
TELLING = {"middle-left", "middle-right", "top-left", "top-middle", "top-right"}


def context(radius):
    """A person at the entrance who sees so far; three draws of all else."""
    torch.manual_seed(0)
    human = HumanModel(SelfModel(WORLD))
    draws = {
        "sight_radius": torch.full((3, 1, 1), WORLD.reach_bins.index(radius)),
        "assumes_open": torch.tensor([0, 1, 0]).view(3, 1, 1),
        "consistency": torch.full((3, 1, 1), 3.0),
        "lapse": torch.full((3, 1, 1), 0.05),
        "residual_in": torch.zeros(3, 1, 1, 49, 8),
        "residual_out": torch.zeros(3, 1, 1, 9, 4),
    }
    state = WORLD.initial(1, torch.Generator(), torch.tensor([1]))
    now = {name: value[0] for name, value in WORLD.observe(state).items()}
    past = RoundSoFar.begin(WORLD, now)
    return PlanningContext.of(Person(human, draws), past)


def items(flags):
    return {pair for pair, flag in zip(CHANNELS.pairs, flags.tolist(), strict=True) if flag}


def test_what_a_portion_shows_for_less_need_not_be_said():
    everything = torch.ones(len(CHANNELS), dtype=torch.bool)
    found = items(context(1.5).telling(everything))
    assert found == {("visual", item) for item in TELLING}
    # Where it cannot be shown, it is said.
    speech = torch.tensor([name == "verbal" for name, _ in CHANNELS.pairs])
    assert items(context(1.5).telling(speech)) == items(speech)


def test_of_items_that_cost_nothing_one_of_each_kind_stays(monkeypatch):
    """Each of them replaces itself, and those of equal meaning replace each other."""
    for modality in WORLD.modalities:
        monkeypatch.setitem(vars(modality), "cost_coefficient", 0.0)
    everything = torch.ones(len(CHANNELS), dtype=torch.bool)
    found = items(context(1.5).telling(everything))
    assert found == {("visual", item) for item in TELLING}
    speech = torch.tensor([name == "verbal" for name, _ in CHANNELS.pairs])
    assert items(context(1.5).telling(speech)) == items(speech)


def test_people_who_see_the_house_get_no_message():
    everything = torch.ones(len(CHANNELS), dtype=torch.bool)
    assert not context(10.0).telling(everything).any()


def test_costs_of_one_item_more():
    """0.02 n^2 shown and 0.1 n^2 said: the third shown costs as much as the first said."""
    expected = torch.tensor([0.02] * 9 + [0.1] * 5)
    torch.testing.assert_close(CHANNELS.marginal(1), expected)
    torch.testing.assert_close(CHANNELS.marginal(3), 5 * expected)
