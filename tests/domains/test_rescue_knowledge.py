"""What people in search and rescue know, remember and take for granted."""

from dataclasses import replace

import torch
from example_course import perceived
from example_rescue import NINE, RIGHT, UP, WORLD, alone, start, walk

from mirror_ppl.domains.search_rescue import UTTERANCES
from mirror_ppl.domains.search_rescue.house import PORTIONS, ROOMS
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.models import HumanModel
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.training.views import draw_views


def learned(state, shown=(), said=(), knowledge=None):
    observation = WORLD.observe(state)
    visible = {
        "visual": torch.tensor([name in shown for name in PORTIONS]),
        "verbal": torch.tensor([name in said for name in UTTERANCES]),
    }
    if knowledge is None:
        knowledge = WORLD.nothing_known()
    return WORLD.learn(knowledge, observation, visible, lambda supposed: visible)


def known(knowledge):
    items = WORLD.known(knowledge)
    names = {"visual": PORTIONS, "verbal": tuple(UTTERANCES)}
    return {
        name: {names[name][place] for place in mask.nonzero().flatten().tolist()}
        for name, mask in items.items()
    }


ALWAYS = {"middle-middle", "bottom-left", "bottom-middle", "bottom-right"}


def test_what_follows_is_known_and_stays_known():
    state = alone(5)  # top-right, left corridor blocked
    assert known(WORLD.nothing_known()) == {"visual": ALWAYS, "verbal": set()}
    # That a corridor is free says nothing of the other; that it is blocked, everything.
    one = learned(state, ["middle-right"])
    assert known(one) == {"visual": ALWAYS | {"middle-right"}, "verbal": {"right corridor"}}
    both = {"left corridor", "right corridor"}
    assert known(learned(state, said=["left corridor"]))["verbal"] == both
    # Of three rooms, two empty ones tell of the third; the one with the victim of both others.
    first = learned(state, ["top-left"])
    assert known(first)["verbal"] == {"top-left"}
    second = learned(state, said=["top-middle"], knowledge=first)
    assert known(second)["verbal"] == set(ROOMS)
    assert known(second)["visual"] == ALWAYS | set(ROOMS)
    assert known(learned(state, ["top-right"]))["verbal"] == set(ROOMS)
    assert known(learned(state, knowledge=second)) == known(second)
    # Whoever carries the victim knows that no room has them.
    carrying = replace(state, found=torch.tensor(True))
    assert known(learned(carrying))["verbal"] == set(ROOMS)


def test_knowledge_of_a_batch_is_that_of_each():
    state = start(NINE)
    shown = torch.rand(9, 9, generator=torch.Generator().manual_seed(0)) < 0.3
    said = torch.rand(9, 5, generator=torch.Generator().manual_seed(1)) < 0.2
    nothing = WORLD.nothing_known(9)
    visible = {"visual": shown, "verbal": said}
    together = WORLD.learn(nothing, WORLD.observe(state), visible, lambda supposed: visible)
    for place in range(9):
        names = [PORTIONS[k] for k in shown[place].nonzero().flatten().tolist()]
        spoken = [list(UTTERANCES)[k] for k in said[place].nonzero().flatten().tolist()]
        own = learned(alone(place), names, spoken)
        assert torch.equal(own.corridors, together.corridors[place])
        assert torch.equal(own.rooms, together.rooms[place])


def test_a_person_sees_as_far_as_their_radius_and_remembers():
    """An encoder that was not trained is enough to see."""
    torch.manual_seed(0)
    human = HumanModel(SelfModel(WORLD))
    state = alone(5)  # top-right, left corridor blocked
    states, _ = walk(state, [RIGHT] * 3 + [UP] * 7)
    observed = [WORLD.observe(one) for one in states]
    observation = {name: torch.stack([one[name] for one in observed])[None] for name in observed[0]}
    steps = len(states)
    told = {m.name: torch.zeros(1, steps, len(m.items), dtype=torch.bool) for m in WORLD.modalities}
    smoke = next(place for place, edge in enumerate(WORLD.reach_bins) if edge == 1.5)
    everything = len(WORLD.reach_bins) - 1
    implants = {
        "sight_radius": torch.tensor([smoke, everything, smoke]),
        "assumes_open": torch.tensor([0, 0, 1]),
    }
    view = perceived(human, implants, observation, told)
    assert view.visible["visual"].shape == (3, steps, 9)
    assert view.visible["verbal"].shape == (3, steps, 5)
    assert not any(mask[:2].any() for mask in view.taken.values())
    assert view.visible["visual"][1].all() and view.visible["verbal"][1].all()
    seen = [{PORTIONS[k] for k in row.nonzero().flatten()} for row in view.visible["visual"][0]]
    assert seen[0] == ALWAYS
    assert seen[6] == ALWAYS | {"middle-right"}  # row 5 of the corridor
    assert seen[9] == ALWAYS | {"middle-right"} | set(ROOMS)  # the victim: no other room has one
    # Who takes corridors to be open does so until they know better: then of the left one alone.
    taken = {name: mask[2] for name, mask in view.taken.items()}
    both, left = [0, 0, 0, 1, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0, 0, 0, 0]
    assert taken["visual"][0].int().tolist() == both
    assert taken["visual"][6].int().tolist() == left
    assert taken["verbal"][0].int().tolist() == [1, 1, 0, 0, 0]
    assert taken["verbal"][6].int().tolist() == [1, 0, 0, 0, 0]
    free = WORLD.observe(replace(states[0], blocked=torch.zeros_like(states[0].blocked)))
    assert torch.equal(view.imagined["visual"][2, 0], free["visual"])
    assert torch.equal(view.imagined["verbal"][2, 0], free["verbal"])
    check_contract(human, shipped=True)


def test_an_obstacle_of_which_nothing_is_known_may_be_taken_not_to_be_there():
    state = start(number=3)
    state = replace(state, blocked=torch.tensor([0, 1, 2]))
    knowledge = WORLD.nothing_known(3)
    makes, open_to_them = torch.ones(3).bool(), torch.zeros(3).bool()

    def supposed(corridors, assumes):
        own = replace(knowledge, corridors=torch.tensor(corridors))
        return WORLD.supposed(state, own, {"open": assumes}).blocked.tolist()

    nothing, right = [[False, False]] * 3, [[False, True]] * 3
    assert supposed(nothing, makes) == [0, 0, 0]
    assert supposed(nothing, open_to_them) == [0, 1, 2]
    assert supposed(right, makes) == [0, 0, 2]


def test_views_to_train_on_have_the_items_of_each_modality():
    generator = torch.Generator().manual_seed(0)
    plan = draw_views(WORLD, 20, 3, generator)
    state = start(number=20)
    observation = {name: value[:, None] for name, value in WORLD.observe(state).items()}
    visible, knowledge = plan.look(WORLD, WORLD.nothing_known(20, 1), observation, 0)
    assert visible["visual"].shape == (20, 1, 9) and visible["verbal"].shape == (20, 1, 5)
    taken = plan.taken(WORLD, knowledge, observation)
    corridors = ~knowledge.corridors & plan.assumes["open"][:, None, None]
    assert corridors.any() and torch.equal(taken["verbal"][..., :2], corridors)
    assert torch.equal(taken["visual"][..., [3, 5]], corridors)
    assert not taken["verbal"][..., 2:].any() and not taken["visual"][..., :3].any()
