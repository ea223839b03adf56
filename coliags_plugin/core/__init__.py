"""Plain data and small tools that every package may use, and the version of the package."""

__version__ = "0.1.0"
