"""Comparison of methods over scenes: plan, execution on one machine or several, and resuming."""
