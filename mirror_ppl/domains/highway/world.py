"""Highway driving: three lanes, traffic, 36 sectors of lidar, and speech (the CARLA experiment).

Description
    The person drives a car on a straight road of three lanes among eight others, as fast as 40 km/h
    allows. Others follow and change lanes as highway-env's vehicles do; in each scenario one or two
    of them do something that calls for a response. Physics runs at 20 Hz, decisions at 5 Hz.

Actions, both in [-1, 1]
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
    after 120 decisions (24 s), when recording merely stops. All chance is in the start: the state
    holds when manoeuvres begin.

Version history
    1: first version.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from mirror_ppl.domains.base import Modality, Observation, Visibility, require_known
from mirror_ppl.domains.highway import reward, scenarios, traffic
from mirror_ppl.domains.highway.lidar import SECTORS, scan
from mirror_ppl.domains.highway.messages import SEEN, SPOKEN
from mirror_ppl.domains.highway.road import STEPS, centre_of, wrapped
from mirror_ppl.domains.highway.speech import on_road, utterances
from mirror_ppl.domains.highway.state import HighwayState

FOG_AHEAD, FOG_BEHIND = 15.0, 5.0
"""Metres that people see in fog, in sectors of the front half and in all others."""


class Highway:
    """The highway domain; see the module's description.

    States are batched, and all functions pure, as in other worlds. Actions are continuous, which
    commands do not support yet, so that this world is not in the registry.
    """

    name = "highway"
    version = "1"
    modalities: tuple[Modality, ...] = (SEEN, SPOKEN)
    ego_features = ("lane", "lane_offset", "heading", "speed", "steering", "acceleration")
    ego_units = ("index", "m", "rad", "m/s", "share", "share")
    actions = ("steering", "acceleration")
    horizon = STEPS
    over_at_horizon = False
    settings: tuple[str, ...] = ("clear", "fog")
    scenarios: tuple[str, ...] = scenarios.NAMES
    reward_terms: tuple[str, ...] = reward.TERMS
    mishap = ("accident", "accidents")

    def initial(
        self, batch: int, generator: torch.Generator, scenario: Tensor | None = None
    ) -> HighwayState:
        """Draw states ``[batch]`` at the start of a round.

        Args:
            batch: number of rounds.
            generator: source of randomness; its device is that of the states.
            scenario: indices ``[batch]`` into ``scenarios``; drawn uniformly unless given.
        """
        if scenario is None:
            many, device = len(self.scenarios), generator.device
            scenario = torch.randint(many, (batch,), generator=generator, device=device)
        return scenarios.initial(scenario, generator)

    def transition(self, state: HighwayState, action: Tensor) -> HighwayState:
        """Return the state after a decision; nothing moves once a round is over.

        Args:
            state: ``[...]``.
            action: steering and acceleration ``[..., 2]``, cut to [-1, 1].
        """
        return traffic.transition(state, action)

    def rewards(
        self, state: HighwayState, action: Tensor, following: HighwayState
    ) -> dict[str, Tensor]:
        """Return reward terms ``[...]`` by name, in units of reward."""
        return reward.rewards(state, action, following)

    def over(self, state: HighwayState) -> Tensor:
        """Return where ``[...]`` a collision or the end of the shoulder has ended the round."""
        return state.over

    def observe(self, state: HighwayState) -> Observation:
        """Return everything: ego ``[..., 6]``, visual ``[..., 36, 3]``, verbal ``[..., 6, 1]``."""
        lane = state.lane[..., 0]
        ego = [
            lane.to(state.x.dtype),
            state.y[..., 0] - centre_of(lane),
            wrapped(state.heading[..., 0]),
            state.speed[..., 0],
            *state.controls.unbind(-1),
        ]
        return {
            "ego": torch.stack(ego, -1),
            "visual": scan(state),
            "verbal": utterances(state)[..., None].to(state.x.dtype),
        }

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

    def communicable(self, state: HighwayState) -> Visibility:
        """Return what may be communicated: groups and directions ``[..., 6]``.

        All groups may be shown. Directions in which there is no lane are not spoken of.
        """
        said = on_road(state)
        return {"visual": torch.ones_like(said), "verbal": said}

    def describe(self, observation: Observation, item: int) -> str:
        """Return the true sentence about a direction, from one observation."""
        return SPOKEN.utterances[item][round(float(observation["verbal"][item, 0]))]

    def render(self, state: HighwayState, setting: str = "clear") -> np.ndarray:
        """Draw the road and the lidar of one state, ``uint8 [height, width, 3]``."""
        from mirror_ppl.domains.highway.pictures import picture

        observation = self.observe(state)
        return picture(state, observation, self.visibility(setting, observation)["visual"])


def sight(setting: str) -> Tensor:
    """Return how many metres a person sees in each sector, ``[36]``."""
    if setting == "clear":
        return torch.full((SECTORS,), math.inf)
    quarter = SECTORS // 4
    sector = torch.arange(SECTORS)
    ahead = (sector < quarter) | (sector > SECTORS - quarter)
    return torch.where(ahead, FOG_AHEAD, FOG_BEHIND)
