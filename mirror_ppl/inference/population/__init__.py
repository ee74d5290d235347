"""Partial pooling: the population that people are from, inferred with them."""
