"""The robot's self-model: a latent state-space model over modalities, and values on its states.

Implements section D of the supplement ("Gridworld Driving"):

    p(z_0) prod_t p(z_t | z_{t-1}, a_{t-1}) prod_m p(x^m_t | z_t) p(r_t | z_t, a_t)

with the amortized guide ``q(z_t | z_{t-1}, v_t * x_t, v_t, a_{t-1})``, trained on unmasked targets,
and a Q-network on ``z_t``.

Departures, each with its reason in ``docs/decisions.md``:

- observations enter as discrete symbols, as the supplement calls them, and leave as Gaussians;
- transition and encoder predict the change of the state instead of the state;
- the ego's own state is decoded like a modality that is always visible.
"""

from __future__ import annotations

from dataclasses import dataclass

import pyro
import pyro.distributions as dist
import torch
from pyro import poutine
from torch import Tensor, nn

from mirror_ppl.domains.base import Domain, Observation, Visibility
from mirror_ppl.models.distributions import GaussianChain
from mirror_ppl.models.networks import (
    Decoder,
    Encoder,
    Gaussian,
    ImageDecoder,
    Reward,
    Transition,
    q_network,
)
from mirror_ppl.models.sites import latent_values
from mirror_ppl.models.sizes import Sizes, sizes_of
from mirror_ppl.models.speech import Embedding, hashed_words, utterance_codes


@dataclass(frozen=True)
class Rounds:
    """A batch of rounds as a self-model sees it.

    Attributes:
        observation: the full observation, ``[B, T + 1, ...]``: the target of the decoders.
        visible: masks of its seen items, ``[B, T + 1, K]`` for each modality.
        actions: ``[B, T]``.
        rewards: ``[B, T]``, of the action and the state that it leads to.
    """

    observation: Observation
    visible: Visibility
    actions: Tensor
    rewards: Tensor


class SelfModel(nn.Module):
    """Networks and probabilistic program of the robot.

    Args:
        domain: the domain that the networks are for.
        sizes: of the networks; the domain's own unless given.
        embedding: maps utterances to vectors, which an autoencoder compresses to codes; None if
            the codes are loaded with the weights.
    """

    def __init__(
        self, domain: Domain, sizes: Sizes | None = None, embedding: Embedding | None = hashed_words
    ) -> None:
        super().__init__()
        self.domain = domain
        self.sizes = sizes = sizes or sizes_of(domain)
        self.latent = latent = sizes.latent
        actions = len(domain.actions)
        codes = {
            m.name: torch.zeros(len(m.items), len(m.utterances[0]), sizes.code)
            if embedding is None
            else utterance_codes(m, sizes.code, embedding)
            for m in domain.modalities
            if m.utterances
        }
        self.encoder = Encoder(domain, sizes, codes)
        self.transition = Transition(latent, actions, sizes.transition)
        self.decoders = nn.ModuleDict(
            {"ego": Decoder(latent, 1, len(domain.ego_features), sizes.decoder)}
        )
        for m in domain.modalities:
            self.decoders[m.name] = (
                Decoder(latent, len(m.items), len(m.features), sizes.decoder)
                if m.image is None
                else ImageDecoder(len(m.items), m.image, sizes)
            )
        self.reward = Reward(latent, actions, sizes.reward)
        self.q_network = q_network(sizes, actions)
        self.scales: dict[str, tuple[float, ...]] = {"ego": (1.0,) * len(domain.ego_features)} | {
            modality.name: modality.scales for modality in domain.modalities
        }
        # Weight of each modality's log density in the bound, 1 unless given; for training.
        self.emphasis: dict[str, float] = {}

    def model(self, rounds: Rounds) -> Tensor:
        """Run the program, conditioned on observations; returns ``z`` ``[B, T + 1, Z]``."""
        actions = rounds.actions
        with pyro.plate("self_model_round", actions.shape[0]):
            z = pyro.sample("z", self.dynamics(actions))
            for name, target in self.targets(rounds.observation).items():
                mean, scale = self.decoders[name](z)
                with poutine.scale(scale=self.emphasis.get(name, 1.0)):
                    pyro.sample(f"x_{name}", dist.Normal(mean, scale).to_event(3), obs=target)
            mean, scale = self.reward(z[..., :-1, :], actions)
            pyro.sample("reward", dist.Normal(mean, scale).to_event(1), obs=rounds.rewards)
        return z

    def guide(self, rounds: Rounds, evidence: Tensor | None = None) -> Tensor:
        """Run the guide, the encoder on visible items; returns ``z`` ``[B, T + 1, Z]``."""
        if evidence is None:
            evidence = self.evidence(rounds.observation, rounds.visible, rounds.actions)
        nothing = evidence.new_zeros(*evidence.shape[:-2], self.latent)
        with pyro.plate("self_model_round", evidence.shape[0]):
            return pyro.sample(
                "z",
                GaussianChain(
                    self.encoder(nothing, evidence[..., 0, :]),
                    self.encoder,
                    evidence[..., 1:, :],
                    1,
                ),
            )

    def elbo(self, rounds: Rounds, evidence: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the one-particle ELBO in nats, summed over rounds, and its sample of ``z``.

        Args:
            rounds: under views.
            evidence: of these rounds from :meth:`evidence`, if it is known already.
        """
        guide_trace = poutine.trace(self.guide).get_trace(rounds, evidence)
        replayed = poutine.replay(self.model, trace=guide_trace)
        model_trace = poutine.trace(replayed).get_trace(rounds)
        bound = model_trace.log_prob_sum() - guide_trace.log_prob_sum()
        return torch.as_tensor(bound), latent_values(guide_trace)["z"]

    def dynamics(self, actions: Tensor) -> GaussianChain:
        """Return ``p(z_0) prod_t p(z_t | z_{t-1}, a_{t-1})`` for ``actions`` ``[B, T]``."""
        return GaussianChain(self.prior(actions.shape[:1]), self.transition, actions, 0)

    def prior(self, batch: torch.Size) -> Gaussian:
        """Return ``p(z_0)``, a standard Gaussian, ``[*batch, Z]``."""
        zero = next(self.parameters()).new_zeros(*batch, self.latent)
        return Gaussian(zero, torch.ones_like(zero))

    def targets(self, observation: Observation) -> Observation:
        """Return observations in units of the scales; ego as one item ``[..., 1, E]``."""
        values = {name: value for name, value in observation.items() if name != "ego"}
        values["ego"] = observation["ego"][..., None, :]
        return {
            name: value / torch.tensor(self.scales[name], dtype=value.dtype, device=value.device)
            for name, value in values.items()
        }

    def decode(self, latent: Tensor) -> Observation:
        """Return means of the observations of states ``[..., Z]``, in the domain's units."""
        return self.in_units({name: decode(latent).mean for name, decode in self.decoders.items()})

    def in_units(self, values: Observation) -> Observation:
        """Return observations in the domain's units, the inverse of :meth:`targets`."""
        found = {
            name: value * torch.tensor(self.scales[name], dtype=value.dtype, device=value.device)
            for name, value in values.items()
        }
        found["ego"] = found["ego"].squeeze(-2)
        return found

    def evidence(self, observation: Observation, visible: Visibility, actions: Tensor) -> Tensor:
        """Return the encoder's evidence ``[..., T + 1, H]``, of ``x_t, v_t, a_{t-1}``."""
        evidence = self.encoder.evidence(self.domain.symbols(observation), visible)
        return evidence + self.encoder.previous_actions(actions)[..., : evidence.shape[-2], :]

    def believe(self, evidence: Tensor, still: Tensor | None = None) -> Tensor:
        """Return beliefs ``[..., T, Z]``: the encoder's means, each step from the last mean.

        Args:
            evidence: ``[..., T, H]`` from :meth:`evidence`.
            still: where the belief does not change ``[..., T]``; nowhere unless given.
        """
        belief = evidence.new_zeros(*evidence.shape[:-2], self.latent)
        beliefs = []
        for number, step in enumerate(evidence.unbind(-2)):
            mean = self.encoder(belief, step).mean
            belief = mean if still is None else torch.where(still[..., number, None], belief, mean)
            beliefs.append(belief)
        return torch.stack(beliefs, -2)

    def action_values(self, belief: Tensor) -> Tensor:
        """Return ``Q(z_t, .)`` ``[..., A]`` of beliefs ``[..., Z]``, in units of reward."""
        return self.q_network(belief)
