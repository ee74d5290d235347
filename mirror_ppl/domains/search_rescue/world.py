"""Search and rescue: a burning house in nine portions (supplement, sections A and E, Table I).

Description
    A firefighter looks for a victim and brings them back to the entrance. The house is a map of 9
    by 9 cells, in 3 by 3 portions of 3 by 3 cells::

        . . . . . . . . .      three rooms, a potential place of the victim (v) in the middle of
        . v . . v . . v .      each
        . . . . . . . . .
        # o # # # # # o #      two corridors; an obstacle (o) may block one of them
        # o # # # # # o #
        # o # # # # # o #
        . . . . . . . . .      the hall, with the entrance (e)
        . . . . . . . . .
        . . . . e . . . .

    A scenario says where the victim is (three places) and which corridor is blocked, in its middle
    (none, left or right): nine in all. The house itself is known to all people.

Actions
    0 up, 1 down, 2 left, 3 right: one cell, if there is neither wall nor obstacle.

Observations
    ========  ============  =======  ===============================================================
    ego       row, column   cells    where the firefighter is, 0 at the top and left; always known
    ego       carrying      0 or 1   whether they have the victim with them
    visual    27 numbers    0 to 1   pixels of each portion of the map: row, column, red-green-blue
    verbal    holds         0 or 1   whether the statement about an item holds: the corridor is
                                     blocked, the victim is in that room
    ========  ============  =======  ===============================================================

    Pixels are a cell each: light floor, dark walls, a yellow entrance, a red obstacle in the left
    corridor and a purple one in the right, a green victim. A victim who was found is no longer on
    the map. In clear air everything is seen, and heard; in smoke the portions whose centre is at
    most 1.5 cells away, which is the one that the firefighter is in, and nothing is heard.

Rewards, of the action and the state that it leads to
    =========  ====  ================================================
    found      +1    for coming to where the victim is
    returned   +15   for being back at the entrance with the victim
    collision  -10   for walking into the obstacle
    time       -0.1  for each step until then
    =========  ====  ================================================

Start and end
    A round begins at the entrance. It is over when they are back there with the victim, where they
    stay, or after 48 steps.

Version history
    1: first version.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import one_hot

from mirror_ppl.domains.base import Observation, Visibility, require_known
from mirror_ppl.domains.modality import Modality
from mirror_ppl.domains.search_rescue.drawing import LEGEND, draw_house
from mirror_ppl.domains.search_rescue.estimate import nearest_to, state_of
from mirror_ppl.domains.search_rescue.house import (
    CORRIDORS,
    ENTRANCE,
    PORTION,
    PORTIONS,
    ROOMS,
    SIDE,
    at_entrance,
    portion_centres,
    portion_pixels,
    reach_distances,
    walkable,
)
from mirror_ppl.domains.search_rescue.knowledge import (
    CORRIDOR_PORTIONS,
    ROOM_PORTIONS,
    HouseKnowledge,
)
from mirror_ppl.domains.search_rescue.moves import (
    MOVES,
    RescueState,
    action_values,
    at_victim,
    earned,
    moved,
    obstructed,
)
from mirror_ppl.domains.search_rescue.record import RECORD
from mirror_ppl.domains.world import World

SMOKE_REACH = 1.5
"""Sight of a firefighter in smoke, in cells to the centre of a portion."""
BEGINNINGS = 0.25
"""Share of the robot's training rounds that begin in ordinary initial states."""

UTTERANCES: Mapping[str, tuple[str, str]] = {
    **{
        f"{side} corridor": (f"{side} corridor clear", f"{side} corridor blocked")
        for side in CORRIDORS
    },
    **{room: (f"victim not in {room}", f"victim in {room}") for room in ROOMS},
}
"""Utterances about each verbal item, if it does not hold and if it does."""


class SearchRescue(World):
    """The domain of search and rescue; see the module's description."""

    name = "search_rescue"
    record = RECORD
    version = "1"
    modalities: tuple[Modality, ...] = (
        Modality(
            "visual",
            PORTIONS,
            tuple(
                f"pixel {row} {column} {colour}"
                for row in range(PORTION)
                for column in range(PORTION)
                for colour in ("red", "green", "blue")
            ),
            ("intensity",) * 3 * PORTION**2,
            (1.0,) * 3 * PORTION**2,
            0.02,
            image=(PORTION, PORTION, 3),
        ),
        Modality(
            "verbal",
            tuple(UTTERANCES),
            ("holds",),
            ("truth",),
            (1.0,),
            0.1,
            utterances=tuple(UTTERANCES.values()),
        ),
    )
    ego_features: tuple[str, ...] = ("row", "column", "carrying")
    symbol_sizes: Mapping[str, int] = {"ego": 2 * SIDE + 1, "visual": 3 * PORTION**2, "verbal": 2}
    actions: tuple[str, ...] = tuple(MOVES)
    horizon = 48
    over_at_horizon = False
    settings: tuple[str, ...] = ("clear", "smoke")
    scenarios: tuple[str, ...] = tuple(
        f"victim {room}, {blocked}"
        for blocked in ("no corridor blocked", "left corridor blocked", "right corridor blocked")
        for room in ROOMS
    )
    reward_terms: tuple[str, ...] = ("found", "returned", "collision", "time")
    mishap: tuple[str, str] = ("collision", "collisions")
    picture_legend = LEGEND
    directions: tuple[str, ...] = ("radius",)
    reach_bins: tuple[float, ...] = reach_distances()
    """Radii in cells, one for each set of radii with equal sight from every place."""
    reach_unit = "cells"
    # People in smoke differ in whether they see a few steps ahead or only beside them.
    reach_practice: tuple[float, ...] = tuple(
        4.0 if abs(radius - SMOKE_REACH) <= 1 else 1.0 for radius in reach_distances()
    )
    told_practice = 0.05
    partial_views: Mapping[str, tuple[float, ...]] = {"smoke": (SMOKE_REACH,)}
    assumptions: tuple[str, ...] = ("open",)
    """An unknown corridor is not blocked."""

    def initial(
        self, batch: int, generator: torch.Generator, scenario: Tensor | None = None
    ) -> RescueState:
        """Draw states ``[batch]`` at the entrance.

        Args:
            batch: number of rounds.
            generator: source of randomness; its device is that of the states.
            scenario: indices ``[batch]`` into ``scenarios``; drawn uniformly unless given.
        """
        device = generator.device
        scenario = self.scenario(batch, generator, scenario)
        never = torch.zeros(batch, dtype=torch.bool, device=device)
        return RescueState(
            place=torch.tensor(ENTRANCE, device=device).expand(batch, 2),
            found=never,
            home=never,
            blocked=scenario // len(ROOMS),
            victim=scenario % len(ROOMS),
        )

    def anywhere(self, batch: int, generator: torch.Generator) -> RescueState:
        """Draw states ``[batch]``: a quarter as rounds begin, the others anywhere on the floor.

        In half of the latter the victim is carried.
        """
        state = self.initial(batch, generator)
        cells = torch.cartesian_prod(torch.arange(SIDE), torch.arange(SIDE))
        cells = cells[walkable(cells)].to(generator.device)
        cell = torch.randint(len(cells), (batch,), generator=generator, device=generator.device)
        place = cells[cell]
        # No firefighter stands on the obstacle.
        place = torch.where(obstructed(state, place)[..., None], state.place, place)
        carried = torch.rand(batch, generator=generator, device=generator.device) < 0.5  # noqa: PLR2004
        found = carried | at_victim(state, place)
        begins = torch.rand(batch, generator=generator, device=generator.device) < BEGINNINGS
        place = torch.where(begins[..., None], state.place, place)
        found = found & ~begins
        return replace(state, place=place, found=found, home=found & at_entrance(place))

    def transition(self, state: RescueState, action: Tensor) -> RescueState:
        """Return the state at t + 1; ``action`` ``[...]`` is an index into ``actions``."""
        return moved(state, action)

    def rewards(
        self, state: RescueState, action: Tensor, following: RescueState
    ) -> dict[str, Tensor]:
        """Return reward terms ``[...]`` by name, in units of reward."""
        return earned(state, action, following)

    def over(self, state: RescueState) -> Tensor:
        """Return where they are back at the entrance with the victim ``[...]``."""
        return state.home

    def observe(self, state: RescueState) -> Observation:
        """Return ego ``[..., 3]``, visual ``[..., 9, 27]`` and verbal ``[..., 5, 1]``."""
        dtype = torch.get_default_dtype()
        device = state.place.device
        ego = torch.cat([state.place.to(dtype), state.found[..., None].to(dtype)], -1)
        rooms = torch.arange(len(ROOMS), device=device)
        sides = torch.arange(1, 1 + len(CORRIDORS), device=device)
        there = (state.victim[..., None] == rooms) & ~state.found[..., None]
        blocked = state.blocked[..., None] == sides
        holds = torch.cat([blocked, there], -1)
        return {"ego": ego, "visual": portion_pixels(holds), "verbal": holds[..., None].to(dtype)}

    def visibility(self, setting: str, observation: Observation) -> Visibility:
        """Return what an unaided person sees and hears in a setting.

        Raises:
            UnknownNameError: if the setting is neither ``clear`` nor ``smoke``.
        """
        require_known(setting, "setting", self.settings, self.name)
        _, distance = self.distance(observation)
        everything = torch.ones_like(observation["verbal"][..., 0], dtype=torch.bool)
        if setting == "clear":
            return {"visual": torch.ones_like(distance, dtype=torch.bool), "verbal": everything}
        return {"visual": distance <= SMOKE_REACH, "verbal": ~everything}

    def faults(self, observation: Observation) -> dict[str, Tensor]:
        """Return which observations ``[...]`` break each rule of recordings, by rule."""
        place, carrying = observation["ego"][..., :2], observation["ego"][..., 2]
        holds = observation["verbal"][..., 0]
        known = (holds == 0) | (holds == 1)
        whole = (place == place.round()).all(-1)
        pixels = portion_pixels(holds == 1)
        return {
            "row and column have to be those of a cell that can be walked on": ~(
                whole & walkable(place.long())
            ),
            "carrying has to be 0 or 1": (carrying != 0) & (carrying != 1),
            "holds has to be 0 or 1": ~known.all(-1),
            "at most one corridor can be blocked": holds[..., :2].sum(-1) > 1,
            "the victim has to be in one room, or carried": (
                holds[..., 2:].sum(-1) + carrying != 1
            ),
            "visual pixels, from 0 to 1, have to show what verbal items say": (
                (observation["visual"] - pixels).abs() > 1e-3  # noqa: PLR2004 - of rounding
            ).any((-1, -2)),
        }

    def nothing_known(self, *batch: int, device: torch.device | None = None) -> HouseKnowledge:
        """Return knowledge ``[*batch]`` before anything was observed."""
        return HouseKnowledge.nothing(*batch, device=device)

    def learn(
        self,
        knowledge: HouseKnowledge,
        observation: Observation,
        visible: Visibility,
        sees: Callable[[Observation], Visibility],
    ) -> HouseKnowledge:
        """Return knowledge after a step: what was shown or said, and its implications."""
        del sees
        return knowledge.learn(observation, visible)

    def known(self, knowledge: HouseKnowledge) -> Visibility:
        """Return portions ``[..., 9]`` and utterances ``[..., 5]`` whose content is known."""
        return knowledge.items()

    def assume(
        self, knowledge: HouseKnowledge, observation: Observation
    ) -> tuple[dict[str, Visibility], Observation]:
        """Return the assumption ``open``: unknown corridors are imagined to be free."""
        unknown = ~knowledge.corridors
        corridors, rooms = len(CORRIDORS), len(ROOMS)
        items = {
            "visual": torch.zeros(*unknown.shape[:-1], len(PORTIONS), dtype=torch.bool),
            "verbal": torch.zeros(*unknown.shape[:-1], corridors + rooms, dtype=torch.bool),
        }
        items = {name: mask.to(unknown.device) for name, mask in items.items()}
        items["visual"][..., list(CORRIDOR_PORTIONS)] = unknown
        items["verbal"][..., :corridors] = unknown
        holds = observation["verbal"][..., 0] == 1
        known = torch.nn.functional.pad(knowledge.corridors, [0, rooms], value=True)
        holds = holds & known
        imagined = {"visual": portion_pixels(holds), "verbal": holds[..., None]}
        imagined = {name: value.to(observation[name]) for name, value in imagined.items()}
        return {"open": items}, {"ego": observation["ego"], **imagined}

    def supposed(
        self, state: RescueState, knowledge: HouseKnowledge, assumes: Mapping[str, Tensor]
    ) -> RescueState:
        """Return the state without an unknown obstacle, for people who assume ``open``."""
        sides = torch.arange(1, 1 + len(CORRIDORS), device=state.blocked.device)
        known = ((state.blocked[..., None] == sides) & knowledge.corridors).any(-1)
        return replace(state, blocked=torch.where(known | ~assumes["open"], state.blocked, 0))

    def symbols(self, observation: Observation) -> dict[str, Tensor]:
        """Encode observations for networks.

        Returns:
            ego ``[..., 19]``, one-hot row and column, and whether they carry the victim; visual
            ``[..., 9, 27]``, raw pixels; verbal ``[..., 5, 2]``, one-hot which of the two
            utterances about an item is true.
        """
        place = observation["ego"][..., :2].long()
        parts = [
            one_hot(place, SIDE).flatten(-2).to(observation["ego"]),
            observation["ego"][..., 2:],
        ]
        said = one_hot(observation["verbal"][..., 0].long(), 2).to(observation["ego"])
        return {"ego": torch.cat(parts, -1), "visual": observation["visual"], "verbal": said}

    def distance(self, observation: Observation) -> tuple[Tensor, Tensor]:
        """Return the only direction, and distances in cells to the centre of each portion."""
        place = observation["ego"][..., None, :2]
        distance = (place - portion_centres().to(place)).pow(2).sum(-1).sqrt()
        return torch.zeros_like(distance, dtype=torch.long), distance

    def state_behind(self, observation: Observation) -> RescueState:
        """Return the state ``[...]`` with this full observation; see `state_of`."""
        return state_of(observation)

    def nearest(self, observation: Observation) -> Observation:
        """Return the possible observation nearest to decoded values; see `nearest_to`."""
        return nearest_to(observation, self.observe)

    def relevance(self, observation: Observation) -> dict[str, Visibility]:
        """Return the items of the victim and the obstacle (supplement, section F)."""
        holds = observation["verbal"][..., 0] == 1
        portions = torch.zeros_like(observation["visual"][..., 0], dtype=torch.bool)
        portions[..., [*CORRIDOR_PORTIONS, *ROOM_PORTIONS]] = holds
        return {"goal_and_obstacle": {"visual": portions, "verbal": holds}}

    def describe(self, observation: Observation, modality: str, item: str) -> str:
        """Describe an item, such as "victim in top-right"."""
        holds = observation["verbal"][:, 0].int().tolist()
        said = [about[value] for about, value in zip(UTTERANCES.values(), holds, strict=True)]
        if modality == "verbal":
            return said[tuple(UTTERANCES).index(item)]
        telling, number = (*CORRIDOR_PORTIONS, *ROOM_PORTIONS), PORTIONS.index(item)
        shows = f" ({said[telling.index(number)]})" if number in telling else ""
        return f"the {item} of the map{shows}"

    def deed(self, observation: Observation, item: str | None, action: int) -> str:
        """Describe an action, such as "go up"."""
        del observation, item
        return f"go {self.actions[action]}"

    def reference_values(self, state: RescueState, discount: float) -> Tensor:
        """Return exact action values ``[..., 4]`` of known states, without a horizon."""
        table = action_values(discount).to(state.place.device)
        row, column = state.place.unbind(-1)
        found, home = state.found.long(), state.home
        values = table[state.blocked, state.victim, found, row, column]
        return torch.where(home[..., None], 0.0, values)

    def render(self, state: RescueState) -> np.ndarray:
        """Draw ``uint8 [height, width, 3]`` of one state: the map, the firefighter in blue."""
        return draw_house(self.observe(state)["visual"], state.place)

    def render_seen(self, state: RescueState, visible: Visibility) -> np.ndarray:
        """Draw one state, darkening portions outside of ``visible["visual"]`` ``[9]``."""
        return draw_house(self.observe(state)["visual"], state.place, visible["visual"])
