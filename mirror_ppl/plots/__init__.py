"""Figures, as functions of ArviZ and xarray objects.

They draw on figures of their own (or on axes that are passed in) and leave matplotlib's global
state alone, so they work in notebooks, in scripts and without a display alike.
"""
