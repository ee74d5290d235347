"""Measurements of models against exact references."""
