"""Simulates rounds: runs the human model forward in the domain's world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pyro
import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.checks import real_number, seed_number, whole_number
from mirror_ppl.data import Demonstrations
from mirror_ppl.domains.base import (
    Domain,
    Observation,
    Visibility,
    map_state,
    require_known,
    roll_out,
    total_reward,
)
from mirror_ppl.models.belief_tracking import BeliefState, Transition
from mirror_ppl.models.human import HumanModel, require_standard_program
from mirror_ppl.models.implants import in_units
from mirror_ppl.models.prior import draw_prior_of_each
from mirror_ppl.models.weights import SELF_MODEL, fingerprint
from mirror_ppl.randomness import forked, person_id, seed_everything
from mirror_ppl.user_code import is_of_package
from mirror_ppl.version import __version__

PRIOR_OF = "prior of "
"""Prefix of the population's name in recordings of people drawn from a human model's prior."""
OWN_HUMAN_MODEL = "own_human_model"
"""Attribute that marks human models which do not come with this package, whatever their names."""
OWN_SIGHT = "own_sight"
"""Attribute with the method, ``sees`` or ``perceive``, by which such a model's people see."""


@torch.no_grad()
def play_rounds(
    human: HumanModel,
    implants: Mapping[str, Tensor],
    rounds: int,
    setting: str,
    generator: torch.Generator,
    scenario: Tensor | None = None,
    told: float = 0.0,
) -> Demonstrations:
    """Simulate rounds of people with given implants; actions are drawn from the program itself.

    Rounds end when the task is done, or after the domain's horizon.

    Args:
        human: the model of people.
        implants: values of sites ``[P, 1, ...]``; sites that are left out are drawn from the
            prior, once for all rounds.
        rounds: number of rounds B per person.
        setting: name under which the rounds are recorded; sight depends on the implants alone.
        generator: random numbers of initial states, messages and actions.
        scenario: of each round of each person, ``[P B]`` in that order; drawn unless given.
        told: probability that a communicable item is communicated, at each step.

    Returns:
        The rounds, with the entropy of each action.
    """
    require_standard_program(human, "be simulated in the true world")
    domain, steps = human.domain, human.domain.horizon
    people = len(next(iter(implants.values())))
    device = generator.device

    def by_person(part: Tensor) -> Tensor:
        return part.unflatten(0, (people, rounds))

    def by_round(sites: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {
            name: value.expand(people, rounds, *value.shape[2:]).flatten(0, 1)
            for name, value in sites.items()
        }

    begin = domain.initial(people * rounds, generator, scenario)
    state = map_state(by_person, begin)
    observed = [domain.observe(state)]
    actions = torch.zeros(people, rounds, steps, dtype=torch.long, device=device)
    heard: list[Visibility] = []
    entropy = torch.zeros(people, rounds, steps, device=device)
    lengths = torch.zeros(people, rounds, dtype=torch.long, device=device)
    under_way = lengths == 0
    varies = human.has_round_latents
    beliefs = BeliefState.initial(human, people * rounds)
    every = torch.arange(people * rounds, device=device)
    # Draws of the program are seeded by the generator, too, independently of its other draws.
    own = torch.Generator(device)
    own.set_state(generator.get_state())
    seed = int(torch.randint(2**31, (), generator=own, device=device))
    with forked():
        seed_everything(seed)
        with poutine.condition(data=dict(implants)), pyro.plate("person", people, dim=-2):
            drawn = human.prior()
    for step in range(steps):
        under_way &= ~domain.over(state)
        lengths += under_way
        heard.append(_told(domain, observed[-1], under_way, told, generator))
        with forked(), pyro.plate("person", people, dim=-2):
            latents = _round_latents(human, drawn, observed, seed + 1) if varies else {}
            last = actions[..., step - 1] if step else actions.new_full((), len(domain.actions))
            beliefs = beliefs.after(
                Transition(
                    by_round({**drawn, **latents}),
                    last.expand(people, rounds).flatten(),
                    {name: value.flatten(0, 1) for name, value in observed[-1].items()},
                    {name: mask.flatten(0, 1) for name, mask in heard[-1].items()},
                    every,
                )
            )
            belief = by_person(beliefs.believed)
            log_probability = human.act(drawn, belief, human.action_values(belief))
        probability = log_probability.exp()
        entropy[..., step] = torch.special.entr(probability).sum(-1)
        probability = probability.flatten(0, 1)
        chosen = torch.multinomial(probability, 1, generator=generator)
        actions[..., step] = chosen.view(people, rounds)
        state = domain.transition(state, actions[..., step])
        observed.append(domain.observe(state))
    observation = {name: torch.stack([one[name] for one in observed], 2) for name in observed[0]}
    states = roll_out(domain, begin, actions.flatten(0, 1))
    before, after = (
        map_state(lambda part, cut=cut: part[:, cut], states)
        for cut in (slice(None, -1), slice(1, None))
    )
    rewards = total_reward(domain.rewards(before, actions.flatten(0, 1), after))
    return Demonstrations(
        domain=domain.name,
        setting=setting,
        people=tuple(map(person_id, range(people))),
        ego=observation.pop("ego"),
        observations=observation,
        actions=actions,
        rewards=by_person(rewards),
        action_entropy=entropy,
        told={name: torch.stack([one[name] for one in heard], 2) for name in heard[0]},
        round_counts=torch.full((people,), rounds),
        lengths=lengths,
    )


def _told(
    domain: Domain,
    observation: Observation,
    under_way: Tensor,
    chance: float,
    generator: torch.Generator,
) -> Visibility:
    """Draw which items ``[P, B, K]`` are communicated; a probability of 0 draws nothing."""
    can_be = domain.communicable(observation)
    if not chance:
        return {name: torch.zeros_like(mask) for name, mask in can_be.items()}
    told = {}
    for m in domain.modalities:
        mask = can_be[m.name]
        shape = (*mask.shape[:-1], len(m.communicated))
        noise = torch.rand(shape, generator=generator, device=mask.device)
        told[m.name] = mask & under_way[..., None] & m.items_of(noise < chance)
    return told


def simulate_from_prior(
    human: HumanModel,
    people: int,
    rounds: int,
    setting: str | None = None,
    seed: int = 0,
    told: float = 0.0,
) -> Demonstrations:
    """Simulate recordings of people drawn from the prior of a human model.

    Args:
        human: the model of people.
        people: number of people P.
        rounds: number of rounds B per person.
        setting: name under which the rounds are recorded; sight depends on the implants alone.
            The last of the domain unless given.
        seed: of everything random.
        told: probability that a communicable item is communicated, at each step.

    Returns:
        Their rounds, with the true value of each scalar site, sight thresholds in the domain's
        unit of distance.

    Raises:
        InputError: fewer than one person or round, no seed, or ``told`` is no probability.
        UnknownNameError: there is no such setting.
        HumanModelError: the model overrides the program itself.
    """
    domain, device = human.domain, next(human.parameters()).device
    setting = require_known(setting or domain.settings[-1], "setting", domain.settings, domain.name)
    people, rounds = whole_number(people, "people", 1), whole_number(rounds, "rounds", 1)
    seed, told = seed_number(seed), real_number(told, "told", 0, 1)
    # Each person by themselves, so that they do not depend on how many they are.
    drawn = draw_prior_of_each(human, [person_id(place) for place in range(people)], 1, seed)
    generator = torch.Generator(device).manual_seed(seed)
    implants = {name: value[0] for name, value in drawn.items()}
    recorded = play_rounds(human, implants, rounds, setting, generator, told=told)
    provenance = {
        "population": f"{PRIOR_OF}{type(human).__name__}",
        "seed": seed,
        "version": __version__,
        SELF_MODEL: fingerprint(human.self_model),
        **({"told": told} if told else {}),
        **({} if is_of_package(human) else {OWN_HUMAN_MODEL: 1}),
    }
    return replace(recorded, truth=true_values(human, drawn), provenance=provenance)


def true_values(human: HumanModel, drawn: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return values ``[P]`` of sites that are one number, thresholds in the domain's unit.

    Args:
        human: the model of people.
        drawn: one draw of all sites, ``[1, P, 1, ...]``.
    """
    return {
        name: value[0].float()
        for name, value in in_units(human.domain, drawn).items()
        if value.dim() == 2  # noqa: PLR2004
    }


def _round_latents(
    human: HumanModel, implants: dict[str, Tensor], observed: list[Observation], seed: int
) -> dict[str, Tensor]:
    """Sample the round latents ``[P, B]``, given the covariates of the rounds so far.

    Runs inside the person plate. The seed is fixed, so latents change only with covariates.
    """
    so_far = {name: torch.stack([one[name] for one in observed], 2) for name in observed[0]}
    seed_everything(seed)
    with pyro.plate("round", observed[0]["ego"].shape[1], dim=-1):
        return human.round_latents(implants | human.covariates(so_far))
