"""Version of the package, which is stored in results."""

__version__ = "0.2.0"
