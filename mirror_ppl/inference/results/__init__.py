"""What comes out of a fit: draws, predictions, summaries, and their files."""
