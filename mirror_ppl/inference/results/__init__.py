"""Results of a fit: draws, predictions, summaries, and their files."""
