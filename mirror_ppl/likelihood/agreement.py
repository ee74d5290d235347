"""Check that the density that engines compute for a human model equals that of its program.

Every site of ``prior`` and ``act`` must have the same density for a person alone and among others.
The density of made-up rounds is computed twice: by running the program for one draw at a time, and
by combining its parts for all draws at once, as engines do. They differ if a method adds something
that engines leave out or count twice, or if it depends on other people.
"""

from __future__ import annotations

from collections.abc import Mapping

import pyro
import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.domains.base import Domain
from mirror_ppl.errors import HumanModelError
from mirror_ppl.likelihood.combination_sets import fixed_prior
from mirror_ppl.likelihood.combinations import log_priors, needs_points, perceived_names
from mirror_ppl.likelihood.densities import (
    Given,
    choices,
    log_correction,
    log_latents,
    log_prob,
    prior_nodes,
)
from mirror_ppl.likelihood.enumeration import conditioned
from mirror_ppl.likelihood.points import PriorPoints
from mirror_ppl.models.belief_tracking import BeliefState, Transition
from mirror_ppl.models.dependencies import dependencies
from mirror_ppl.models.human import HumanModel, at_step, messages_at, recorded_covariates
from mirror_ppl.models.prior import Draws, draw_prior
from mirror_ppl.models.sites import latent_sites, sample_nodes
from mirror_ppl.randomness import forked, seed_everything

DRAWS, ROUNDS, STEPS = 6, 2, 4
SEED = 0
TOLERANCE = 1e-3
"""Absolute (nats) and relative; both densities are sums of the same numbers in 32 bits."""
COMPARED = 16
"""Draws of two people; each person alone is compared with all of them together."""
OF_A_SITE = 2e-5
"""Tolerance for one site, absolute (nats) and relative."""


@torch.no_grad()
def check_agreement(human: HumanModel) -> None:
    """Compare the densities of a human model.

    Raises:
        HumanModelError: they differ.
    """
    _check_each_alone(human)
    rounds = made_up_rounds(human.domain, next(human.parameters()).device)
    draws = draw_prior(human, 1, DRAWS, SEED)
    expected, latents = log_densities(human, rounds, draws)
    found = _put_together(human, rounds, draws, latents)
    # Without the densities of the implants, which may be large.
    for name, node in prior_nodes(human, draws, DRAWS, 1).items():
        if name in draws:
            own = log_prob(node).reshape(-1)
            found, expected = found - own, expected - own
    close = torch.isclose(found, expected, rtol=TOLERANCE, atol=TOLERANCE)
    if bool(close.all()):
        return
    draw = int((~close).nonzero()[0])
    kind = type(human).__name__
    raise HumanModelError(
        f"{kind} says something that engines do not see, or take from others: of made-up rounds "
        f"they would compute a log density of {float(found[draw]):.6g}, and its program has "
        f"{float(expected[draw]):.6g}. Python's `if` on values decides for all people at once, and "
        "values that are changed in place are not followed; see docs/extending.md"
    )


def _check_each_alone(human: HumanModel) -> None:
    """Compare every site of ``prior`` and ``act`` for people alone and for all of them together."""
    draws = draw_prior(human, 2, COMPARED, SEED)
    together, again = (_said_by_site(human, draws, COMPARED, 2, seed) for seed in range(2))
    for (method, name), value in together.items():
        if bool(value.isnan().any() or (name in draws and value.isinf().any())):
            raise HumanModelError(
                f'the log density of "{name}" in {method} is not finite: check the parameters of '
                "its distribution"
            )
        if not torch.equal(value, again[method, name]):
            raise HumanModelError(
                f'{method} says something else of "{name}" when it is run again: whatever is '
                "random has to be sampled by pyro.sample"
            )
    for draw in range(COMPARED):
        for person in range(2):
            own = {
                name: value[draw : draw + 1, person : person + 1] for name, value in draws.items()
            }
            alone = _said_by_site(human, own, 1, 1)
            for method, name in together.keys() ^ alone.keys():
                raise HumanModelError(
                    f'{method} has "{name}" of some people only, and others decide of whom: write '
                    "torch.where or poutine.mask in place of Python's `if` on values"
                )
            for (method, name), value in alone.items():
                found = together[method, name][draw, person]
                if not torch.allclose(found, value[0, 0], OF_A_SITE, OF_A_SITE, equal_nan=True):
                    raise HumanModelError(
                        f'the log density of "{name}" in {method} is '
                        f"{float(value.flatten()[0]):.6g} of one person alone and "
                        f"{float(found.flatten()[0]):.6g} among others: a sum over all dimensions, "
                        "as in factor(x.sum()), adds them up (sum over event dimensions alone), "
                        "and Python's `if` on values decides for all of them"
                    )


@torch.no_grad()
def unused_sites(human: HumanModel) -> list[str]:
    """Sites of ``prior`` on which nothing else depends, so that their posterior is their prior.

    Neither provenance nor different values show that something depends on them. Sites that depend
    on others are left out: these can be measured.
    """
    found = dependencies(human)
    used = frozenset(perceived_names(human)).union(
        found.actions, *found.prior.values(), *found.round_latents.values()
    )
    draws = draw_prior(human, 2, COMPARED, SEED)
    usual = _said_by_site(human, draws, COMPARED, 2)

    def matters(name: str) -> bool:
        other = _said_by_site(human, draws | {name: draws[name].roll(1, 0)}, COMPARED, 2)
        return any(not usual[key].equal(other[key]) for key in usual.keys() - {("prior", name)})

    roots = [name for name in draws if name not in used and not found.prior[name]]
    return [name for name in roots if not matters(name)]


def _said_by_site(
    human: HumanModel, draws: Mapping[str, Tensor], number: int, people: int, seed: int = 0
) -> dict[tuple[str, str], Tensor]:
    """Log densities ``[S, P, B]`` by method and site, of draws ``[S, P, 1, ...]`` and one belief.

    The recorded action is the first one of the domain.
    """
    generator = torch.Generator().manual_seed(SEED)
    like = next(human.parameters())
    belief = torch.randn(1, 1, human.belief_size, generator=generator).to(like)
    belief = belief.expand(people, 1, -1)
    values = human.action_values(belief)
    done = torch.zeros(people, 1, dtype=torch.long, device=like.device)
    with (
        forked(),
        poutine.block(),
        Given(dict(draws)),
        pyro.plate("draw", number, dim=-3),
        pyro.plate("person", people, dim=-2),
    ):
        seed_everything(seed)
        with poutine.trace() as prior:
            implants = human.prior()
        with poutine.trace() as act, pyro.plate("round", 1, dim=-1):
            human.choose(implants, belief, values, done)
        traces = {"prior": prior.trace, "act": act.trace}
    return {
        (method, name): log_prob(node).expand(number, people, 1)
        for method, trace in traces.items()
        for name, node in sample_nodes(trace).items()
    }


def made_up_rounds(domain: Domain, device: torch.device) -> Demonstrations:
    """Short rounds of one person with random actions and messages; deterministic."""
    generator = torch.Generator(device).manual_seed(SEED)
    steps = min(STEPS, domain.horizon)
    actions = torch.randint(
        len(domain.actions), (ROUNDS, steps), generator=generator, device=device
    )
    state = domain.initial(ROUNDS, generator)
    observed = [domain.observe(state)]
    for step in range(steps):
        state = domain.transition(state, actions[:, step])
        observed.append(domain.observe(state))
    seen = {name: torch.stack([one[name] for one in observed], 1)[None] for name in observed[0]}
    told = {
        name: mask[:, :, :steps]
        & (torch.rand(mask[:, :, :steps].shape, generator=generator, device=device) < 0.3)
        for name, mask in domain.communicable(seen).items()
    }
    return Demonstrations(
        domain=domain.name,
        setting=domain.settings[0],
        people=("somebody",),
        ego=seen.pop("ego"),
        observations=seen,
        actions=actions[None],
        told=told,
        round_counts=torch.tensor([ROUNDS], device=device),
        lengths=torch.tensor([[steps, *(max(1, steps - 1),) * (ROUNDS - 1)]], device=device),
    )


@torch.no_grad()
def log_densities(
    human: HumanModel, rounds: Demonstrations, draws: Mapping[str, Tensor]
) -> tuple[Tensor, Draws]:
    """Run the program for one draw at a time, and return its log densities.

    Args:
        human: the model of people.
        rounds: rounds of one person.
        draws: values ``[S, 1, 1, ...]`` of all sites of ``prior``.

    Returns:
        Log densities ``[S]``, and the sampled latents of rounds ``[S, 1, B]``.
    """
    found, latents = [], []
    number = len(next(iter(draws.values()), (0,)))
    with forked():
        seed_everything(SEED)
        for draw in range(number):
            own = {name: value[draw] for name, value in draws.items()}
            with poutine.block(), Given(own), poutine.trace() as trace:
                human.model(rounds)
            found.append(torch.as_tensor(trace.trace.log_prob_sum()))
            sites = latent_sites(trace.trace)
            latents.append({name: sites[name]["value"] for name in sites if name not in own})
    together = {
        name: torch.stack([one[name].expand(1, rounds.shape[1]) for one in latents])
        for name in latents[0]
    }
    return torch.stack(found), together


def said_of_made_up_rounds(human: HumanModel) -> list[str]:
    """Log densities of made-up rounds to five digits, as a fingerprint of a program."""
    rounds = made_up_rounds(human.domain, next(human.parameters()).device)
    found, _ = log_densities(human, rounds, draw_prior(human, 1, DRAWS, SEED))
    return [f"{value:.5g}" for value in found.tolist()]


def _put_together(
    human: HumanModel,
    rounds: Demonstrations,
    draws: Mapping[str, Tensor],
    latents: Mapping[str, Tensor],
) -> Tensor:
    """Log densities ``[S]`` of the rounds and draws, combined as engines do."""
    number, every = DRAWS, torch.arange(DRAWS, device=rounds.actions.device)
    names = set(perceived_names(human))
    if needs_points(human):
        names = set(PriorPoints.of(human).sites)
    policy = {name: value for name, value in draws.items() if name not in names}
    grid = {name: draws[name][:, 0, 0] for name in draws if name in names}
    total = log_correction(human, grid, policy, 1)[:, 0].expand(number)
    for name, node in prior_nodes(human, draws, number, 1).items():
        if name in policy:
            total = total + node["fn"].log_prob(node["value"]).reshape(-1).expand(number)
    if grid:
        prior = fixed_prior(human, grid)
        if prior is None:
            prior = log_priors(human, grid, policy, 1)[:, 0].expand(number, -1)[every, every]
        total = total + prior
    with conditioned(draws, number, 1):
        implants = human.prior()
        if human.has_round_latents:
            values = {name: value[:, 0].T[None] for name, value in latents.items()}
            covariates = recorded_covariates(human, rounds)
            for own in log_latents(human, implants, values, covariates).values():
                own = own.expand(number, 1, rounds.shape[1], number)
                total = total + own[every, 0, :, every].sum(-1)
        for step, state in enumerate(_beliefs(human, rounds, grid, latents)):
            mean = state.believed[None]  # [1, S B, Z]
            acted = rounds.actions[0, :, step].clamp(min=0).repeat(number)[None]
            _, said = choices(human, implants, mean, human.action_values(mean), acted)
            said = said.expand(number, 1, mean.shape[1]).unflatten(-1, (number, -1))
            total = total + said[every, 0, every].where(rounds.mask[0, :, step], 0.0).sum(-1)
    return total


def _beliefs(
    human: HumanModel,
    rounds: Demonstrations,
    grid: Mapping[str, Tensor],
    latents: Mapping[str, Tensor],
) -> list[BeliefState]:
    """Beliefs after each step under each draw in each round, ``[S B]``."""
    number, count = DRAWS, rounds.shape[1]
    implants = {name: value.repeat_interleave(count, 0) for name, value in grid.items()}
    implants |= {name: value.flatten() for name, value in latents.items()}
    row = torch.arange(count, device=rounds.actions.device).repeat(number)
    observation = {name: value[0] for name, value in rounds.observation().items()}
    told = {name: value[0] for name, value in rounds.told.items()}
    before = torch.full_like(rounds.actions[0, :, :1], len(human.domain.actions))
    done = torch.cat([before, rounds.actions[0].clamp(min=0)], -1)
    steps = [
        Transition(
            implants,
            done[row, step],
            at_step(observation, step),
            {name: mask[row] for name, mask in messages_at(told, step).items()},
            row,
        )
        for step in range(rounds.shape[2])
    ]
    return BeliefState.initial(human, number * count).through(steps)
