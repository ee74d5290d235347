"""Simulation-based calibration: ranks of the truth among posterior draws, and coverage."""
