"""Gaussian splatting for colonoscopy: registered components assembled by declarative method configs."""

__version__ = "0.1.0"
