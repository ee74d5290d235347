"""The compilation of a human program and recorded rounds: what they say, computed at once."""
