"""Simulation-based calibration: are posteriors as sure as they may be?"""
