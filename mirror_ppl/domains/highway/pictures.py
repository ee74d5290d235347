"""A picture of one state: the road from above, and the lidar as a polar plot."""

from __future__ import annotations

import math

import numpy as np
import torch

from mirror_ppl.domains.base import Observation
from mirror_ppl.domains.highway.lidar import RANGE, SECTOR, SECTORS
from mirror_ppl.domains.highway.road import (
    LANE_WIDTH,
    LANES,
    LEFT_EDGE,
    LENGTH,
    RIGHT_EDGE,
    SHOULDER,
    WIDTH,
)
from mirror_ppl.domains.highway.state import HighwayState

Colour = tuple[int, int, int]
ASPHALT: Colour = (58, 62, 68)
SHOULDER_GREY: Colour = (112, 116, 120)
GRASS: Colour = (196, 208, 180)
LINE: Colour = (240, 240, 236)
EGO: Colour = (52, 116, 216)
CAR: Colour = (246, 182, 112)
BRAKE_LIGHT: Colour = (255, 40, 40)
GLASS: Colour = (206, 226, 240)
PAPER: Colour = (250, 250, 248)
UNSEEN: Colour = (140, 144, 152)
SHADOW: Colour = (234, 236, 238)
RING: Colour = (214, 216, 220)

SCALE = 10
"""Pixels of a metre of the road."""
BEHIND, AHEAD = 60.0, 60.0
"""Metres of road that are drawn."""
ACROSS = (LEFT_EDGE - SHOULDER - 1.5, RIGHT_EDGE + SHOULDER + 1.5)
PLOT = 460
"""Pixels of the width and height of the polar plot."""
DASH = 4.0
"""Metres of a dash between lanes, and of the gap after it."""
BRAKES = 1.0
"""m/s2 from which brake lights are on."""
NOSE = 0.35
"""Share of a car's half length from its middle to its windscreen."""


def picture(state: HighwayState, observation: Observation, *visible: torch.Tensor) -> np.ndarray:
    """Draw one state.

    Args:
        state: without batch.
        observation: of this state.
        visible: sectors that a person sees ``[36]``; one polar plot each, side by side.

    Returns:
        ``uint8 [height, width, 3]``: the road above, driving to the right, and the lidar below, its
        sector 0 upwards; a sector is coloured as far as it is free, and grey if it is not seen.
    """
    road = _road(state)
    below = np.full((PLOT, road.shape[1], 3), PAPER, np.uint8)
    distance = observation["visual"][:, 0].numpy()
    for number, seen in enumerate(visible):
        middle = road.shape[1] * (2 * number + 1) // (2 * len(visible))
        left = middle - PLOT // 2
        below[:, left : left + PLOT] = _polar(distance, seen.numpy())
    return np.concatenate([road, below])


def _road(state: HighwayState) -> np.ndarray:
    low, high = ACROSS
    ego = float(state.x[0])
    along = ego - BEHIND + (np.arange(int((BEHIND + AHEAD) * SCALE)) + 0.5) / SCALE
    across = low + (np.arange(int((high - low) * SCALE)) + 0.5) / SCALE
    x, y = np.meshgrid(along, across)
    canvas = np.full((*x.shape, 3), GRASS, np.uint8)
    canvas[(y > LEFT_EDGE - SHOULDER) & (y < RIGHT_EDGE + SHOULDER)] = SHOULDER_GREY
    canvas[(y > LEFT_EDGE) & (y < RIGHT_EDGE)] = ASPHALT
    for edge in (LEFT_EDGE, RIGHT_EDGE):
        canvas[np.abs(y - edge) < 0.1] = LINE
    for lane in range(1, LANES):
        line = np.abs(y - (lane - 0.5) * LANE_WIDTH) < 0.08
        canvas[line & (x % (2 * DASH) < DASH)] = LINE
    for number in reversed(range(len(state.x))):
        place = (float(state.x[number]), float(state.y[number]), float(state.heading[number]))
        braking = float(state.acceleration[number]) <= -BRAKES
        _car(canvas, x, y, place, EGO if number == 0 else CAR, braking)
    return canvas


def _car(
    canvas: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    place: tuple[float, float, float],
    colour: Colour,
    braking: bool,
) -> None:
    """Draw a car with its windscreen in front, and brake lights."""
    cos, sin = math.cos(place[2]), math.sin(place[2])
    forward = (x - place[0]) * cos + (y - place[1]) * sin
    aside = np.abs((y - place[1]) * cos - (x - place[0]) * sin)
    length, width = LENGTH / 2, WIDTH / 2
    canvas[(np.abs(forward) <= length) & (aside <= width)] = colour
    glass = (forward > NOSE * length) & (forward < (NOSE + 0.25) * length)
    canvas[glass & (aside <= 0.8 * width)] = GLASS
    if braking:
        lights = (forward >= -length) & (forward < -length + 0.5)
        canvas[lights & (aside <= width) & (aside > 0.4 * width)] = BRAKE_LIGHT


def _polar(distance: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Draw distances ``[36]`` around the middle: green is free, red near, grey not seen."""
    centre = (np.arange(PLOT) + 0.5 - PLOT / 2) / (PLOT / 2) * 1.06
    right, down = np.meshgrid(centre, centre)
    radius, angle = np.hypot(right, down) * RANGE, np.arctan2(right, -down)
    sector = np.round(angle / SECTOR).astype(int) % SECTORS
    canvas = np.full((PLOT, PLOT, 3), PAPER, np.uint8)
    canvas[radius <= RANGE] = SHADOW
    share = np.clip(distance / RANGE, 0, 1)[:, None]
    far, near = np.array([184, 218, 184.0]), np.array([214, 96, 70.0])
    colours = np.where(visible[:, None], share * far + (1 - share) * near, UNSEEN).astype(np.uint8)
    inside = radius <= np.where(visible, distance, RANGE)[sector]
    canvas[inside] = colours[sector[inside]]
    turn = np.abs((angle / SECTOR - 0.5) % 1 - 0.5) * SECTOR * radius
    canvas[(turn < 0.15) & (radius <= RANGE)] = PAPER
    for ring in (20.0, 40.0, RANGE):
        canvas[np.abs(radius - ring) < 0.2] = RING
    body = (np.abs(right) * RANGE < WIDTH / 2) & (np.abs(down) * RANGE < LENGTH / 2)
    canvas[body] = EGO
    return canvas
