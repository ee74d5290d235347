"""Recurrent baselines as people to plan for: the same as the networks, round by round and ahead."""

from dataclasses import replace

import pytest
import torch
from example_course import gone_through
from example_person import DOMAIN, begun
from example_recordings import shipped
from example_rounds import untrained

from mirror_ppl.baselines import NetworkPerson
from mirror_ppl.baselines.inputs import look, recorded_inputs
from mirror_ppl.baselines.person import NETWORK
from mirror_ppl.communication import Communicator, ExpectedUtility, Person, SimulatorWorld
from mirror_ppl.communication.person import PlanningContext
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.domains import DOMAINS, get_domain
from mirror_ppl.domains.driving import STAY, SWITCH
from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.models.self_model import SelfModel

ONLY = {NETWORK: torch.zeros(1, dtype=torch.long)}


def recorded(domain, generator, rounds=3):
    """Rounds in the setting that shows less, in which a person received various messages."""
    found = shipped(domain, get_domain(domain).settings[-1], 1, rounds)
    told = {
        name: torch.rand(mask.shape, generator=generator) < 0.3 for name, mask in found.told.items()
    }
    return replace(found, told=told)


def network(domain, generator, setting=None):
    """An untrained network that reads everything that it can."""
    world = get_domain(domain)
    networks = untrained(world, ("person-01",))
    weight = networks.weights["input"]
    weight.data = torch.randn(weight.shape, generator=generator)
    networks.requires_grad_(False)
    return NetworkPerson(SelfModel(world), networks, setting or world.settings[-1])


def first_of(recordings, number):
    """A round, as far as planning has it: all but its last step."""
    domain, length = get_domain(recordings.domain), int(recordings.lengths[0, number])
    observation = {name: value[0, number] for name, value in recordings.observation().items()}
    past = RoundSoFar.begin(domain, {name: value[0] for name, value in observation.items()})
    for step in range(length - 1):
        told = {name: mask[0, number, step] for name, mask in recordings.told.items()}
        now = {name: value[step + 1] for name, value in observation.items()}
        past = past.then(told, recordings.actions[0, number, step], now)
    return past, {name: mask[0, number, length - 1] for name, mask in recordings.told.items()}


@pytest.mark.parametrize("domain", DOMAINS)
def test_keeps_the_contract_of_human_models(domain, generator):
    check_contract(network(domain, generator), shipped=True)


@pytest.mark.parametrize("domain", DOMAINS)
def test_acts_as_the_network_does(domain, generator):
    """Whole rounds at once, and step by step in planning, however people were told."""
    human, recordings = network(domain, generator), recorded(domain, generator)
    expected = human.networks.log_probabilities(recordings)
    steps = recordings.shape[2]
    observation = {name: value[0, :, :steps] for name, value in recordings.observation().items()}
    told = {name: mask[0] for name, mask in recordings.told.items()}
    belief = gone_through(human, ONLY, observation, told, recordings.actions[0].clamp(min=0))
    found = human.act(ONLY, belief, human.action_values(belief))
    real = recordings.mask[0]
    torch.testing.assert_close(found[real], expected[0][real], rtol=1e-4, atol=1e-5)

    person = Person(human, human.draws(2))
    assert person.percept_count == 1
    for number in range(recordings.shape[1]):
        past, last = first_of(recordings, number)
        context = PlanningContext.of(person, past)
        transition = person.transition(
            torch.zeros(1, dtype=torch.long),
            torch.tensor([context.last_action]),
            {name: value[None] for name, value in past.now.items()},
            {name: mask[None] for name, mask in last.items()},
        )
        state = context.before.at(context.own[:1]).after(transition)
        belief = state.believed.expand(2, 1, -1)
        planned = person.act(belief, human.action_values(belief))
        for draw in planned[:, 0]:
            torch.testing.assert_close(draw, expected[0, number, past.time], rtol=1e-4, atol=1e-5)


def test_people_who_act_on_messages_get_messages(generator):
    """A network set by hand switches if told of the car ahead, and otherwise drives into it."""
    human = network("driving", generator, "fog")
    weights, hidden, sizes = human.networks.weights, human.networks.hidden, DOMAIN.symbol_sizes
    for value in weights.values():
        value.data.zero_()
    visual = len(DOMAIN.modalities[0].items) * (sizes["visual"] + 2)
    spoken = len(DOMAIN.modalities[1].items) * sizes["verbal"]
    weights["input"].data[0, sizes["ego"] + visual + spoken, 2 * hidden] = 20.0
    for layer in ("layer_1", "layer_2", "layer_3"):
        weights[layer].data[0, 0, 0] = 1.0
    weights["output"].data[0, 0, SWITCH] = 20.0  # half of the hidden state is old, so it is .5
    weights["output_bias"].data[0, 0, STAY] = 5.0
    planner = Communicator(
        Person(human, human.draws(4)), ExpectedUtility(SimulatorWorld(DOMAIN), 5)
    )
    decision = planner.plan(begun(0, [1, 9, -9, -9], [-1, 1, -1, -1]))
    assert decision.message.items == {"visual": (), "verbal": ("front-left",)}
    safe = planner.plan(begun(0, [9, 9, -9, -9], [1, 1, -1, -1]))
    assert not any(safe.message.items.values())


def test_networks_of_others_are_refused(generator):
    driving, rescue = get_domain("driving"), get_domain("search_rescue")
    with pytest.raises(HumanModelError) as error:
        NetworkPerson(SelfModel(driving), untrained(driving, ("a", "b")), "fog")
    assert str(error.value) == "networks of 2 people, expected those of one"
    with pytest.raises(HumanModelError) as error:
        NetworkPerson(SelfModel(driving), untrained(rescue), "fog")
    assert str(error.value) == "networks of search_rescue, expected driving"


def test_the_world_that_is_planned_in_can_be_another(generator):
    driving = get_domain("driving")
    other = get_domain("driving")
    human = NetworkPerson(SelfModel(driving), untrained(driving), "fog", other)
    assert human.planning_domain(human.draws(1)) is other
    assert NETWORK in human.draws(1)


def test_items_that_the_setting_shows_can_be_communicated(generator):
    """In bomb defusal, where all terminals are in view: a network hears that one is shown."""
    human = network("bomb_defusal", generator, "unlabelled")
    domain = human.domain
    now = domain.observe(domain.initial(1, generator))
    told = {name: torch.zeros_like(mask) for name, mask in domain.communicable(now).items()}
    silent, _ = human.perceive(ONLY, None, now, told, 0)
    told["visual"] = domain.sought(now)
    shown, _ = human.perceive(ONLY, None, now, told, 0)
    difference = (human.evidence(shown, now) - human.evidence(silent, now))[..., :-1]
    apart = (human.networks.weights["input"][0] - difference).abs().sum(-1)
    assert difference.abs().sum() > 0
    assert int((apart < 1e-4).sum()) == 1  # The weights of one input: that it was told.


def test_an_ensemble_is_its_networks(generator):
    """Each draw believes and does what its network alone would, whatever the others do."""
    recordings = recorded("driving", generator)
    world = get_domain("driving")
    several = untrained(world, ("person-01",) * 3)
    for value in several.weights.values():
        value.data = 0.3 * torch.randn(value.shape, generator=generator)
    human = NetworkPerson(SelfModel(world), several, "fog")
    assert human.draws(4)[NETWORK].flatten().tolist() == [0, 1, 2, 0]
    steps = recordings.shape[2]
    observation = {name: value[0, :, :steps] for name, value in recordings.observation().items()}
    told = {name: mask[0] for name, mask in recordings.told.items()}
    actions = recordings.actions[0].clamp(min=0)
    for number in range(3):
        which = {NETWORK: torch.tensor([number])}
        belief = gone_through(human, which, observation, told, actions)
        found = human.act(which, belief, human.action_values(belief))
        expected = several.only(number).log_probabilities(recordings)[0]
        real = recordings.mask[0]
        torch.testing.assert_close(found[real], expected[real], rtol=1e-4, atol=1e-5)
    check_contract(human)


def test_an_informed_network_reads_what_a_message_means(generator):
    """A car that is told of is as one that was seen twice; that it was told is not to be read."""
    world = get_domain("driving")
    now = world.observe(world.initial(1, generator))
    nothing = world.nothing_known(1)
    told = {name: mask.clone() for name, mask in world.communicable(now).items()}
    seen, heard, after = look(world, "informed", "fog", nothing, now, told)
    assert not any(bool(mask.any()) for mask in heard.values())
    assert torch.equal(seen["visual"], seen["verbal"] | told["visual"])
    assert bool((seen["verbal"] == world.known(after)["verbal"]).all())
    by_setting, told_of, same = look(world, "setting", "fog", nothing, now, told)
    assert told_of is told and same is nothing
    assert torch.equal(by_setting["visual"], world.visibility("fog", now)["visual"])
    recordings = recorded("driving", generator)
    plain, informed = (recorded_inputs(world, one, recordings) for one in ("setting", "informed"))
    told_nothing = replace(
        recordings, told={name: mask & False for name, mask in recordings.told.items()}
    )
    assert not torch.equal(plain, informed)
    assert not torch.equal(informed, recorded_inputs(world, "informed", told_nothing))
