"""Figures, as functions of ArviZ and xarray objects."""
