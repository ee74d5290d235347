"""Highway driving: three lanes, traffic, 36 sectors of lidar, and speech (the CARLA experiment).

Description
    The person drives a car on a straight road of three lanes among eight others, as fast as 40 km/h
    allows. Others follow and change lanes as highway-env's vehicles do; in each scenario one or two
    of them do something that calls for a response. Physics runs at 20 Hz, and people decide
    twice a second.

Actions
    Twelve manoeuvres (:mod:`mirror_ppl.domains.highway.manoeuvres`), each a lane to aim for and a
    speed; a controller turns them into steering and acceleration. The functions of the domain also
    take these themselves, both in [-1, 1], as the Gymnasium environment and CARLA do:

    ============  ==========================================================
    steering      share of 0.2 rad at the front wheels, positive to the right
    acceleration  share of 5 m/s2, negative to brake
    ============  ==========================================================

Observations
    ========  ===============  ========  =====================================================
    ego       lane             index     0 left, 1 middle, 2 right
    ego       lane_offset      m         from the centre of that lane, positive to the right
    ego       heading          rad       clockwise from the direction of the road
    ego       speed            m/s
    ego       steering         share     of the last action
    ego       acceleration     share     of the last action
    ego       accident         0 or 1    whether an accident has ended the round
    visual    distance         m         nearest car in each of 36 sectors; 60 m in an empty one
    visual    velocity_along   m/s       of that car relative to the ego, along its heading
    visual    velocity_across  m/s       and across it, to the right
    verbal    utterance        index     sentence that is true of each of six directions
    ========  ===============  ========  =====================================================

    In clear weather all sectors are visible. In fog a sector is visible if its nearest car is at
    most 15 m away ahead, or 5 m abreast and behind. Sentences are observed only if they are said.

Rewards
    See :mod:`mirror_ppl.domains.highway.reward`.

Start and end
    See :mod:`mirror_ppl.domains.highway.scenarios` for the start. A round ends with an accident, or
    after 48 decisions (24 s), when recording merely stops. All chance is in the start: the state
    holds when manoeuvres begin.

Version history
    1: first version.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import one_hot

from mirror_ppl.domains.base import Observation, Visibility, require_known
from mirror_ppl.domains.highway import estimate, expert, reward, scenarios, traffic
from mirror_ppl.domains.highway.estimate import state_with
from mirror_ppl.domains.highway.knowledge import Memory, imagined, nothing, out_of_sight, remember
from mirror_ppl.domains.highway.lidar import RANGE, SECTOR, SECTORS, scan
from mirror_ppl.domains.highway.limits import impossible, outside, require_action
from mirror_ppl.domains.highway.manoeuvres import MANOEUVRES, REFLECTED, controls, deed
from mirror_ppl.domains.highway.messages import GROUPS, SEEN, SPOKEN, group_of
from mirror_ppl.domains.highway.record import RECORD
from mirror_ppl.domains.highway.road import (
    DECISION_TICKS,
    LANE_WIDTH,
    LANES,
    LEFT_EDGE,
    LIMIT,
    RIGHT_EDGE,
    ROUND_TICKS,
    TICKS,
    centre_of,
    wrapped,
)
from mirror_ppl.domains.highway.speech import DIRECTIONS, NOTHING, SIDES, utterances
from mirror_ppl.domains.highway.state import HighwayState, where
from mirror_ppl.domains.modality import Modality
from mirror_ppl.domains.world import World

FOG_AHEAD, FOG_BEHIND = 15.0, 5.0
"""Metres that people see in fog, in sectors of the front half and in all others."""
KNOTS = (0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 45.0, RANGE)
"""Metres between which networks read distances, and possible thresholds of sight."""
SIGHT_OF = (0, 1, 2, 3, 2, 1)
"""Direction of sight of each group of sectors."""
DIRECTION_OF = tuple(SIGHT_OF[group_of(sector)] for sector in range(SECTORS))
"""Direction of sight of each sector."""
STRAIGHT = 0.15
"""Radians, a typical heading."""


class Highway(World):
    """The highway domain; see the module's description."""

    name = "highway"
    version = "1"
    modalities: tuple[Modality, ...] = (SEEN, SPOKEN)
    ego_features: tuple[str, ...] = (
        "lane", "lane_offset", "heading", "speed", "steering", "acceleration", "accident",
    )  # fmt: skip
    ego_units = ("index", "m", "rad", "m/s", "share", "share", "0 or 1")
    levels: Mapping[str, range] = {"lane": range(LANES), "accident": range(2)}
    actions: tuple[str, ...] = MANOEUVRES
    ticks = DECISION_TICKS
    horizon = ROUND_TICKS // DECISION_TICKS
    over_at_horizon = False
    partly_observed = True
    settings: tuple[str, ...] = ("clear", "fog")
    scenarios: tuple[str, ...] = scenarios.NAMES
    reward_terms: tuple[str, ...] = reward.TERMS
    mishap: tuple[str, str] = ("accident", "accidents")
    picture_legend = (
        "Below the road: the lidar, ahead is up. Green: free; red: ends at a near car; pale: "
        "behind a car; dark grey: not seen"
    )
    directions: tuple[str, ...] = ("ahead", "ahead_aside", "behind_aside", "behind")
    direction_groups: tuple[tuple[int, ...], ...] = ((0, 1), (2, 3))
    reach_bins: tuple[float, ...] = KNOTS
    reach_unit = "m"
    partial_views: Mapping[str, tuple[float, ...]] = {
        "fog": (FOG_AHEAD, FOG_AHEAD, FOG_BEHIND, FOG_BEHIND),
        "ahead only": (RANGE, RANGE, 0.0, 0.0),
    }
    assumptions: tuple[str, ...] = ("clear",)
    told_practice = 0.1
    recalls = False  # everything moves
    reflected_actions: tuple[int, ...] = REFLECTED
    reflected_items: Mapping[str, tuple[int, ...]] = {
        SEEN.name: tuple(-k % SECTORS for k in range(SECTORS)),
        SPOKEN.name: tuple(-k % len(DIRECTIONS) for k in range(len(DIRECTIONS))),
    }
    symbol_sizes: Mapping[str, int] = {
        "ego": LANES + 6,
        "visual": len(KNOTS) + 2,
        "verbal": NOTHING + 1,
    }
    record = RECORD

    def initial(
        self, batch: int, generator: torch.Generator, scenario: Tensor | None = None
    ) -> HighwayState:
        """Draw states ``[batch]`` at the start of a round.

        Args:
            batch: number of rounds.
            generator: source of randomness; its device is that of the states.
            scenario: indices ``[batch]`` into ``scenarios``; drawn uniformly unless given.
        """
        return scenarios.initial(self.scenario(batch, generator, scenario), generator)

    def transition(self, state: HighwayState, action: Tensor) -> HighwayState:
        """Return the state after a decision; nothing moves once a round is over.

        Args:
            state: ``[...]``.
            action: manoeuvres ``[...]``, or steering and acceleration ``[..., 2]``.

        Raises:
            InputError: there is no such manoeuvre, or controls are of another shape or not finite.
        """
        return traffic.transition(state, require_action(action), self.ticks)

    def rewards(
        self, state: HighwayState, action: Tensor, following: HighwayState
    ) -> dict[str, Tensor]:
        """Return reward terms ``[...]`` by name, in units of reward; actions as in `transition`."""
        return reward.rewards(state, controls(state, require_action(action)), following)

    def over(self, state: HighwayState) -> Tensor:
        """Return where ``[...]`` a collision or the end of the shoulder has ended the round."""
        return state.over

    def observe(self, state: HighwayState) -> Observation:
        """Return everything: ego ``[..., 7]``, visual ``[..., 36, 3]``, verbal ``[..., 6, 1]``."""
        return {
            "ego": _ego(state),
            "visual": scan(state),
            "verbal": utterances(state)[..., None].to(state.x.dtype),
        }

    def state_behind(self, observation: Observation) -> HighwayState:
        """Return an estimate ``[...]``, see :mod:`mirror_ppl.domains.highway.estimate`."""
        return estimate.state_of(observation)

    def ended(self, observation: Observation) -> Tensor:
        """Return where ``[...]`` there was an accident."""
        return observation["ego"][..., self.ego_features.index("accident")] == 1

    def reference_values(self, state: HighwayState, discount: float) -> Tensor:
        """Return the expert's values ``[..., A]``: of keeping up each manoeuvre for 6 s.

        They are those of a planner that looks ahead, not exact.
        """
        return expert.values(state, expert.ExpertOptions(discount=discount))

    def visibility(self, setting: str, observation: Observation) -> Visibility:
        """Return what an unaided person sees: sectors ``[..., 36]``, and no sentences ``[..., 6]``.

        Raises:
            UnknownNameError: if the setting is neither ``clear`` nor ``fog``.
        """
        require_known(setting, "setting", self.settings, self.name)
        distance = observation["visual"][..., 0]
        reach = sight(setting).to(distance)
        said = torch.zeros_like(observation["verbal"][..., 0], dtype=torch.bool)
        return {"visual": distance <= reach, "verbal": said}

    def communicable(self, observation: Observation) -> Visibility:
        """Return what may be communicated: sectors ``[..., 36]`` and directions ``[..., 6]``.

        All sectors may be shown. Directions in which there is no lane are not spoken of.
        """
        shown = torch.ones_like(observation["visual"][..., 0], dtype=torch.bool)
        sides = torch.tensor(SIDES, device=shown.device)
        lane = observation["ego"][..., :1].round() + sides
        return {"visual": shown, "verbal": (lane >= 0) & (lane < LANES)}

    def faults(self, observation: Observation) -> dict[str, Tensor]:
        """Return which observations ``[...]`` break each rule of recordings, by rule."""
        names = {"ego": self.ego_features} | {m.name: m.features for m in self.modalities}
        found = super().faults(observation) | outside(observation, names)
        return found | impossible(observation)

    def distance(self, observation: Observation) -> tuple[Tensor, Tensor]:
        """Return the direction of sight and the distance in metres of each sector ``[..., 36]``."""
        distance = observation["visual"][..., 0]
        own = torch.tensor(DIRECTION_OF, device=distance.device)
        return own.expand(distance.shape), distance

    def nothing_known(self, *batch: int, device: torch.device | None = None) -> Memory:
        """Return the memory of drivers ``[*batch]`` before a round."""
        return nothing(*batch, like=torch.zeros((), device=device))

    def learn(
        self,
        knowledge: Memory,
        observation: Observation,
        visible: Visibility,
        sees: Callable[[Observation], Visibility],
    ) -> Memory:
        """Return the cars ``[...]`` that a driver knows of; :meth:`assume` alone reads them."""
        seen, heard = visible["visual"], visible["verbal"]
        return remember(knowledge, observation, seen, heard, out_of_sight(sees, observation))

    def known(self, knowledge: Memory) -> Visibility:
        """Return known items ``[..., K]``: none, as everything moves."""
        there = knowledge.there[..., :1]
        return {
            m.name: torch.zeros_like(there).expand(*there.shape[:-1], len(m.items))
            for m in self.modalities
        }

    def assume(
        self, knowledge: Memory, observation: Observation
    ) -> tuple[dict[str, Visibility], Observation]:
        """Return the assumption ``clear``: where nothing is seen, only remembered cars are."""
        supposed = imagined(knowledge, observation)
        about = {
            "visual": torch.ones_like(supposed["visual"][..., 0], dtype=torch.bool),
            "verbal": torch.zeros_like(observation["verbal"][..., 0], dtype=torch.bool),
        }
        return {"clear": about}, supposed

    def supposed(
        self, state: HighwayState, knowledge: Memory, assumes: Mapping[str, Tensor]
    ) -> HighwayState:
        """Return the state ``[...]`` as believed: the cars that are known, and no others."""
        assuming = assumes["clear"].expand(state.tick.shape)
        if not assuming.any():
            return state
        return where(assuming, state_with(_ego(state), knowledge), state)

    def reflected(self, state: HighwayState) -> HighwayState:
        """Return the state with left and right exchanged.

        What follows is reflected, too, but for vehicles to which MOBIL recommends both lanes.
        """
        return replace(
            state,
            y=LEFT_EDGE + RIGHT_EDGE - state.y,
            heading=-state.heading,
            target_lane=LANES - 1 - state.target_lane,
            cue_lane=LANES - 1 - state.cue_lane,
            controls=state.controls * state.controls.new_tensor([-1.0, 1.0]),
        )

    def decisive(self, observation: Observation) -> Visibility:
        """Return all sectors ``[..., 36]``; sentences add little to them."""
        return self._all(observation, lambda m: m.name == SEEN.name)

    def symbols(self, observation: Observation) -> dict[str, Tensor]:
        """Encode observations for networks; distances by their place between ``KNOTS``."""
        lane, offset, heading, speed, *others = observation["ego"].unbind(-1)
        rest = [offset / LANE_WIDTH, heading / STRAIGHT, speed / LIMIT, *others]
        ego = torch.cat(
            [
                one_hot(lane.round().long().clamp(0, LANES - 1), LANES).to(offset),
                torch.stack(rest, -1),
            ],
            -1,
        )
        distance, *velocity = observation["visual"].unbind(-1)
        knots = torch.tensor(KNOTS, dtype=distance.dtype, device=distance.device)
        place = torch.searchsorted(knots[1:-1], distance.contiguous())
        low, high = knots[place], knots[place + 1]
        share = ((distance - low) / (high - low)).clamp(0, 1)
        between = torch.zeros(
            *distance.shape, len(KNOTS), dtype=distance.dtype, device=distance.device
        )
        between.scatter_(-1, place[..., None], (1 - share)[..., None])
        between.scatter_add_(-1, place[..., None] + 1, share[..., None])
        speeds = torch.stack(velocity, -1) / SEEN.scales[1]
        said = observation["verbal"][..., 0].round().long().clamp(0, NOTHING)
        return {
            "ego": ego,
            "visual": torch.cat([between, speeds], -1),
            "verbal": one_hot(said, NOTHING + 1).to(offset),
        }

    def describe(self, observation: Observation, modality: str, item: str) -> str:
        """Describe a sector, a group of sectors or a direction of one observation."""
        if modality == "verbal":
            place = DIRECTIONS.index(item)
            sentence = SPOKEN.utterances[place][round(float(observation["verbal"][place, 0]))]
            return f'"{sentence.rstrip(".")}"'
        places = GROUPS[DIRECTIONS.index(item)] if item in DIRECTIONS else (SEEN.items.index(item),)
        sectors = observation["visual"][list(places)]
        nearest = int(sectors[:, 0].argmin())
        distance, along, across = sectors[nearest].tolist()
        if distance >= RANGE:
            return f"{item}: no car within {RANGE:g} m"
        angle = places[nearest] * SECTOR
        closing = round(-along * math.cos(angle) - across * math.sin(angle))
        if closing:
            motion = f"{'coming closer' if closing > 0 else 'drawing away'} at {abs(closing)} m/s"
        elif round(along):  # abreast
            motion = "overtaking you" if along > 0 else "falling back"
        else:
            motion = "as fast as you"
        return f"{item}: car at {distance:.0f} m, {motion}"

    def deed(self, observation: Observation, item: str | None, action: int) -> str:
        """Describe a manoeuvre, such as "go fast in the left lane"."""
        return deed(action)

    def render(self, state: HighwayState, setting: str = "clear") -> np.ndarray:
        """Draw the road and the lidar of one state, ``uint8 [height, width, 3]``."""
        return self.render_seen(state, self.visibility(setting, self.observe(state)))

    def render_seen(self, state: HighwayState, visible: Visibility) -> np.ndarray:
        """Draw the same as a person perceives it: sectors ``[36]`` out of sight are grey."""
        from mirror_ppl.domains.highway.pictures import picture

        return picture(state, self.observe(state), visible["visual"])


class DirectHighway(Highway):
    """The highway driven by steering and acceleration, which are set five times a second.

    For the Gymnasium environment and CARLA. Its `reference_values` are still those of manoeuvres of
    half a second.
    """

    ticks = TICKS
    horizon = ROUND_TICKS // TICKS


def _ego(state: HighwayState) -> Tensor:
    """Return what a driver knows of the own car, ``[..., 7]``."""
    lane = state.lane[..., 0]
    parts = [
        lane.to(state.x.dtype),
        state.y[..., 0] - centre_of(lane),
        wrapped(state.heading[..., 0]),
        state.speed[..., 0],
        *state.controls.unbind(-1),
        state.over.to(state.x.dtype),
    ]
    return torch.stack(parts, -1)


def sight(setting: str) -> Tensor:
    """Return how many metres a person sees in each sector, ``[36]``."""
    if setting == "clear":
        return torch.full((SECTORS,), math.inf)
    quarter = SECTORS // 4
    sector = torch.arange(SECTORS)
    ahead = (sector < quarter) | (sector > SECTORS - quarter)
    return torch.where(ahead, FOG_AHEAD, FOG_BEHIND)
