"""Losses: the scalar terms that training minimises."""
