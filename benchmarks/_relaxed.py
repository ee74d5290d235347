"""Sight thresholds on a continuous scale, inferred by gradients: what this package does not do.

A human model of drivers in which a car is seen to the degree ``sigmoid((reach - distance) / s)``
and what is taken for granted is so by a weight, fitted by a mean-field guide. A car that is seen
twice is known to the degree of the lesser sight. Beliefs are the encoder's means, or draws of it:
reparameterized, or without gradients as in the released code.
"""

from __future__ import annotations

from typing import Literal

import pyro
import pyro.distributions as dist
import torch
from pyro.infer import Trace_ELBO
from pyro.infer.autoguide import AutoNormal, init_to_median
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.domains import Observation
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.implants import assumption_sites, policy_implants, sight_sites
from mirror_ppl.models.view import View

Latents = Literal["mean", "rsample", "sample"]
SOFTNESS = 0.5
"""Cells over which sight fades, a half of what cars are apart at least."""
LEARNING_RATE = 0.03
STEPS = 3000


def relaxed_draws(
    human: HumanModel, rounds: Demonstrations, latents: Latents, draws: int, seed: int
) -> dict[str, Tensor]:
    """Posterior draws ``[S, P, 1, ...]`` of the package's own sites, of drivers.

    Thresholds count as the package's bin that they are in, weights as 0 or 1, and beliefs of those
    who predict are means, whatever they were fitted with.

    Args:
        human: the model whose networks and sites these are.
        rounds: of P people.
        latents: what beliefs are; ``sample`` has no gradients.
        draws: their number S.
        seed: of everything random.
    """
    relaxed = _Relaxed(human, rounds, latents)
    with torch.random.fork_rng(devices=[]), pyro.settings.context(module_local_params=True):
        torch.manual_seed(seed)
        guide = AutoNormal(relaxed.model, init_loc_fn=init_to_median, init_scale=0.3)
        guide()
        optimizer = torch.optim.Adam(guide.parameters(), LEARNING_RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
        loss = Trace_ELBO()
        for _ in range(STEPS):
            optimizer.zero_grad()
            loss.differentiable_loss(relaxed.model, guide).backward()
            optimizer.step()
            schedule.step()
        with torch.no_grad():
            found = [guide() for _ in range(draws)]
    together = {name: torch.stack([one[name] for one in found]) for name in found[0]}
    for site in sight_sites(human.domain):
        together[site] = together[site].long().clamp(max=len(human.domain.reach_bins) - 1)
    for site in assumption_sites(human.domain):
        together[site] = together[site].round().long()
    return together


class _Relaxed:
    """The program, of the rounds ``[P, B, T]`` of some people."""

    def __init__(self, human: HumanModel, rounds: Demonstrations, latents: Latents) -> None:
        self.human = human
        self.rounds = rounds
        self.latents = latents
        steps = rounds.actions.shape[2]
        self.observation = {
            name: value[:, :, :steps] for name, value in rounds.observation().items()
        }
        self.acted = rounds.actions.clamp(min=0)

    def model(self) -> None:
        human, domain = self.human, self.human.domain
        people = len(self.acted)
        like = next(human.parameters())
        bins = len(domain.reach_bins)
        with pyro.plate("person", people, dim=-2):
            implants = {
                site: pyro.sample(site, dist.Uniform(like.new_zeros(()), float(bins)))
                for site in sight_sites(domain)
            }
            for site in assumption_sites(domain):
                implants[site] = pyro.sample(site, dist.Uniform(like.new_zeros(()), 1.0))
            implants |= policy_implants(domain, human.belief_size, like)
            belief = self._believe(self._perceive(implants))
            belief = belief.flatten(1, 2)  # each moment as a round of its own
            found = human.act(implants, belief, human.action_values(belief))
            found = found.unflatten(1, self.acted.shape[1:])
            chosen = found.gather(-1, self.acted[..., None]).squeeze(-1)
            total = torch.where(self.rounds.actions >= 0, chosen, 0.0).sum((-1, -2))
            pyro.factor("actions", total[..., None])

    def _perceive(self, implants: dict[str, Tensor]) -> View:
        """Views whose masks are weights ``[P, B, T, K]``."""
        domain = self.human.domain
        # Numbers of bins, of which the whole part is the bin: cells lie in between.
        number = torch.stack([implants[site] for site in sight_sites(domain)], -1)  # [P, 1, D]
        bins = torch.tensor(domain.reach_bins).to(number)
        edges = torch.cat([bins, bins[-1:] + 1])
        lower = number.detach().long().clamp(max=len(bins) - 1)
        reach = edges[lower] + (number - lower) * (edges[lower + 1] - edges[lower])

        def degree(observation: Observation) -> Tensor:
            direction, distance = domain.distance(observation)
            own = reach.expand(*direction.shape[:-1], -1).gather(-1, direction)
            return torch.sigmoid((own - distance) / SOFTNESS)

        def sees(observation: Observation) -> dict[str, Tensor]:
            seen = degree(observation).detach() > 0.5  # noqa: PLR2004
            return {"visual": seen, "verbal": torch.zeros_like(seen)}

        knowledge, views = domain.nothing_known(1), []
        placed = known_by_sight = reach.new_zeros(())
        for step in range(self.acted.shape[-1]):
            now = {
                name: value[..., step, :] if name == "ego" else value[..., step, :, :]
                for name, value in self.observation.items()
            }
            seen = sees(now)
            knowledge = domain.learn(knowledge, now, seen, sees)
            sight = degree(now)
            known_by_sight = torch.maximum(known_by_sight, torch.minimum(placed, sight))
            placed = torch.maximum(placed, sight)
            visible = {}
            for name, mask in domain.known(knowledge).items():
                # What follows from not seeing has no degrees.
                inferred = mask & (known_by_sight <= 0.5)  # noqa: PLR2004
                visible[name] = torch.where(inferred, 1.0, known_by_sight)
            visible["visual"] = torch.maximum(visible["visual"], sight)
            items, imagined = domain.assume(knowledge, now)
            taken = {name: torch.zeros_like(weight) for name, weight in visible.items()}
            for site, about in zip(assumption_sites(domain), items.values(), strict=True):
                for name, mask in about.items():
                    own = implants[site][..., None] * mask * (1 - visible[name])
                    taken[name] = taken[name] + own
            views.append(View(visible, taken, imagined))
        return View.stack(views)

    def _believe(self, view: View) -> Tensor:
        """Beliefs ``[P, B, T, Z]``."""
        human, actions = self.human, self.acted
        evidence = human.evidence(view, self.observation)
        encoder = human.self_model.encoder
        evidence = evidence + encoder.previous_actions(actions[..., :-1])
        if self.latents == "mean":
            return human.self_model.believe(evidence)
        belief, beliefs = evidence.new_zeros(*evidence.shape[:-2], human.belief_size), []
        for step in evidence.unbind(-2):
            state = encoder(belief, step)
            belief = state.mean + state.scale * torch.randn_like(state.mean)
            if self.latents == "sample":
                belief = belief.detach()
            beliefs.append(belief)
        return torch.stack(beliefs, -2)
