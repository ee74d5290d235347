"""The human model: the robot's self-model with implants, as one Pyro program.

Implements the generative process of MIRROR (Chen, Fong and Soh, RSS 2022) for a person ``p``::

    psi_p      ~ prior                                     inside pyro.plate("person", P)
    m_b        ~ what differs from round to round          inside pyro.plate("round", B); or nothing
    n_t        = natural visibility of each item           perceptual implants and m_b
    k_t        = items that follow from everything seen and communicated up to t
    v_t        = n_t or told_t or k_t                      told_t are the communicated items
    u_t        = what psi_p takes for granted about the rest
    zH_t       = mean of q(. | zH_{t-1}, v_t * x_t + u_t, v_t, a_{t-1})   social projection
    a_t        ~ (1 - lapse) softmax(consistency * Q(zH_t) + delta(zH_t)) + lapse / A
                 Q without small differences to its maximum in search and rescue (value_errors)
    z_t, x_t, r_t ~ the self-model's transition, observation and reward likelihoods

To change the model, derive from :class:`HumanModel` and override one of ``prior``,
``round_latents``, ``sees``, ``perceive``, ``evidence``, ``believe`` and ``act``, in Pyro's syntax.
The last five are about one step of a round; fitting, predicting, simulating and planning call them.

Departures from the supplement: thresholds are inferred up to bins between possible distances; a
person may take things for granted (``assumes_clear``, ``assumes_closing``); actions may be lapses.
Reasons and measurements are in ``docs/decisions.md``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any

import pyro
import torch
from pyro import poutine
from torch import Tensor, nn

from mirror_ppl.checks import require_methods
from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.domains.base import Domain, Observation, Visibility, by_eye
from mirror_ppl.errors import HumanModelError
from mirror_ppl.models import implants as implant_priors
from mirror_ppl.models.distributions import NormalizedCategorical
from mirror_ppl.models.handlers import AtStep, MaskObserved
from mirror_ppl.models.networks import Gaussian, log_softmax_with_lapse
from mirror_ppl.models.perception import perceived_by
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.spans import Span
from mirror_ppl.models.value_errors import choice_values
from mirror_ppl.models.view import View
from mirror_ppl.models.world_program import first_state, next_state, reward
from mirror_ppl.randomness import forked
from mirror_ppl.shapes import broadcast_shapes

Implants = Mapping[str, Tensor]
"""Values of sample sites by name, ``[..., P, 1]`` and event dimensions behind."""
ACTION = "action"
"""Site of the action of a step."""
ABOUT_SPANS = ("round_latents", "sees", "perceive")
"""Methods that determine at which steps round latents are read."""


class HumanModel(nn.Module):
    """The probabilistic model of people.

    Args:
        self_model: the robot's networks, which are frozen. Anything else is an `InputError`.

    Batch dimensions of implants are ``[..., P, 1]``: people at -2, and -1 left for their rounds or
    views. Weights and the like follow as event dimensions.

    Attributes:
        value_names: names of the values 0, 1 and so on of discrete sites whose values have no
            order. Summaries have the most probable value of these, and quantiles of all others.
        stratified_by: a discrete site of :meth:`prior`, not read by perception and without
            dependents, or None. Set it if behaviour differs so much between its values that
            inference should keep combinations and moments apart for each value.
    """

    value_names: Mapping[str, Sequence[str]] = MappingProxyType({})
    stratified_by: str | None = None

    def __init_subclass__(cls, **options: Any) -> None:
        """Check that a class that changes methods on which spans depend declares its spans.

        Raises:
            HumanModelError: it does not, or it overrides a method that is final.
        """
        super().__init_subclass__(**options)
        for name in {"infer", "belief_after"} & vars(cls).keys():
            raise HumanModelError(f"{cls.__name__} overrides {name}(); override believe() instead")
        order = cls.__mro__
        declaring = next(one for one in order if "spans" in vars(one))
        since = set().union(*(vars(one) for one in order[: order.index(declaring)]))
        changed = [name for name in ABOUT_SPANS if name in since]
        if changed and cls.spans is not HumanModel.spans:
            raise HumanModelError(
                f"{cls.__name__} overrides {', '.join(changed)} and inherits spans: declare "
                f'"spans = {declaring.__name__}.spans" if they still hold, else '
                '"spans = HumanModel.spans"'
            )

    def __init__(self, self_model: SelfModel) -> None:
        super().__init__()
        require_methods(self_model, ["action_values"], "self_model", "a self-model")
        self.self_model = self_model.eval().requires_grad_(False)

    @property
    def domain(self) -> Domain:
        """Domain in which people act."""
        return self.self_model.domain

    @property
    def belief_size(self) -> int:
        """Size Z of beliefs; larger beliefs begin with the robot's own."""
        return self.self_model.latent

    @cached_property
    def likelihood_power(self) -> float:
        """Power of the likelihood of recorded actions: the world's record has it, or set it."""
        return self.domain.record.likelihood_power

    def action_values(self, belief: Tensor) -> Tensor:
        """Return action values ``[..., A]`` at beliefs ``[..., Z]``, an argument of :meth:`act`.

        They are the robot's, without small differences to the best one where these may be errors.
        """
        return choice_values(self.self_model, belief)

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants of every person; runs inside ``pyro.plate("person", P, dim=-2)``.

        Discrete sites with finite support are summed out exactly, others that perception reads by
        weighted points, and the rest is proposed. Returns values by name, for :meth:`perceive` and
        :meth:`act`.
        """
        like = next(self.self_model.parameters())
        return implant_priors.perceptual_implants(
            self.domain, like
        ) | implant_priors.policy_implants(self.domain, self.self_model.latent, like)

    def round_latents(self, implants: Implants) -> dict[str, Tensor]:
        """Sample the latents of a round that affect what a person sees: their attention ``m_b``.

        Runs inside ``pyro.plate("person", P, dim=-2)`` and ``pyro.plate("round", B, dim=-1)``. Its
        sites are discrete with finite support, and :meth:`perceive` reads them like those of
        :meth:`prior`. There are none unless this is overridden.

        Args:
            implants: as :meth:`prior` returned them, ``[..., P, 1]``, with the :meth:`covariates`
                of the rounds, ``[..., P, B]``, where rounds are given.
        """
        del implants
        return {}

    def covariates(self, observation: Observation) -> dict[str, Tensor]:
        """Return covariates ``[...]`` of a round on which a person's attention depends.

        :meth:`round_latents` reads them by these names, which are not sites. There are none unless
        this is overridden.

        Args:
            observation: full observations, ``[..., T, K, F]``, of the steps played; T is 0 for
                padding.
        """
        del observation
        return {}

    def spans(self, observation: Observation) -> dict[str, Span]:
        """Return the steps of a round at which each site of :meth:`round_latents` is read.

        With spans, the sites are summed out exactly (:mod:`mirror_ppl.likelihood.chain`). A site is
        read throughout the round, or in a span that ends before the next one begins; those read
        throughout come first. Their distributions must not depend on each other's values. Without
        spans, the default, weighted samples of their values are used
        (:mod:`mirror_ppl.likelihood.attention`).

        A class that derives from one with spans and overrides ``round_latents``, ``sees`` or
        ``perceive`` declares its own: ``spans = Base.spans`` if they still hold, or
        ``spans = HumanModel.spans`` if there are none.

        Args:
            observation: of the steps played in one round, ``[t, K, F]``; t is 0 for padding.
        """
        del observation
        return {}

    @property
    def chained(self) -> bool:
        """True if the model has attention and declares :meth:`spans`: it is summed out exactly."""
        return self.has_round_latents and overrides(self, "spans")

    def log_proposal(self, observation: Observation, actions: Tensor) -> dict[str, Tensor]:
        """Return log weights ``[n]`` by site of values of attention, given the actions so far.

        The proposal distribution of attention uses them; inference converges whatever they are.
        There are none unless this is overridden.

        Args:
            observation: of one round, ``[t, K, F]``.
            actions: actions so far, ``[t]``.
        """
        del observation, actions
        return {}

    @cached_property
    def has_round_latents(self) -> bool:
        """True if the model has round latents."""
        if not overrides(self, "round_latents"):
            return False
        with (
            forked(),
            poutine.block(),
            pyro.plate("person", 1, dim=-2),
            pyro.plate("round", 1, dim=-1),
        ):
            return bool(self.round_latents(self.prior()))

    def sees(self, implants: Implants, observation: Observation, step: int) -> Visibility:
        """Return masks ``[..., K]`` of the items a person sees without messages at a step: ``n_t``.

        Args:
            implants: the sites of :meth:`prior` and :meth:`round_latents` that it may read,
                ``[...]``, with event dimensions behind.
            observation: everything that could be seen at this step, ``[..., K, F]``.
            step: the number of the step in its round, from 0.
        """
        del step
        direction, distance = self.domain.distance(observation)
        reach = implant_priors.sight_limits(self.domain, implants)  # [..., D]
        batch = broadcast_shapes(reach.shape[:-1], direction.shape[:-1])
        own = reach.expand(*batch, -1).gather(-1, direction.expand(*batch, -1))
        return by_eye(self.domain, distance <= own)

    def nothing_known(self, *batch: int, device: torch.device | None = None) -> Any:
        """Return what people know before a round ``[*batch]``, by default the domain's."""
        return self.domain.nothing_known(*batch, device=device)

    def perceive(
        self,
        implants: Implants,
        knowledge: Any,
        observation: Observation,
        told: Visibility,
        step: int,
    ) -> tuple[View, Any]:
        """Return what a person sees, hears, remembers and takes for granted at one step.

        Args:
            implants: the sites of :meth:`prior` and :meth:`round_latents` that it may read,
                ``[...]``, with event dimensions behind.
            knowledge: that of the step before, at first :meth:`nothing_known`.
            observation: everything that could be seen at this step, ``[..., K, F]``.
            told: what is communicated at this step, ``[..., K]``.
            step: the number of the step in its round, from 0.

        Returns:
            The view of this step, and the knowledge after it.
        """
        sees = partial(self.sees, implants, step=step)
        return perceived_by(sees, self.domain, implants, knowledge, observation, told)

    def evidence(self, view: View, observation: Observation) -> Tensor:
        """Return the encoder's evidence ``[..., H]`` in a view ``[..., K]`` of an observation."""
        shown, visible = view.as_if_seen(observation)
        return self.self_model.encoder.evidence(self.domain.symbols(shown), visible)

    def believe(
        self, belief: Tensor, evidence: Tensor, action: Tensor, still: Tensor | None = None
    ) -> Gaussian | Tensor:
        """Return the belief after one step: ``q(zH_t | zH_{t-1}, v_t * x_t, v_t, a_{t-1})``.

        The mean of the Gaussian is the belief; a model whose beliefs have no density returns the
        belief itself, ``[..., Z]`` with Z the model's :attr:`belief_size`.

        Args:
            belief: of the step before ``[..., Z]``; zero before the first.
            evidence: of this step ``[..., H]``, from :meth:`evidence`.
            action: the action in between ``[...]``; the number of actions before the first.
            still: where nothing is new and the mean stays ``[...]``, see :class:`View`; evidence
                is 0 there.
        """
        encoder = self.self_model.encoder
        state = encoder(belief, evidence + encoder.action(action))
        if still is None:
            return state
        return state._replace(mean=torch.where(still[..., None], belief, state.mean))

    def belief_after(
        self, belief: Tensor, evidence: Tensor, action: Tensor, still: Tensor | None = None
    ) -> Tensor:
        """Return the belief ``[..., Z]`` itself; arguments as for :meth:`believe`."""
        found = self.infer(belief, evidence, action, still)
        return found.mean if isinstance(found, Gaussian) else found

    def infer(
        self, belief: Tensor, evidence: Tensor, action: Tensor, still: Tensor | None = None
    ) -> Gaussian | Tensor:
        """Call :meth:`believe`, with evidence set to 0 where nothing is new."""
        if still is not None:
            evidence = torch.where(still[..., None], 0.0, evidence)
        return self.believe(belief, evidence, action, still)

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """Return log-probabilities of actions at one step, ``[..., P, B, A]``.

        Runs inside the person plate and a plate of rounds; where several rounds lead to the same
        belief, B counts distinct beliefs.

        Args:
            implants: as :meth:`prior` returned them, ``[..., P, 1]``.
            belief: ``[..., P, B, Z]``.
            values: the belief's :meth:`action_values`, ``[..., P, B, A]``.
        """
        # The sum has the residual's layout in memory, with which softmax_of_few is fast.
        residual = implant_priors.residual(implants, belief)
        logits = torch.addcmul(residual, implants["consistency"][..., None], values)
        chosen = log_softmax_with_lapse(logits, implants["lapse"][..., None])
        return implant_priors.executed(self.domain, implants, chosen)

    def choose(
        self, implants: Implants, belief: Tensor, values: Tensor, action: Tensor | None = None
    ) -> Tensor:
        """Sample the action ``[..., P, B]`` of one step, or observe the recorded action.

        Its log-probability counts :attr:`likelihood_power` times in the density.
        """
        log_probabilities = self.act(implants, belief, values)
        likelihood = NormalizedCategorical(log_probabilities, self.likelihood_power)
        return pyro.sample(ACTION, likelihood, obs=action)

    def model(self, rounds: Demonstrations, world: bool = False) -> None:
        """Run the program: what P people see, believe and do in their rounds, step by step.

        It defines the density that every engine computes; :mod:`mirror_ppl.likelihood` vectorizes
        it over all that a person may have seen. Sites of steps are ``message_<modality>_<t>``,
        ``belief_<t>`` and ``action_<t>``, besides what :meth:`act` adds, and with ``world``
        ``state_<t>``, ``observation_<modality>_<t>`` and ``reward_<t>``. Padding is masked out.

        Args:
            rounds: recordings to condition on; under ``pyro.poutine.uncondition`` only their first
                observations, messages and lengths are used.
            world: whether to include the self-model's states, observations and rewards. Given
                recordings they do not depend on implants; unconditioned they replace a simulator.
        """
        device, (people, number, steps) = rounds.actions.device, rounds.shape
        observation, actions = rounds.observation(), rounds.actions.clamp(min=0)
        with pyro.plate("person", people, dim=-2):
            implants = self.prior()
            with pyro.plate("round", number, dim=-1):
                with MaskObserved(rounds.mask.any(-1)):
                    latents = self.round_latents({**implants, **recorded_covariates(self, rounds)})
                knowledge = self.nothing_known(1, device=device)
                belief = next(self.parameters()).new_zeros(people, number, self.belief_size)
                action = torch.full((people, number), len(self.domain.actions), device=device)
                state = belief
                for step in range(steps):
                    with AtStep(step), MaskObserved(rounds.mask[..., step]):
                        now = at_step(observation, step)
                        if world and step == 0:
                            state = first_state(self.self_model, now)
                        elif world:
                            state, now = next_state(self.self_model, state, action, now)
                        told = {
                            name: pyro.deterministic(f"message_{name}", mask, event_dim=1)
                            for name, mask in messages_at(rounds.told, step).items()
                        }
                        sites = {**implants, **latents}
                        view, knowledge = self.perceive(sites, knowledge, now, told, step)
                        belief = pyro.deterministic(
                            "belief",
                            self.belief_after(belief, self.evidence(view, now), action, view.still),
                            event_dim=1,
                        )
                        values = self.action_values(belief)
                        action = self.choose(implants, belief, values, actions[..., step])
                        if world and rounds.rewards is not None:
                            reward(self.self_model, state, action, rounds.rewards[..., step])


def has_own_program(human: HumanModel) -> bool:
    """True if a human model overrides the program itself, and not only methods it calls."""
    return overrides(human, "model") or overrides(human, "choose")


def overrides(human: HumanModel, method: str) -> bool:
    """True if a human model, or its class, overrides a method."""
    return method in vars(human) or getattr(type(human), method) is not getattr(HumanModel, method)


def require_standard_program(human: HumanModel, what: str) -> None:
    """Refuse human models that override the program itself.

    Args:
        human: the model of people.
        what: what such a model cannot do, such as "be compiled", for the message.

    Raises:
        HumanModelError: the model overrides it.
    """
    if has_own_program(human):
        raise HumanModelError(
            f"{type(human).__name__} overrides model() or choose() and cannot {what}; the engines "
            "svi and nuts run it as it is, everything else needs a model that overrides prior, "
            "round_latents, sees, perceive, evidence, believe or act instead"
        )


def recorded_covariates(human: HumanModel, rounds: Demonstrations) -> dict[str, Tensor]:
    """Return the covariates ``[P, B]`` of the steps played in recorded rounds."""
    if not overrides(human, "covariates"):
        return {}
    observation = rounds.observation()
    each = [
        human.covariates(
            {
                name: value[person, number, : int(rounds.lengths[person, number])]
                for name, value in observation.items()
            }
        )
        for person in range(rounds.shape[0])
        for number in range(rounds.shape[1])
    ]
    return {
        name: torch.stack([one[name] for one in each]).view(rounds.shape[:2]) for name in each[0]
    }


def at_step(rounds: Mapping[str, Tensor], step: int) -> dict[str, Tensor]:
    """Select one step of observations ``[..., T, K, F]``, with ``"ego"`` ``[..., T, E]``."""
    return {
        name: value[..., step, :] if name == "ego" else value[..., step, :, :]
        for name, value in rounds.items()
    }


def messages_at(told: Mapping[str, Tensor], step: int) -> Visibility:
    """Select one step of masks ``[..., T, K]``."""
    return {name: mask[..., step, :] for name, mask in told.items()}
