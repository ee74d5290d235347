"""Studies that are too slow for the test suite; `make bench` runs them all."""
