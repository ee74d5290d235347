"""ArviZ, imported without the announcement of its next version."""

import warnings

with warnings.catch_warnings():
    # ArviZ announces its next major version at the first import of each day.
    warnings.simplefilter("ignore", FutureWarning)
    import arviz as az

__all__ = ["az"]
