"""Driving among four cars: the world, its people, pictures and settings."""

from mirror_ppl.domains.driving.cars import CAR_LANES, CARS, SCENARIO_SPEEDS, DrivingState
from mirror_ppl.domains.driving.knowledge import ROAD_END
from mirror_ppl.domains.driving.rewards import known_car_values, lane_rewards, task_weights
from mirror_ppl.domains.driving.world import FOG_REACH, STAY, SWITCH, Driving

__all__ = [
    "CARS",
    "CAR_LANES",
    "Driving",
    "DrivingState",
    "FOG_REACH",
    "ROAD_END",
    "SCENARIO_SPEEDS",
    "STAY",
    "SWITCH",
    "known_car_values",
    "lane_rewards",
    "task_weights",
]
