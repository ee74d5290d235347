"""Evaluation: studies, comparisons of models, and reports of fits."""
