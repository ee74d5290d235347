"""What the planner predicts is what Pyro's own tools say of the program, draw for draw."""

from itertools import product

import pytest
import torch
from example_person import (
    BLIND,
    CHANNELS,
    DOMAIN,
    SIGHTS,
    observed,
    random_round,
    self_model,
    varied_draws,
)
from example_programs import DistractedPerson, LatePerson
from pyro import poutine
from pyro.infer import Predictive

from mirror_ppl.communication import Communicator, ExpectedUtility, Person, SimulatorWorld
from mirror_ppl.communication.person import PlanningContext
from mirror_ppl.data import Demonstrations
from mirror_ppl.models import HumanModel
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.variants import PerItem

DRAWS, TIME = 6, 2


def draws_of(human, generator):
    """Draws that differ in everything; half of them see nothing by themselves."""
    drawn = draw_prior(human, 1, DRAWS, 0)
    varied = varied_draws(DRAWS, generator, human)
    for name in SIGHTS:
        varied[name] = varied[name].clone()
        varied[name][: DRAWS // 2] = BLIND
    return {name: varied.get(name, value) for name, value in drawn.items()}


def recorded(past, observations, actions):
    """A round so far that goes on, as recordings to condition the program on."""
    steps = past.time + 1 + len(actions)
    last = observations[-1] if observations else {n: v[-1] for n, v in past.observation.items()}
    seen = {
        name: torch.cat([value, *(one[name][None] for one in (*observations, last))])[None, None]
        for name, value in past.observation.items()
    }
    told = {
        name: torch.cat([mask, mask.new_zeros(1 + len(actions), mask.shape[1])])[None, None]
        for name, mask in past.told.items()
    }
    acted = torch.cat([past.actions, torch.tensor([*actions, 0])])
    return Demonstrations(
        domain=DOMAIN.name,
        setting="fog",
        people=("somebody",),
        ego=seen.pop("ego"),
        observations=seen,
        actions=acted[None, None],
        told=told,
        round_counts=torch.tensor([1]),
        lengths=torch.tensor([[steps]]),
    )


def predicted(human, draws, rounds, messages):
    """Probabilities ``[S, A]`` of actions at each of the last steps, under messages for these."""
    begin = rounds.shape[2] - len(messages)
    said = {
        f"message_{name}_{begin + place}": mask.view(1, 1, -1)
        for place, flags in enumerate(messages)
        for name, mask in CHANNELS.split(flags).items()
    }
    program = Predictive(poutine.do(human.model, data=said), draws, parallel=True)
    with torch.no_grad():
        nodes = program.get_vectorized_trace(rounds).nodes
    steps = range(begin, rounds.shape[2])
    return [nodes[f"action_{step}"]["fn"].probs.expand(DRAWS, 1, 1, -1)[:, 0, 0] for step in steps]


@pytest.mark.parametrize("kind", [HumanModel, LatePerson, DistractedPerson, PerItem])
def test_predictions_of_messages_are_those_of_the_program(kind, generator):
    """At this step and at the next, after each action that may have been taken in between."""
    human = kind(self_model())
    draws = draws_of(human, generator)
    past, state = random_round(TIME, generator)
    person = Person(human, draws)
    context = PlanningContext.of(person, past)
    latents = {
        name: value[context.person.percept].view(-1, 1, 1)
        for name, value in context.person.percepts.items()
        if name not in draws
    }
    assert bool(latents) == human.has_round_latents
    objective = ExpectedUtility(SimulatorWorld(DOMAIN), horizon=2, enumerate_above=0.0)
    allowed = CHANNELS.join(DOMAIN.communicable(past.now))
    items = [torch.eye(len(allowed), dtype=torch.bool)[place] for place in range(len(allowed))]
    silence = torch.zeros_like(allowed)
    some = [silence, allowed, items[0] & allowed, items[5] & allowed]
    candidates = torch.stack([torch.stack(pair) for pair in product(some, some[:2])])
    found = objective.at(context, 2, 0)(candidates).actions
    for candidate, actions in zip(candidates, found, strict=True):
        expected = torch.zeros(len(DOMAIN.actions))
        for action in range(len(DOMAIN.actions)):
            after = observed(DOMAIN.transition(state, torch.tensor([action])))
            later = candidate[1] & CHANNELS.join(DOMAIN.communicable(after))
            rounds = recorded(past, [after], [action])
            now, then = predicted(human, {**draws, **latents}, rounds, [candidate[0], later])
            expected += (now[:, action, None] * then).mean(0)
        torch.testing.assert_close(actions[0], now.mean(0), rtol=0, atol=1e-5)
        torch.testing.assert_close(actions[1], expected, rtol=0, atol=1e-5)
    assert (found[:, 0] - found[:1, 0]).abs().max() > 1e-3  # messages matter


def test_the_table_of_alternatives_says_the_same(generator):
    human = HumanModel(self_model())
    draws = draws_of(human, generator)
    past, _ = random_round(TIME, generator)
    objective = ExpectedUtility(SimulatorWorld(DOMAIN), horizon=2)
    decision = Communicator(Person(human, draws), objective).plan(past)
    table = decision.alternatives.sort_index()
    assert len(table) > 8
    probabilities = torch.tensor(table[[f"p({action})" for action in DOMAIN.actions]].to_numpy())
    some = slice(None, None, len(table) // 8)
    for flags, found in zip(decision.found.candidates[some, 0], probabilities[some], strict=True):
        (expected,) = predicted(human, draws, recorded(past, [], []), [flags])
        torch.testing.assert_close(found.float(), expected.mean(0), rtol=0, atol=1e-5)
