"""Metrics and the protocols that say how they are measured."""
