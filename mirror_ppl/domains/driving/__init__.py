"""Driving among four cars: the world, its people, pictures and settings."""

from mirror_ppl.domains.driving.world import (
    CAR_LANES,
    CARS,
    FOG_REACH,
    ROAD_END,
    SCENARIO_SPEEDS,
    STAY,
    SWITCH,
    Driving,
    DrivingState,
    known_car_values,
    lane_rewards,
    task_weights,
)

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
