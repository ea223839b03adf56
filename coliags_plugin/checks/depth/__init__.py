"""Comparison of estimated with true depth: ``coliags depth check``."""
