"""Guides, variational inference with exact enumeration, training, and ArviZ export."""
