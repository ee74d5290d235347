"""Gridworld driving: two lanes, four cars that never yield (supplement, sections A and E, Table I).

Description
    The person drives at constant speed; everything is measured in cells relative to their car.
    Two cars start ahead (one in each lane) and two behind, at random distances. A scenario says
    which of them speed up and which slow down; no car makes room for the person.

Actions
    ===  ========  ==============================================
    0    stay      keep the lane
    1    switch    be in the other lane at the next step
    ===  ========  ==============================================

Observations
    ========  ==================  ==========  ====================================================
    ego       lane                index       0 left, 1 right; always known
    visual    distance_ahead      cells       of each car, negative behind, saturating at +-12
    visual    lane_offset         lanes       lane of the car minus lane of the ego
    verbal    distance_ahead      cells       as above, as an utterance about each car
    verbal    lane_offset         lanes       as above
    verbal    relative_speed      cells/step  +1 faster than the ego, -1 slower; 0 off the road
    ========  ==================  ==========  ====================================================

    A distance of +-12 means that the car is off the visible road. In clear weather all cars are
    visible; in fog those up to two cells ahead (abreast included), in both lanes, and none behind.
    Verbal items are observed only if they are communicated.

Rewards, of the action and the state that it leads to
    ===========  ======  ============================================================
    proximity    -2      for each car of the ego's lane at most two cells away
    collision    -5      for each car in the ego's cell
    off_road     -5      lane index outside the road (the two actions cannot cause it)
    lane_change  -1      for switching lanes
    ===========  ======  ============================================================

Start and end
    A round begins with a random lane and random distances of 1 to 11 cells and lasts 15 steps,
    after which every car has left the neighbourhood of the ego. Collisions do not end it.

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
from mirror_ppl.domains.driving.cars import (
    CAR_LANES,
    CAR_SIDES,
    CARS,
    SCENARIO_SPEEDS,
    DrivingState,
)
from mirror_ppl.domains.driving.knowledge import (
    ASSUMPTIONS,
    ROAD_END,
    CarKnowledge,
    assumed_cars,
)
from mirror_ppl.domains.driving.record import RECORD
from mirror_ppl.domains.driving.rewards import (
    COLLISION,
    LANE_CHANGE,
    NEAR,
    OFF_ROAD,
    PROXIMITY,
    known_car_values,
)
from mirror_ppl.domains.modality import Modality
from mirror_ppl.domains.world import World

STAY, SWITCH = 0, 1
ORANGE, PALE, DARK_BLUE = (230, 159, 0), (246, 221, 166), (0, 90, 160)
"""Colours of cars, of cars that are not perceived, and of the person's, which is dark for greys."""
FOG_REACH = 2
"""Number of cells ahead that a person sees in dense fog."""


class Driving(World):
    """The driving domain; see the module's description."""

    name = "driving"
    record = RECORD
    version = "1"
    modalities: tuple[Modality, ...] = (
        Modality(
            "visual",
            CARS,
            ("distance_ahead", "lane_offset"),
            ("cells", "lanes"),
            (12.0, 1.0),
            0.01,
        ),
        Modality(
            "verbal",
            CARS,
            ("distance_ahead", "lane_offset", "relative_speed"),
            ("cells", "lanes", "cells/step"),
            (12.0, 1.0, 1.0),
            0.03,
        ),
    )
    ego_features: tuple[str, ...] = ("lane",)
    symbol_sizes: Mapping[str, int] = {"ego": 2, "visual": 50, "verbal": 53}
    actions: tuple[str, ...] = ("stay", "switch")
    horizon = 15
    settings: tuple[str, ...] = ("clear", "fog")
    scenarios: tuple[str, ...] = tuple(SCENARIO_SPEEDS)
    reward_terms: tuple[str, ...] = ("proximity", "collision", "off_road", "lane_change")
    mishap: tuple[str, str] = ("collision", "collisions")
    picture_legend = (
        "Blue: the person, who drives to the right. Orange: cars that they see, or that are shown "
        "or spoken of, at this step; pale: others"
    )
    counterparts: tuple[int | None, ...] = (0, 1, 2, 3)
    directions: tuple[str, ...] = ("front_own", "front_other", "back_own", "back_other")
    direction_groups: tuple[tuple[int, ...], ...] = ((0, 1), (2, 3))
    """Groups of directions with equal reach for most people: both lanes ahead, both behind."""
    reach_bins: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, float(ROAD_END))
    """Lower edges in cells of the bins of a sight threshold: a person with threshold r sees cars up
    to r cells away and none at the next edge. The last bin is the whole road."""
    reach_unit = "cells"
    told_practice = 0.5
    partial_views: Mapping[str, tuple[float, ...]] = {
        "fog": (FOG_REACH, FOG_REACH, 0.0, 0.0),
        "four_ahead_two_behind": (4.0, 4.0, 2.0, 2.0),
    }
    assumptions: tuple[str, ...] = ASSUMPTIONS
    settled = True

    def initial(
        self, batch: int, generator: torch.Generator, scenario: Tensor | None = None
    ) -> DrivingState:
        """Draw states ``[batch]`` at the start of a round.

        Args:
            batch: number of rounds.
            generator: source of randomness; its device is that of the states.
            scenario: indices ``[batch]`` into ``scenarios``; drawn uniformly unless given.
        """
        device = generator.device
        scenario = self.scenario(batch, generator, scenario)
        speeds = torch.tensor(list(SCENARIO_SPEEDS.values()), device=device)
        distance = torch.randint(
            1, ROAD_END, (batch, len(CARS)), generator=generator, device=device
        )
        return DrivingState(
            lane=torch.randint(2, (batch,), generator=generator, device=device),
            position=distance * torch.tensor(CAR_SIDES, device=device),
            speed=speeds[scenario],
        )

    def transition(self, state: DrivingState, action: Tensor) -> DrivingState:
        """Return the state at t + 1; ``action`` ``[...]`` is 0 (stay) or 1 (switch)."""
        lane = torch.where(action == SWITCH, 1 - state.lane, state.lane)
        return replace(state, lane=lane, position=state.position + state.speed)

    def rewards(
        self, state: DrivingState, action: Tensor, following: DrivingState
    ) -> dict[str, Tensor]:
        """Return reward terms ``[...]`` by name, in units of reward."""
        lanes = torch.tensor(CAR_LANES, device=state.lane.device)
        own = lanes == following.lane[..., None]
        gap = following.position.abs()
        off_road = (following.lane < 0) | (following.lane > 1)
        dtype = torch.get_default_dtype()
        return {
            "proximity": PROXIMITY * (own & (gap <= NEAR)).sum(-1).to(dtype),
            "collision": COLLISION * (own & (gap == 0)).sum(-1).to(dtype),
            "off_road": OFF_ROAD * off_road.to(dtype),
            "lane_change": LANE_CHANGE * (action == SWITCH).to(dtype),
        }

    def over(self, state: DrivingState) -> Tensor:
        """Return False everywhere ``[...]``: driving goes on to the end of a round."""
        return torch.zeros_like(state.lane, dtype=torch.bool)

    def observe(self, state: DrivingState) -> Observation:
        """Return the full observation: ego ``[..., 1]``, visual and verbal ``[..., 4, F]``."""
        dtype = torch.get_default_dtype()
        lanes = torch.tensor(CAR_LANES, device=state.lane.device)
        position = state.position.clamp(-ROAD_END, ROAD_END).to(dtype)
        offset = (lanes - state.lane[..., None]).to(dtype)
        speed = torch.where(position.abs() < ROAD_END, state.speed.to(dtype), 0.0)
        return {
            "ego": state.lane[..., None].to(dtype),
            "visual": torch.stack([position, offset], -1),
            "verbal": torch.stack([position, offset, speed], -1),
        }

    def visibility(self, setting: str, observation: Observation) -> Visibility:
        """Return what an unaided person sees in a setting.

        Raises:
            UnknownNameError: if the setting is neither ``clear`` nor ``fog``.
        """
        require_known(setting, "setting", self.settings, self.name)
        ahead = observation["visual"][..., 0]
        if setting == "clear":
            seen = torch.ones_like(ahead, dtype=torch.bool)
        else:
            seen = (ahead >= 0) & (ahead <= FOG_REACH)
        return {"visual": seen, "verbal": torch.zeros_like(seen)}

    def communicable(self, observation: Observation) -> Visibility:
        """Return communicable items: cars ahead can be shown, cars on the road spoken of."""
        ahead = observation["visual"][..., 0]
        on_road = ahead.abs() < ROAD_END
        return {"visual": on_road & (ahead >= 0), "verbal": on_road}

    def faults(self, observation: Observation) -> dict[str, Tensor]:
        """Return which observations ``[...]`` break each rule of recordings, by rule."""
        lane, visual = observation["ego"], observation["visual"]
        lanes = torch.tensor(CAR_LANES, device=lane.device)
        ahead, offset = visual.unbind(-1)
        return {
            "ego lane has to be 0 or 1": ((lane != 0) & (lane != 1)).any(-1),
            f"distance_ahead has to be a whole number of cells from -{ROAD_END} to {ROAD_END}": (
                (ahead != ahead.round()) | (ahead.abs() > ROAD_END)
            ).any(-1),
            "lane_offset has to be the car's lane (left cars 0, right cars 1) minus the ego's": (
                offset != lanes - lane
            ).any(-1),
            "verbal position has to be the visual one": (
                observation["verbal"][..., :2] != visual
            ).any((-1, -2)),
            f"relative_speed has to be -1 or 1, and 0 of cars {ROAD_END} cells away": (
                observation["verbal"][..., 2].abs() != (ahead.abs() < ROAD_END).to(ahead)
            ).any(-1),
        }

    def nothing_known(self, *batch: int, device: torch.device | None = None) -> CarKnowledge:
        """Return knowledge ``[*batch]`` before anything was observed."""
        return CarKnowledge.nothing(*batch, device=device)

    def learn(
        self,
        knowledge: CarKnowledge,
        observation: Observation,
        visible: Visibility,
        sees: Callable[[Observation], Visibility],
    ) -> CarKnowledge:
        """Return knowledge after a step; see `mirror_ppl.domains.driving.knowledge`.

        Two sights of a car, one utterance, or its absence where it was assumed make it known.
        """
        return knowledge.learn(observation, visible, sees)

    def known(self, knowledge: CarKnowledge) -> Visibility:
        """Return both items ``[..., 4]``, visual and verbal, of known cars."""
        return {"visual": knowledge.known, "verbal": knowledge.known}

    def assume(
        self, knowledge: CarKnowledge, observation: Observation
    ) -> tuple[dict[str, Visibility], Observation]:
        """Return assumed items: ``clear``, no unobserved cars; ``closing``, others come closer."""
        absent = ~knowledge.placed
        position = torch.where(absent, float(ROAD_END), knowledge.position)
        items = {
            "clear": {"visual": absent, "verbal": torch.zeros_like(absent)},
            "closing": {"visual": knowledge.unsure, "verbal": knowledge.unsure},
        }
        return items, assumed_cars(position, knowledge.speed, observation)

    def supposed(
        self, state: DrivingState, knowledge: CarKnowledge, assumes: Mapping[str, Tensor]
    ) -> DrivingState:
        """Return the state as believed by a person with such knowledge and assumptions."""
        gone = ~knowledge.placed & assumes["clear"][..., None]
        closing = knowledge.unsure & assumes["closing"][..., None]
        position = torch.where(closing, knowledge.position.to(state.position.dtype), state.position)
        return replace(
            state,
            position=torch.where(gone, 10 * ROAD_END, position),
            speed=torch.where(closing, knowledge.speed.to(state.speed.dtype), state.speed),
        )

    def symbols(self, observation: Observation) -> dict[str, Tensor]:
        """Encode observations as discrete symbols for networks.

        Returns:
            ego ``[..., 2]``, one-hot lane; visual ``[..., 4, 50]``, one-hot over distance and
            own/other lane; verbal ``[..., 4, 53]``, with one-hot speed in addition.
        """
        dtype = observation["ego"].dtype

        def place(item: Tensor) -> Tensor:
            own = (item[..., 1] == 0).long()
            index = (item[..., 0].long() + ROAD_END) * 2 + own
            return one_hot(index, 2 * (2 * ROAD_END + 1)).to(dtype)

        verbal = observation["verbal"]
        speed = one_hot(verbal[..., 2].long() + 1, 3).to(dtype)
        return {
            "ego": one_hot(observation["ego"][..., 0].long(), 2).to(dtype),
            "visual": place(observation["visual"]),
            "verbal": torch.cat([place(verbal), speed], -1),
        }

    def distance(self, observation: Observation) -> tuple[Tensor, Tensor]:
        """Return direction (index into ``directions``) and distance in cells, ``[..., 4]``."""
        ahead, offset = observation["visual"].unbind(-1)
        return 2 * (ahead < 0).long() + (offset != 0).long(), ahead.abs()

    def state_behind(self, observation: Observation) -> DrivingState:
        """Return the state ``[...]`` behind an observation; a car off the road stays there.

        Its position and speed cannot be observed and no longer matter, because cars that left the
        road do not come back.
        """
        position = observation["visual"][..., 0].round().long()
        away = position.abs() >= ROAD_END
        speed = observation["verbal"][..., 2].round().long()
        return DrivingState(
            lane=observation["ego"][..., 0].round().long(),
            position=torch.where(away, 10 * position, position),
            speed=torch.where(away, 0, speed),
        )

    def nearest(self, observation: Observation) -> Observation:
        """Return the possible observation nearest to decoded values.

        Positions are rounded means of the verbal and visual positions.
        """
        lane = observation["ego"][..., 0].round().clamp(0, 1)
        decoded = (observation["visual"][..., 0] + observation["verbal"][..., 0]) / 2
        position = decoded.round().clamp(-ROAD_END, ROAD_END).long()
        # A car on the road is faster or slower than the ego, never as fast.
        speed = torch.where(observation["verbal"][..., 2] < 0, -1, 1)
        return self.observe(DrivingState(lane.long(), position, speed))

    def relevance(self, observation: Observation) -> dict[str, Visibility]:
        """Return cars on a collision course: abreast or closing in, in the ego's lane.

        The second definition includes cars of both lanes, because a change of lanes brings those
        of the other lane on a collision course.
        """
        position, offset, speed = observation["verbal"].unbind(-1)
        closing = (position * speed < 0) | (position == 0)
        course = closing & (offset == 0)
        return {
            "collision_course": {"visual": course, "verbal": course},
            "closing": {"visual": closing, "verbal": closing},
        }

    def describe(self, observation: Observation, modality: str, item: str) -> str:
        """Describe a car, such as "rear car in the right lane, 3 cells behind, closing"."""
        index = CARS.index(item)
        position, _, speed = observation["verbal"][index].tolist()
        lane = ("left", "right")[CAR_LANES[index]]
        if position == 0:
            return f"car abreast in the {lane} lane"
        where = "ahead" if position > 0 else "behind"
        cells = f"{abs(position):.0f} cell{'s' * (abs(position) > 1)}"
        motion = "closing" if position * speed < 0 else "drawing away"
        which = "front" if position > 0 else "rear"
        return f"{which} car in the {lane} lane, {cells} {where}, {motion}"

    def deed(self, observation: Observation, item: str | None, action: int) -> str:
        """Describe an action relative to a car's lane, such as "switch into that lane"."""
        if item is None:
            return "switch lanes" if action == SWITCH else "stay in their lane"
        own = observation["visual"][CARS.index(item), 1] == 0
        if action == SWITCH:
            return "switch lanes" if own else "switch into that lane"
        return "stay in its way" if own else "stay where they are"

    def reference_values(self, state: DrivingState, discount: float) -> Tensor:
        """Return exact action values ``[..., 2]`` of known states, to the end of the encounter."""
        known = torch.ones_like(state.position, dtype=torch.bool)
        return known_car_values(state, known, self.horizon, discount)

    def render(self, state: DrivingState) -> np.ndarray:
        """Draw ``uint8 [height, width, 3]`` of one state, the road running to the right."""
        return self._road(state, torch.ones(len(CAR_LANES), dtype=torch.bool))

    def render_seen(self, state: DrivingState, visible: Visibility) -> np.ndarray:
        """Draw cars in pale colours that a person does not perceive, with ``visible`` ``[4]``."""
        return self._road(state, torch.stack([*visible.values()]).any(0).flatten())

    def _road(self, state: DrivingState, seen: Tensor) -> np.ndarray:
        cell, lanes, length = 16, 2, 2 * ROAD_END + 1
        picture = np.full((lanes * cell, length * cell, 3), 235, dtype=np.uint8)
        picture[cell - 1 : cell + 1, :: cell // 2] = 255

        def block(lane: int, position: int, colour: tuple[int, int, int]) -> None:
            left = (position + ROAD_END) * cell
            picture[lane * cell + 3 : (lane + 1) * cell - 3, left + 1 : left + cell - 1] = colour

        cars = zip(CAR_LANES, state.position.flatten().tolist(), seen.tolist(), strict=True)
        for lane, position, clear in cars:
            if abs(position) < ROAD_END:
                block(lane, position, ORANGE if clear else PALE)
        block(int(state.lane), 0, DARK_BLUE)
        return picture
