"""Simulated people who defuse bombs: their memory and actions (supplement, section B).

A person who does not know the type of the bomb guesses it once per round. At every stage they look
for the lit terminal and find it at each step with their own probability. Once they found it, or
were shown it, they press the button that is right for the believed type; until then they wait:

====================  ==========================================================================
``notices``           probability of finding each terminal at a step
``k_t``               the type that they believe: the known type, else their guess
``f_t``               whether they have found the lit terminal
====================  ==========================================================================

``p(f_t | not f_{t-1}) = notices[terminal]``, and ``a_t`` is the right button for ``k_t`` if
``f_t``, else to wait. They do not learn the type from penalties: a wrong guess stays wrong.

Choices that the supplement does not specify, and their reasons, are in ``docs/people.md``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.domains.bomb_defusal.panel import KINDS, STAGES, read_panel, right_button
from mirror_ppl.domains.bomb_defusal.world import WAIT, BombDefusal
from mirror_ppl.people.base import SimulatedPeople, each

UNDECIDED = -1
"""The guess before a person has guessed."""


@dataclass(frozen=True)
class Mind:
    """Knowledge and guesses of people.

    Attributes:
        informed: whether they know the type ``[...]``.
        guess: the guessed type, used if they do not ``[...]``.
        found: whether they have found the lit terminal ``[...]``, at ``stage`` ``[...]``.
        step: number of the next step ``[...]``.
        mind_noise: uniform numbers ``[..., 1 + T]``: for the guess, and the search at each step.
    """

    informed: Tensor
    guess: Tensor
    found: Tensor
    stage: Tensor
    step: Tensor
    mind_noise: Tensor


@dataclass(frozen=True)
class SimulatedDefusers(SimulatedPeople):
    """P simulated people who defuse bombs.

    Attributes:
        notices: probability of finding each terminal at a step ``[P, 6]``.
        reads: whether each can read the type on the bomb ``[P]``.
    """

    notices: Tensor
    reads: Tensor

    mind_noises: ClassVar[int] = 1 + BombDefusal.horizon

    @property
    def domain(self) -> BombDefusal:
        """Bomb defusal domain, with the true rules."""
        return BombDefusal()

    def truth(self) -> dict[str, Tensor]:
        """Return the probabilities of finding each terminal at a step."""
        items = self.domain.modalities[0].items
        return {f"notices_{item}": self.notices[:, place] for place, item in enumerate(items)}

    def start(self, *batch: int, mind_noise: Tensor | None = None) -> Mind:
        """Return minds ``[P, *batch]`` before a round; see `SimulatedPeople.start`."""
        shape, device = (len(self.notices), *batch), self.notices.device
        if mind_noise is None:
            mind_noise = torch.full((*shape, self.mind_noises), 0.5, device=device)
        never = torch.zeros(shape, dtype=torch.bool, device=device)
        nothing = torch.zeros(shape, dtype=torch.long, device=device)
        return Mind(never, nothing + UNDECIDED, never, nothing, nothing, mind_noise)

    def sees(self, observation: Observation) -> Visibility:
        """Return what they see at once: no terminal, and the type if they can read it."""
        nothing = torch.zeros_like(observation["visual"][..., 0], dtype=torch.bool)
        verbal = observation["verbal"][..., 0]
        reads = each(self.reads, verbal.dim() - 1)
        return {"visual": nothing, "verbal": reads.expand(verbal.shape)}

    def step(
        self, memory: Mind, observation: Observation, told: Visibility | None = None
    ) -> tuple[Tensor, Mind]:
        """Look, listen, and press; see `SimulatedPeople.step`."""
        decided, chance = self._look(memory, observation, told)
        noise = memory.mind_noise.take_along_dim(1 + memory.step[..., None], -1).squeeze(-1)
        first = (memory.mind_noise[..., 0] * len(KINDS)).long()
        mind = replace(
            decided,
            guess=torch.where(decided.guess == UNDECIDED, first, decided.guess),
            found=decided.found | (noise < chance),
        )
        return self._acts(mind, observation), mind

    def branches(
        self, memory: Mind, observation: Observation, told: Visibility
    ) -> tuple[Tensor, Mind, Tensor]:
        """Return found or not with either guess, ``G`` = 4; see `SimulatedPeople.branches`."""
        decided, chance = self._look(memory, observation, told)
        found = torch.stack([1 - chance, chance], -1)
        found = torch.where(decided.found[..., None], found.new_tensor([0.0, 1.0]), found)
        kinds = len(KINDS)
        guess = one_hot(decided.guess.clamp(min=0), kinds).to(found.dtype)
        guess = torch.where((decided.guess == UNDECIDED)[..., None], 1 / kinds, guess)
        probabilities = (found[..., None] * guess[..., None, :]).flatten(-2)
        which = torch.arange(2 * kinds, device=probabilities.device).expand(probabilities.shape)

        def of_each(part: Tensor, behind: int = 0) -> Tensor:
            part = part.unsqueeze(-1 - behind)
            return part.expand(*probabilities.shape, *part.shape[probabilities.dim() :])

        minds = Mind(
            of_each(decided.informed),
            which % kinds,
            which >= kinds,
            of_each(decided.stage),
            of_each(decided.step),
            of_each(decided.mind_noise, 1),
        )
        seen = {
            name: value.unsqueeze(decided.guess.dim()).expand(
                *probabilities.shape, *value.shape[decided.guess.dim() :]
            )
            for name, value in observation.items()
        }
        return probabilities, minds, self._acts(minds, seen)

    def kept(self, memory: Mind) -> Mind:
        """Return knowledge, guess and found terminals; see `SimulatedPeople.kept`."""
        return replace(
            memory, step=torch.zeros_like(memory.step), mind_noise=memory.mind_noise[..., :0]
        )

    def predictive(
        self, probabilities: Tensor, observation: Observation, actions: Tensor, told: Visibility
    ) -> Tensor:
        """Return probabilities of actions ``[P, B, T, A]``, given the actions before each.

        A wait implies that the lit terminal was not found; a press reveals the guess.
        """
        now = {name: value[:, :, :-1] for name, value in observation.items()}
        chance, symbol = self._counts(now)
        true = now["verbal"][..., 0, 0].long()
        kinds = torch.arange(len(KINDS), device=true.device)
        buttons = right_button(
            self.domain.rules, kinds.expand(*symbol.shape, -1), symbol[..., None]
        )
        shown = told["visual"].take_along_dim(read_panel(now["visual"])[0][..., None], -1)
        chance = torch.where(shown.squeeze(-1), 1.0, chance)
        heard = told["verbal"][..., 0].long().cumsum(2) > 0
        informed = (self.sees(now)["verbal"][..., 0] | heard)[..., None]
        pressed = actions[..., None] == 1 + buttons
        # A press before they knew the type reveals their guess.
        silent = (actions == WAIT)[..., None] | informed
        telling = torch.where(silent, 1.0, pressed.to(chance.dtype))
        so_far = torch.cat([torch.ones_like(telling[:, :, :1]), telling[:, :, :-1]], 2).cumprod(2)
        guessed = so_far / so_far.sum(-1, keepdim=True).clamp(min=1e-12)
        believed = torch.where(informed, (true[..., None] == kinds).to(chance.dtype), guessed)
        press = one_hot(1 + buttons, len(self.domain.actions)).to(chance.dtype)
        press = (believed[..., None] * press).sum(-2)
        wait = one_hot(torch.zeros_like(symbol), len(self.domain.actions)).to(chance.dtype)
        found = chance[..., None] * press + (1 - chance)[..., None] * wait
        over = now["ego"][..., 0] >= STAGES
        return torch.where(over[..., None], wait, found)

    def _counts(self, observation: Observation) -> tuple[Tensor, Tensor]:
        """Return the probability of finding the lit terminal now ``[P, ...]``, and its symbol."""
        live, symbols = read_panel(observation["visual"])
        symbol = symbols.take_along_dim(live[..., None], -1).squeeze(-1)
        own = each(self.notices, live.dim() - 1)
        return own.expand(*live.shape, -1).take_along_dim(live[..., None], -1).squeeze(-1), symbol

    def _look(
        self, memory: Mind, observation: Observation, told: Visibility | None
    ) -> tuple[Mind, Tensor]:
        """Return minds before random events, and the probability of finding the terminal now."""
        chance, _ = self._counts(observation)
        stage = observation["ego"][..., 0].long()
        found = memory.found & (stage == memory.stage)
        heard = self.sees(observation)["verbal"][..., 0]
        if told is not None:
            live, _ = read_panel(observation["visual"])
            found = found | told["visual"].take_along_dim(live[..., None], -1).squeeze(-1)
            heard = heard | told["verbal"][..., 0]
        return replace(
            memory,
            informed=memory.informed | heard,
            found=found,
            stage=stage.expand(found.shape),
            step=(memory.step + 1).clamp(max=self.domain.horizon - 1),
        ), chance

    def _acts(self, mind: Mind, observation: Observation) -> Tensor:
        """Return probabilities of actions ``[P, ..., A]``: all but one are 0."""
        _, symbol = self._counts(observation)
        kind = torch.where(mind.informed, observation["verbal"][..., 0, 0].long(), mind.guess)
        button = right_button(self.domain.rules, kind, symbol)
        presses = mind.found & (observation["ego"][..., 0] < STAGES)
        action = torch.where(presses, 1 + button, WAIT)
        return one_hot(action, len(self.domain.actions)).to(self.notices.dtype)
