"""The human model of bomb defusal: people search terminals and know rules the robot does not.

Implements the implants of the supplement's section C for bomb defusal::

    m          ~ Beta(1, 9)                    notice_mean: of noticing a terminal at a step
    c          ~ LogNormal(log 100, 1)         notice_concentration: high if terminals differ little
    notices_k  ~ Beta(c m, c (1 - m))          probability of noticing terminal k at a step
    reads      ~ Bernoulli                     whether they can read the type of the bomb
    rule_j     ~ Categorical(permutations)     policy: the button they press for each of the robot's
    guess_b    ~ Bernoulli                     in each round: the guessed type
    found_b,s  ~ Geometric(notices_k)          in each round and stage s, with lit terminal k
    n_t        = the lit terminal, from found_b,s on; the type, if they can read it

and ``a_t`` is chosen by the robot's action values at ``zH_t`` as in other domains, with buttons
permuted by the rule of the type in ``zH_t``. The robot's reward model has the same wrong rules.
Recorded rewards identify the true rules (:meth:`BombDefusalHuman.fit_world`), so the rules are also
an implant of the reward::

    r_t ~ Normal(r(s_t, rule^-1(a_t)), 1)    r the reward as the robot was taught it
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import permutations

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.domains.base import Domain, Observation, Visibility, of_each, total_reward
from mirror_ppl.domains.bomb_defusal.panel import BUTTONS, KINDS, STAGES
from mirror_ppl.domains.bomb_defusal.world import WAIT, BombDefusal
from mirror_ppl.models import implants as implant_priors
from mirror_ppl.models.human import HumanModel, Implants
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.spans import Span
from mirror_ppl.models.view import View
from mirror_ppl.models.world_knowledge import WorldKnowledge
from mirror_ppl.shapes import broadcast_shapes

NOTICE_MEAN, NOTICE_CONCENTRATION = "notice_mean", "notice_concentration"
READS, RULE, GUESS, FOUND, SOUGHT = "reads_type", "rule_", "guess", "found_", "sought_"
"""Names of sites, and of the covariate: the lit terminal of a stage."""
SEARCHING = (1.0, 9.0)
"""Prior of the mean probability of noticing a terminal at a step: a Beta density of mean 0.1."""
CONCENTRATION = (100.0, 1.0)
"""Prior of the concentration around that mean, in equivalent searches: its median, and the standard
deviation of its logarithm."""
SAME = 0.5
"""Prior probability that the robot's rules for a type hold."""
WAITS, MOST_WAITS, BLIND = 2.0, 8.0, 4.0
"""Log weights of the proposal, in nats: for a wait although the terminal was found, for several
such waits at most, and for a press although it was not found."""
RULE_NAMES = [" ".join(pressed) for pressed in permutations(BUTTONS)]
"""Names of rules: the buttons they press where the robot would press each button in turn."""
RULE_NAMES[0] += " (as the robot)"
EVEN_ODDS = 0.5
REWARD_SCALE = 1.0
"""Standard deviation of recorded rewards, in units of reward."""


class BombDefusalHuman(HumanModel, WorldKnowledge):
    """Finds the lit terminal after a random delay, guesses an unknown type, and knows the rules.

    Args:
        self_model: the robot's networks, of bomb defusal.

    Attributes:
        kinds: types of bombs, as in names of sites.
        rule_logits: of each permutation of buttons, by type, ``[2, 24]``; the prior until
            :meth:`fit_world` is called.
        exchanges: these permutations, ``[24, 4, 4]``: the person's button, and the robot's.
    """

    kinds = tuple(kind.lower().replace(" ", "_") for kind in KINDS)
    world_sites = tuple(RULE + kind.lower().replace(" ", "_") for kind in KINDS)
    value_names = dict.fromkeys(world_sites, RULE_NAMES)
    rule_logits: Tensor
    exchanges: Tensor

    def __init__(self, self_model: SelfModel) -> None:
        super().__init__(self_model)
        orders = torch.tensor(list(permutations(range(len(BUTTONS)))))  # the first changes nothing
        # [24, 4, 4]: row a has a 1 at the button that the robot would press where they press a.
        self.register_buffer(
            "exchanges", torch.nn.functional.one_hot(orders).transpose(1, 2).float()
        )
        self.register_buffer("rule_logits", self._prior_of_rules())

    @property
    def domain(self) -> BombDefusal:
        """Bomb defusal domain."""
        world = self.self_model.domain
        assert isinstance(world, BombDefusal)
        return world

    def _prior_of_rules(self) -> Tensor:
        number = len(self.exchanges)
        prior = self.exchanges.new_full((len(KINDS), number), (1 - SAME) / (number - 1))
        prior[:, 0] = SAME
        return prior.log()

    def prior(self) -> dict[str, Tensor]:
        """Sample the perceptual implants, the rules and the policy implants."""
        like = next(self.self_model.parameters())
        return (
            self.perceptual_implants()
            | self.rules()
            | implant_priors.policy_implants(self.domain, self.self_model.latent, like)
        )

    def perceptual_implants(self) -> dict[str, Tensor]:
        """Sample probabilities of noticing each terminal, and whether they read the type."""
        like = next(self.self_model.parameters())
        success, failure = like.new_tensor(SEARCHING)
        notice_mean = pyro.sample(NOTICE_MEAN, dist.Beta(success, failure))
        median, spread = like.new_tensor(CONCENTRATION)
        notice_concentration = pyro.sample(
            NOTICE_CONCENTRATION, dist.LogNormal(median.log(), spread)
        )
        shape = (notice_concentration * notice_mean, notice_concentration * (1 - notice_mean))
        return (
            {NOTICE_MEAN: notice_mean, NOTICE_CONCENTRATION: notice_concentration}
            | implant_priors.notice_implants(self.domain, like, *shape)
            | {READS: pyro.sample(READS, dist.Categorical(like.new_full((2,), 0.5)))}
        )

    def rules(self) -> dict[str, Tensor]:
        """Sample the permutation of the robot's buttons, by type."""
        return {
            RULE + kind: pyro.sample(RULE + kind, dist.Categorical(logits=logits))
            for kind, logits in zip(self.kinds, self.rule_logits, strict=True)
        }

    def round_latents(self, implants: Implants) -> dict[str, Tensor]:
        """Sample the guess, and the step at which the lit terminal of each stage is found."""
        one = next(iter(implants.values()))
        items = next(m.items for m in self.domain.modalities if m.name == "visual")
        each = [implants[implant_priors.NOTICES + item] for item in items]
        notices = torch.stack(torch.broadcast_tensors(*each), -1)
        sites = {GUESS: pyro.sample(GUESS, dist.Categorical(notices.new_full((2,), 0.5)))}
        for stage in range(STAGES):
            sought = implants.get(f"{SOUGHT}{stage}", one.new_zeros(1, 1, dtype=torch.long))
            shape = broadcast_shapes(notices.shape[:-1], sought.shape)
            own = notices.expand(*shape, -1).gather(-1, sought.expand(shape)[..., None])
            name = f"{FOUND}{stage}"
            found = implant_priors.first_success(own.squeeze(-1), self.domain.horizon)
            sites[name] = pyro.sample(name, found)
        return sites

    def covariates(self, observation: Observation) -> dict[str, Tensor]:
        """Return the lit terminal of each stage; the last one for stages not reached."""
        stage = observation["ego"][..., 0].long()
        if not stage.shape[-1]:  # padding has no lit terminal
            nothing = stage.new_zeros(stage.shape[:-1])
            return {f"{SOUGHT}{number}": nothing for number in range(STAGES)}
        sought = self.domain.sought(observation).long().argmax(-1)
        last, found = None, {}
        for number in range(STAGES):
            here = stage == number
            place = here.long().argmax(-1, keepdim=True)
            own = sought.gather(-1, place).squeeze(-1)
            last = own if last is None else torch.where(here.any(-1), own, last)
            found[f"{SOUGHT}{number}"] = last
        return found

    def spans(self, observation: Observation) -> dict[str, Span]:
        """Return the spans: the guess throughout, each stage's ``found`` within that stage.

        All values after the end of the stage are equivalent.
        """
        stage = observation["ego"][..., 0].long()
        spans = {GUESS: Span(0, len(stage), len(KINDS))}
        for number in range(STAGES):
            first = int((stage < number).sum())
            last = first + int((stage == number).sum())
            spans[f"{FOUND}{number}"] = Span(first, last, last - first + 1)
        return spans

    def log_proposal(self, observation: Observation, actions: Tensor) -> dict[str, Tensor]:
        """Return log weights: found just before a press, and not found before a wait."""
        steps = torch.arange(self.domain.horizon + 1, device=actions.device)
        stage, since = (part[: len(actions)] for part in observation["ego"].long().unbind(-1))
        found = {}
        for number in range(STAGES):
            here = stage == number
            if not here.any():
                continue
            waited = since[here].max()
            pressed = bool((here & (actions != WAIT)).any())
            before = (waited - steps).clamp(min=0).float()
            # Each step earlier implies one more unexplained wait, at a few nats in total at most.
            log = -(WAITS * before).clamp(max=MOST_WAITS)
            if pressed:
                log = torch.where(steps > waited, -BLIND, log)
            found[f"{FOUND}{number}"] = log
        return found

    def sees(self, implants: Implants, observation: Observation, step: int) -> Visibility:
        """Return the lit terminal once it was found, and the type for people who read it."""
        del step
        stage, since = observation["ego"].long().unbind(-1)
        times = [implants[f"{FOUND}{number}"] for number in range(STAGES)]
        times = torch.stack(torch.broadcast_tensors(*times), -1)
        shape = broadcast_shapes(times.shape[:-1], stage.shape)
        place = stage.clamp(max=STAGES - 1).expand(shape)[..., None]
        found = times.expand(*shape, -1).gather(-1, place).squeeze(-1) <= since
        verbal = observation["verbal"][..., 0]
        reads = (implants[READS] == 1)[..., None]
        return {
            "visual": of_each(self.domain.sought, observation) & found[..., None],
            "verbal": reads.expand(broadcast_shapes(reads.shape, verbal.shape)),
        }

    def perceive(self, implants, knowledge, observation, told, step):
        """Return the view of :class:`HumanModel`, with the guess in place of an unknown type.

        Bombs do not change by themselves: at a step without new items the belief does not change,
        however long they search.
        """
        before = knowledge
        view, knowledge = super().perceive(implants, knowledge, observation, told, step)
        guess = implants[GUESS].to(observation["verbal"])[..., None, None]
        known = view.visible["verbal"]
        shape = broadcast_shapes(known.shape, guess.shape[:-1])
        imagined = {"verbal": guess.expand(*shape, 1)}
        taken = {
            "visual": torch.zeros_like(view.visible["visual"]),
            "verbal": ~known.expand(shape),
        }
        still = (knowledge.stage == before.stage).squeeze(-1) & (step > 0)
        for name, mask in self.domain.known(before).items():
            still = still & (mask == view.visible[name]).all(-1)
        return View(view.visible, taken, imagined, still), knowledge

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """Return log-probabilities of actions by the robot's values, with buttons permuted."""
        presses = values[..., 1:]
        second = self.believed_kind(belief)[..., None]  # [..., P, B, 1]
        own = [self._exchanged(presses, implants[RULE + kind]) for kind in self.kinds]
        exchanged = (1 - second) * own[0] + second * own[1]
        wait = values[..., :1].expand(*exchanged.shape[:-1], 1)
        return super().act(implants, belief, torch.cat([wait, exchanged], -1))

    def believed_kind(self, belief: Tensor) -> Tensor:
        """Return 1 where a belief ``[..., Z]`` is of the second type of bomb, else 0.

        Beliefs are always of one type, because an unknown type is guessed.
        """
        return (self.self_model.decoders["verbal"](belief).mean[..., 0, 0] > EVEN_ODDS).to(belief)

    def _exchanged(self, presses: Tensor, rule: Tensor) -> Tensor:
        """Return values ``[..., P, B, 4]`` of buttons under a rule ``[..., P, 1]``."""
        order = self.exchanges.argmax(-1)[rule.long()]  # [..., P, 1, 4]
        shape = broadcast_shapes(order.shape, presses.shape)
        return presses.expand(shape).gather(-1, order.expand(shape))

    @torch.no_grad()
    def fit_world(self, demonstrations: Demonstrations) -> None:
        """Learn the true rules from recorded rewards: their posterior becomes the prior.

        The rules are shared by all people, so all rounds are pooled. The posterior is exact: every
        rule is enumerated. The robot sees everything, and its rewards are those of its simulator.

        Args:
            demonstrations: rounds with rewards; without rewards nothing is learned.
        """
        if demonstrations.rewards is None:
            self.rule_logits.copy_(self._prior_of_rules())
            return
        observation = demonstrations.observation()
        steps = demonstrations.shape[2]
        pressed = demonstrations.mask & (demonstrations.actions > 0)
        seen = {name: value[:, :, :steps][pressed] for name, value in observation.items()}
        button, reward = demonstrations.actions[pressed] - 1, demonstrations.rewards[pressed]
        kind = seen["verbal"][..., 0, 0].long()
        world = self.domain.as_believed
        state = world.state_behind(seen)
        scores = []
        for robot in range(self.exchanges.shape[-1]):  # the button that the robot would press
            action = torch.full_like(button, 1 + robot)
            expected = total_reward(world.rewards(state, action, world.transition(state, action)))
            scores.append(dist.Normal(expected, REWARD_SCALE).log_prob(reward))
        scores = torch.stack(scores, -1)  # [n, 4]
        logits = self._prior_of_rules()
        for number in range(len(KINDS)):
            some = kind == number
            under = self.exchanges[:, button[some]]  # [24, n, 4]
            logits[number] += (under * scores[some]).sum((1, 2))
        self.rule_logits.copy_(logits - logits.logsumexp(-1, keepdim=True))

    def planning_domain(self, draws: Mapping[str, Tensor]) -> Domain:
        """Return the domain with the most probable rules."""
        rules = []
        for kind, logits, row in zip(
            self.kinds, self.rule_logits, self.domain.as_believed.rules, strict=True
        ):
            site = RULE + kind
            own = draws[site].flatten().long().mode().values if site in draws else logits.argmax()
            likeliest = int(own)
            pressed = self.exchanges[likeliest].argmax(0)  # by the button that the robot would
            rules.append(tuple(int(pressed[button]) for button in row))
        return BombDefusal(tuple(rules))
