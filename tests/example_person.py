"""People, scenes and rounds for the tests of the communicator."""

from functools import cache

import torch

from mirror_ppl.communication import Channels, Person, RoundSoFar
from mirror_ppl.communication.person import transitions
from mirror_ppl.domains import get_domain
from mirror_ppl.domains.driving import DrivingState
from mirror_ppl.models import HumanModel, View
from mirror_ppl.models.belief_tracking import BeliefState
from mirror_ppl.models.implants import RESIDUAL_HIDDEN, SIGHT, assumption_sites, sight_sites
from mirror_ppl.models.weights import load_self_model, shipped_weights

DOMAIN = get_domain("driving")
CHANNELS = Channels(DOMAIN)
SIGHTS, ASSUMED = sight_sites(DOMAIN), assumption_sites(DOMAIN)
BLIND, FULL_SIGHT = 0, len(DOMAIN.reach_bins) - 1


@cache
def self_model():
    """The weights that ship."""
    return load_self_model(shipped_weights("driving"))[0]


@cache
def human():
    """The human model on the weights that ship."""
    return HumanModel(self_model())


class Averaging(HumanModel):
    """People who act on the average of what they believed so far.

    A belief is the robot's, then this average, then the number of steps.
    """

    @property
    def belief_size(self):
        return 2 * self.self_model.latent + 1

    def parts(self, belief):
        """The belief of the last step, the average, and the number of steps."""
        latent = self.self_model.latent
        return belief.split([latent, latent, 1], -1)

    def believe(self, belief, evidence, action, still=None):
        last, average, number = self.parts(belief)
        last = super().believe(last, evidence, action, still).mean
        average = average + (last - average) / (number + 1)
        return torch.cat([last, average, number + 1], -1)

    def action_values(self, belief):
        return super().action_values(self.parts(belief)[1])

    def act(self, implants, belief, values):
        return super().act(implants, self.parts(belief)[1], values)


class Unused(Averaging):
    """People who know the average of what they believed, and decide as if they did not."""

    def action_values(self, belief):
        return HumanModel.action_values(self, self.parts(belief)[0])

    def act(self, implants, belief, values):
        return HumanModel.act(self, implants, self.parts(belief)[0], values)


class AssumesAtOddSteps(HumanModel):
    """At even steps they perceive what is communicated, and their views assume nothing."""

    def perceive(self, implants, knowledge, observation, told, step):
        if step % 2:
            return super().perceive(implants, knowledge, observation, told, step)
        return View(dict(told)), knowledge


def implants(number=1, model=None, sight=BLIND, **values):
    """Draws ``[S, 1, 1, ...]``: no residual, few lapses, the same sight in all directions.

    Args:
        number: how many.
        model: the human model they are for.
        sight: index of the threshold; ``front_own`` and so on change it for one direction.
        values: of each draw, or one for all.
    """
    latent, actions = (model or human()).self_model.latent, len(DOMAIN.actions)
    given = dict.fromkeys(SIGHTS, sight) | dict.fromkeys(ASSUMED, 1)
    given |= {"consistency": 3.0, "lapse": 0.02}
    for name, value in values.items():
        given[SIGHT + name if name in DOMAIN.directions else name] = value
    draws = {
        name: torch.as_tensor(value).reshape(-1, 1, 1).expand(number, 1, 1)
        for name, value in given.items()
    }
    draws["residual_in"] = torch.zeros(number, 1, 1, latent + 1, RESIDUAL_HIDDEN)
    draws["residual_out"] = torch.zeros(number, 1, 1, RESIDUAL_HIDDEN + 1, actions)
    return draws


def person(number=1, model=None, **values):
    """A person with draws of :func:`implants`."""
    model = model or human()
    return Person(model, implants(number, model, **values))


def beliefs_before(person, past):
    """Beliefs before the present step, and which of them each percept has."""
    state = BeliefState.initial(person.human, person.percept_count)
    steps = transitions(person, past)
    return (state.through(steps)[-1] if steps else state).distinct()


def varied_draws(number, generator, model=None):
    """Draws that differ in everything."""
    sights = {
        name: torch.randint(FULL_SIGHT + 1, (number,), generator=generator)
        for name in DOMAIN.directions
    }
    draws = implants(
        number,
        model,
        **sights,
        assumes_clear=torch.arange(number) % 2,
        assumes_closing=torch.arange(number) // 2 % 2,
        consistency=0.3 + 2 * torch.rand(number, generator=generator),
        lapse=0.2 * torch.rand(number, generator=generator),
    )
    for name in ("residual_in", "residual_out"):
        draws[name] = 0.2 * torch.randn(draws[name].shape, generator=generator)
    return draws


def scene(lane, positions, speeds):
    """One state; cars are front-left, front-right, rear-left, rear-right."""
    return DrivingState(torch.tensor(lane), torch.tensor(positions), torch.tensor(speeds))


def begun(lane, positions, speeds):
    """The beginning of a round in a scene."""
    return RoundSoFar.begin(DOMAIN, DOMAIN.observe(scene(lane, positions, speeds)))


def random_round(steps, generator, rate=0.1):
    """A round in which some things were told at random, and the state it has come to."""
    state = DOMAIN.initial(1, generator)
    past = RoundSoFar.begin(DOMAIN, observed(state))
    for _ in range(steps):
        flags = CHANNELS.join(DOMAIN.communicable(past.now))
        flags &= torch.rand(len(CHANNELS), generator=generator) < rate
        action = torch.randint(2, (1,), generator=generator)
        state = DOMAIN.transition(state, action)
        past = past.then(CHANNELS.split(flags), action, observed(state))
    return past, state


def observed(state):
    """The observation of one state ``[1]``."""
    return {name: value[0] for name, value in DOMAIN.observe(state).items()}


def flags(visual=(), verbal=()):
    """Flags ``[N]`` of named cars."""
    return CHANNELS.flags({"visual": visual, "verbal": verbal})


def plan(*messages):
    """A candidate ``[L, N]``: one message a step, each flags or ``None`` for silence."""
    silence = flags()
    return torch.stack([silence if message is None else message for message in messages])
