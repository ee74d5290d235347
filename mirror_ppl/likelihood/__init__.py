"""Compilation of a human program and recorded rounds to tables of their likelihood."""
