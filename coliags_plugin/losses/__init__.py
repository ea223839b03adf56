"""Losses: scalar terms that training makes small."""
