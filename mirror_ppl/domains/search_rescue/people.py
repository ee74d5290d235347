"""People who search and rescue: what they have in mind, and how they walk (supplement, section B).

A firefighter goes from one subgoal to the next: a corridor, a room where the victim may be, the
entrance. A subgoal is given up when it was reached, or when what is known of the house rules it
out: a corridor that is blocked, a room that is empty. Who learns something of where the victim is
thinks again, as if at the entrance. Then the next is chosen among those that are possible:

===================  ===========================================================================
``radius``           how far they see, in cells to the centre of a portion of the map
``k_t``              what they know at step t, of what they ever saw or were told
``v_t``              the rooms where the victim may be, for all they know
``g_t``              their subgoal; ``G_t`` are those that are possible, given ``k_t``
``transitions``      how they like to go on from a subgoal, by what they know of the victim
``lapse``            how often they step anywhere
===================  ===========================================================================

``p(g_t | g_{t-1}, k_t) = transitions[v_t, g_{t-1}, g_t] / sum over G_t``, if ``g_{t-1}`` is not in
``G_t`` or ``v_t`` is news to somebody on the way to the rooms; else they stay with it.

``p(a_t | g_t, k_t) = (1 - lapse) * uniform over steps on a shortest way to g_t + lapse / 4``

Choices that the supplement leaves open, with their reasons, are in ``docs/people.md``.
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
from mirror_ppl.domains.search_rescue.world import MOVES, SearchRescue
from mirror_ppl.people.base import SimulatedPeople, each

SUBGOALS: dict[str, tuple[int, int]] = {
    **{f"{side} corridor": place for side, place in CORRIDORS.items()},
    **ROOMS,
    "entrance": ENTRANCE,
}
"""Where subgoals are: the middle of each corridor, of each room, and the entrance."""
HOME = list(SUBGOALS).index("entrance")
MIDDLE_ROW = CORRIDORS["left"][0]
"""Who is below it is in the hall's half of the house, who is above it in the rooms'."""
FAR = 1000


@dataclass(frozen=True)
class Mind:
    """What a firefighter knows and wants.

    Attributes:
        corridors: whether it is known of each if it is blocked, ``[..., 2]``.
        rooms: whether it is known of each if the victim is there, ``[..., 3]``.
        goal: the subgoal, an index into ``SUBGOALS``, ``[...]``.
        mind_noise: uniform numbers that choose what comes after each subgoal, ``[..., 6, 6]``.
    """

    corridors: Tensor
    rooms: Tensor
    goal: Tensor
    mind_noise: Tensor


@dataclass(frozen=True)
class SimulatedFirefighters(SimulatedPeople):
    """P people who search and rescue.

    Attributes:
        radius: how far each sees, in cells to the centre of a portion, ``[P]``.
        transitions: how likely each goes on to a subgoal from another, ``[P, 8, 6, 6]``, by the
            rooms where the victim may be (see `possible_rooms`); only ratios within a row count.
        lapse: probability ``[P]`` of a step in any direction.
    """

    radius: Tensor
    transitions: Tensor
    lapse: Tensor

    mind_noises: ClassVar[int] = len(SUBGOALS) ** 2

    @property
    def domain(self) -> SearchRescue:
        """Search and rescue."""
        return SearchRescue()

    def truth(self) -> dict[str, Tensor]:
        """How far they see, and how often they step anywhere."""
        return {"sight_radius": self.radius, "lapse": self.lapse}

    def start(self, *batch: int, mind_noise: Tensor | None = None) -> Mind:
        """Minds ``[P, *batch]`` at the entrance; see `SimulatedPeople.start`."""
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
        """The portions ``[P, ..., 9]`` within their radius; they hear nothing by themselves."""
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
        # The largest of logarithms with Gumbel noise is a draw with these probabilities.
        noise = -(-memory.mind_noise.take_along_dim(here, -2).squeeze(-2).log()).log()
        goal = (row.log() + noise).argmax(-1)
        steps = self._steps(knowledge, observation)
        probability = steps.take_along_dim(goal[..., None, None], -2).squeeze(-2)
        return probability, Mind(knowledge.corridors, knowledge.rooms, goal, memory.mind_noise)

    def branches(
        self, memory: Mind, observation: Observation, told: Visibility
    ) -> tuple[Tensor, Mind, Tensor]:
        """Each subgoal ``G`` = 6 that they may have next; see `SimulatedPeople.branches`."""
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
        """What they know, and their subgoal."""
        return replace(memory, mind_noise=memory.mind_noise[..., :0, :0])

    def predictive(
        self, probabilities: Tensor, observation: Observation, actions: Tensor, told: Visibility
    ) -> Tensor:
        """Of actions ``[P, B, T, A]``, given what was done before but not what they had in mind.

        The subgoal is filtered: ``p(g_t | a_1, ..., a_{t-1})`` exactly.
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
        """Probability ``[P, ..., 6, 6]`` of each subgoal, by the subgoal before."""
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
        """Probability ``[P, ..., 6, 4]`` of each action on the way to each subgoal."""
        place = observation["ego"][..., :2].long()
        barred = _barred(knowledge, observation)
        known = (barred * torch.arange(1, 3, device=barred.device)).sum(-1)
        uniform = _distances_and_ways()[1].to(place.device)[known, place[..., 0], place[..., 1]]
        lapse = each(self.lapse, uniform.dim() - 1)
        return (1 - lapse) * uniform + lapse / len(MOVES)


def possible_rooms(knowledge: HouseKnowledge, observation: Observation) -> Tensor:
    """Where the victim may be, for all they know: 1, 2 and 4 for the rooms, added up ``[...]``.

    Of a victim who is carried that no longer matters.
    """
    holds = observation["verbal"][..., len(CORRIDORS) :, 0] == 1
    may_be = ~knowledge.rooms | holds
    return (may_be * 2 ** torch.arange(len(ROOMS), device=may_be.device)).sum(-1)


def possible_subgoals(knowledge: HouseKnowledge, observation: Observation) -> Tensor:
    """Which subgoals make sense, boolean ``[..., 6]``.

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
    """Which corridors ``[..., 2]`` are known to be blocked."""
    return knowledge.corridors & (observation["verbal"][..., : len(CORRIDORS), 0] == 1)


def subgoal_distances() -> Tensor:
    """Steps from each subgoal to each, in a house without obstacles, ``[6, 6]``."""
    row, column = torch.tensor(list(SUBGOALS.values())).unbind(-1)
    return _distances_and_ways()[0][0][row, column]


@cache
def _distances_and_ways() -> tuple[Tensor, Tensor]:
    """Steps to each subgoal ``[3, 9, 9, 6]``, and first steps of shortest ways.

    The latter are uniform probabilities ``[3, 9, 9, 6, 4]``. By the corridor that is known to be
    blocked (0 none), row, column, subgoal and action. Where there is no way, or nowhere to go,
    every action is as likely.
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
