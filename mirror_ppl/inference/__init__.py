"""Inference engines, partial pooling, calibration, and the results of fits."""
