"""Simulated firefighters: their memory, subgoals and moves (supplement, section B).

A firefighter goes from one subgoal to the next: a corridor, a room where the victim may be, the
entrance. A subgoal is given up when it was reached, or when knowledge of the house rules it out: a
corridor that is blocked, a room that is empty. A firefighter who learns about the victim's place
chooses anew, as at the entrance. The next subgoal is chosen among those that are possible:

===================  ===========================================================================
``radius``           how far they see, in cells to the centre of a portion of the map
``k_t``              what they know at step t from sight and messages
``v_t``              the rooms where the victim may be, given ``k_t``
``g_t``              their subgoal; ``G_t`` are the possible subgoals, given ``k_t``
``transitions``      preferences for the next subgoal, by ``v_t`` and present subgoal
``lapse``            probability of a step in a random direction
===================  ===========================================================================

``p(g_t | g_{t-1}, k_t) = transitions[v_t, g_{t-1}, g_t] / sum over G_t``, if ``g_{t-1}`` is not in
``G_t``, or if ``v_t`` changes on the way to the rooms; else ``g_t = g_{t-1}``.

``p(a_t | g_t, k_t) = (1 - lapse) * uniform over steps on a shortest way to g_t + lapse / 4``

Choices that the supplement does not specify, and their reasons, are in ``docs/people.md``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import ClassVar

import torch
from torch import Tensor

from mirror_ppl.domains.base import Observation, Visibility, by_eye
from mirror_ppl.domains.search_rescue.house import CORRIDORS, ENTRANCE, ROOMS, SIDE, walkable
from mirror_ppl.domains.search_rescue.knowledge import HouseKnowledge
from mirror_ppl.domains.search_rescue.moves import MOVES
from mirror_ppl.domains.search_rescue.world import SearchRescue
from mirror_ppl.people.base import SimulatedPeople, each

SUBGOALS: dict[str, tuple[int, int]] = {
    **{f"{side} corridor": place for side, place in CORRIDORS.items()},
    **ROOMS,
    "entrance": ENTRANCE,
}
"""Places of subgoals: the middle of each corridor, of each room, and the entrance."""
HOME = list(SUBGOALS).index("entrance")
MIDDLE_ROW = CORRIDORS["left"][0]
"""Row that divides the house: the half of the hall is below, that of the rooms above."""
FAR = 1000


@dataclass(frozen=True)
class Mind:
    """Knowledge and subgoals of firefighters.

    Attributes:
        corridors: corridors known to be blocked or clear, ``[..., 2]``.
        rooms: rooms known to have the victim or not, ``[..., 3]``.
        goal: the subgoal, an index into ``SUBGOALS``, ``[...]``.
        mind_noise: uniform numbers that choose the subgoal after each, ``[..., 6, 6]``.
    """

    corridors: Tensor
    rooms: Tensor
    goal: Tensor
    mind_noise: Tensor


@dataclass(frozen=True)
class SimulatedFirefighters(SimulatedPeople):
    """P simulated firefighters.

    Attributes:
        radius: how far each sees, in cells to the centre of a portion, ``[P]``.
        transitions: weights of the next subgoal given the present one, ``[P, 8, 6, 6]``, by the
            rooms where the victim may be (see `possible_rooms`); only ratios within a row matter.
        lapse: probability ``[P]`` of a step in any direction.
    """

    radius: Tensor
    transitions: Tensor
    lapse: Tensor

    mind_noises: ClassVar[int] = len(SUBGOALS) ** 2

    @property
    def domain(self) -> SearchRescue:
        """Search and rescue domain."""
        return SearchRescue()

    def truth(self) -> dict[str, Tensor]:
        """Return their radius of sight and their lapse probability."""
        return {"sight_radius": self.radius, "lapse": self.lapse}

    def start(self, *batch: int, mind_noise: Tensor | None = None) -> Mind:
        """Return minds ``[P, *batch]`` at the entrance; see `SimulatedPeople.start`."""
        shape, device = (len(self.radius), *batch), self.radius.device
        knowledge = HouseKnowledge.nothing(*shape, device=device)
        if mind_noise is None:
            mind_noise = torch.full((*shape, self.mind_noises), 0.5, device=device)
        return Mind(
            knowledge.corridors,
            knowledge.rooms,
            torch.full(shape, HOME, device=device),
            mind_noise.unflatten(-1, (len(SUBGOALS), len(SUBGOALS))),
        )

    def sees(self, observation: Observation) -> Visibility:
        """Return the portions ``[P, ..., 9]`` within their radius; no utterances."""
        _, distance = self.domain.distance(observation)
        return by_eye(self.domain, distance <= each(self.radius, distance.dim() - 1))

    def step(
        self, memory: Mind, observation: Observation, told: Visibility | None = None
    ) -> tuple[Tensor, Mind]:
        """Look, listen, choose where to go, and go; see `SimulatedPeople.step`."""
        knowledge = self._learn(memory, observation, told)
        chance = self._next(memory, knowledge, observation)
        here = memory.goal[..., None, None]
        row = chance.take_along_dim(here, -2).squeeze(-2)
        # Gumbel-max trick: the argmax is a draw with these probabilities.
        noise = -(-memory.mind_noise.take_along_dim(here, -2).squeeze(-2).log()).log()
        goal = (row.log() + noise).argmax(-1)
        steps = self._steps(knowledge, observation)
        probability = steps.take_along_dim(goal[..., None, None], -2).squeeze(-2)
        return probability, Mind(knowledge.corridors, knowledge.rooms, goal, memory.mind_noise)

    def branches(
        self, memory: Mind, observation: Observation, told: Visibility
    ) -> tuple[Tensor, Mind, Tensor]:
        """Return all next subgoals, ``G`` = 6; see `SimulatedPeople.branches`."""
        knowledge = self._learn(memory, observation, told)
        chance = self._next(memory, knowledge, observation)
        chance = chance.take_along_dim(memory.goal[..., None, None], -2).squeeze(-2)
        every = torch.arange(len(SUBGOALS), device=chance.device)

        def of_each(part: Tensor, behind: int) -> Tensor:
            part = part.unsqueeze(-1 - behind)
            return part.expand(*chance.shape, *part.shape[chance.dim() :])

        minds = Mind(
            of_each(knowledge.corridors, 1),
            of_each(knowledge.rooms, 1),
            every.expand(chance.shape),
            of_each(memory.mind_noise, 2),
        )
        return chance, minds, self._steps(knowledge, observation)

    def kept(self, memory: Mind) -> Mind:
        """Return knowledge and subgoal; see `SimulatedPeople.kept`."""
        return replace(memory, mind_noise=memory.mind_noise[..., :0, :0])

    def predictive(
        self, probabilities: Tensor, observation: Observation, actions: Tensor, told: Visibility
    ) -> Tensor:
        """Return probabilities of actions ``[P, B, T, A]``, given the actions before each.

        The subgoal is filtered exactly: ``p(g_t | a_1, ..., a_{t-1})``.
        """
        memory = self.start(actions.shape[1])
        goals = torch.nn.functional.one_hot(memory.goal, len(SUBGOALS)).to(probabilities.dtype)
        found = []
        for step, action in enumerate(actions.unbind(-1)):
            now = {name: value[:, :, step] for name, value in observation.items()}
            heard = {name: mask[:, :, step] for name, mask in told.items()}
            knowledge = self._learn(memory, now, heard)
            chance = self._next(memory, knowledge, now)
            memory = Mind(knowledge.corridors, knowledge.rooms, memory.goal, memory.mind_noise)
            goals = (goals[..., None, :] @ chance).squeeze(-2)
            steps = self._steps(knowledge, now)
            found.append((goals[..., None] * steps).sum(-2))
            goals = goals * steps.take_along_dim(action[..., None, None], -1).squeeze(-1)
            goals = goals / goals.sum(-1, keepdim=True)
        return torch.stack(found, 2)

    def _learn(
        self, memory: Mind, observation: Observation, told: Visibility | None
    ) -> HouseKnowledge:
        visible = self.sees(observation)
        if told is not None:
            visible = {name: mask | told[name] for name, mask in visible.items()}
        return HouseKnowledge(memory.corridors, memory.rooms).learn(observation, visible)

    def _next(self, memory: Mind, knowledge: HouseKnowledge, observation: Observation) -> Tensor:
        """Return the probability ``[P, ..., 6, 6]`` of each subgoal, given the one before."""
        possible = possible_subgoals(knowledge, observation)
        rooms = possible_rooms(knowledge, observation)
        people = torch.arange(len(self.transitions), device=rooms.device)
        liked = self.transitions[each(people, rooms.dim() - 1), rooms] * possible[..., None, :]
        chosen = liked / liked.sum(-1, keepdim=True)
        stays = torch.eye(len(SUBGOALS), dtype=liked.dtype, device=liked.device)
        following = torch.where(possible[..., None], stays, chosen)
        before = possible_rooms(HouseKnowledge(memory.corridors, memory.rooms), observation)
        carrying, below = observation["ego"][..., 2] == 1, observation["ego"][..., 0] > MIDDLE_ROW
        news = (rooms != before) & below & ~carrying
        return torch.where(news[..., None, None], chosen[..., HOME : HOME + 1, :], following)

    def _steps(self, knowledge: HouseKnowledge, observation: Observation) -> Tensor:
        """Return the probability ``[P, ..., 6, 4]`` of each action, given the subgoal."""
        place = observation["ego"][..., :2].long()
        barred = _barred(knowledge, observation)
        known = (barred * torch.arange(1, 3, device=barred.device)).sum(-1)
        uniform = _distances_and_ways()[1].to(place.device)[known, place[..., 0], place[..., 1]]
        lapse = each(self.lapse, uniform.dim() - 1)
        return (1 - lapse) * uniform + lapse / len(MOVES)


def possible_rooms(knowledge: HouseKnowledge, observation: Observation) -> Tensor:
    """Return the rooms where the victim may be: 1, 2 and 4 for the rooms, added up ``[...]``.

    It no longer matters for a victim who is carried.
    """
    holds = observation["verbal"][..., len(CORRIDORS) :, 0] == 1
    may_be = ~knowledge.rooms | holds
    return (may_be * 2 ** torch.arange(len(ROOMS), device=may_be.device)).sum(-1)


def possible_subgoals(knowledge: HouseKnowledge, observation: Observation) -> Tensor:
    """Return which subgoals are possible, boolean ``[..., 6]``.

    - On the way to the rooms, and back from there with the victim: a corridor that is not known to
      be blocked.
    - In the half of the rooms, without the victim: a room where the victim may be.
    - In the half of the hall, with the victim: the entrance.
    """
    row, carrying = observation["ego"][..., 0], observation["ego"][..., 2] == 1
    holds = observation["verbal"][..., 0] == 1
    passing = torch.where(carrying, row < MIDDLE_ROW, row > MIDDLE_ROW)
    corridors = passing[..., None] & ~_barred(knowledge, observation)
    may_be = ~knowledge.rooms | holds[..., len(CORRIDORS) :]
    rooms = (~carrying & ~passing)[..., None] & may_be
    return torch.cat([corridors, rooms, (carrying & ~passing)[..., None]], -1)


def _barred(knowledge: HouseKnowledge, observation: Observation) -> Tensor:
    """Return which corridors ``[..., 2]`` are known to be blocked."""
    return knowledge.corridors & (observation["verbal"][..., : len(CORRIDORS), 0] == 1)


def subgoal_distances() -> Tensor:
    """Return steps between subgoals in a house without obstacles, ``[6, 6]``."""
    row, column = torch.tensor(list(SUBGOALS.values())).unbind(-1)
    return _distances_and_ways()[0][0][row, column]


@cache
def _distances_and_ways() -> tuple[Tensor, Tensor]:
    """Return steps to each subgoal ``[3, 9, 9, 6]``, and first steps of shortest paths.

    The latter are uniform probabilities ``[3, 9, 9, 6, 4]``. Dimensions are the corridor known to
    be blocked (0 none), row, column, subgoal and action. Without a path, and at the subgoal, all
    actions are equally probable.
    """
    cells = torch.cartesian_prod(torch.arange(SIDE), torch.arange(SIDE))
    moves = torch.tensor(list(MOVES.values()))
    goals = torch.tensor(list(SUBGOALS.values()))
    ways, distances = [], []
    for blocked in [None, *CORRIDORS.values()]:
        free = walkable(cells)
        if blocked is not None:
            free = free & (cells != torch.tensor(blocked)).any(-1)
        beside = cells[:, None] + moves  # [81, 4, 2]
        inside = ((beside >= 0) & (beside < SIDE)).all(-1)
        target = (beside.clamp(0, SIDE - 1) * torch.tensor([SIDE, 1])).sum(-1)
        leads = inside & free[target] & free[:, None]
        far = torch.full((SIDE**2, len(goals)), FAR)
        at = goals[:, 0] * SIDE + goals[:, 1]
        far[at, torch.arange(len(goals))] = 0
        for _ in range(SIDE**2):
            through = torch.where(leads[..., None], far[target] + 1, FAR).amin(1)
            far = torch.minimum(far, through)
        nearer = leads[..., None] & (far[target] < far[:, None]) & (far[:, None] < FAR)
        good = nearer.transpose(1, 2).to(torch.get_default_dtype())  # [81, 6, 4]
        total = good.sum(-1, keepdim=True)
        uniform = torch.where(total > 0, good / total.clamp(min=1), 1 / len(moves))
        ways.append(uniform.view(SIDE, SIDE, len(goals), len(moves)))
        distances.append(far.view(SIDE, SIDE, len(goals)))
    return torch.stack(distances), torch.stack(ways)
