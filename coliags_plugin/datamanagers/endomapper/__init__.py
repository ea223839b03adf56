"""Posed sequences of the EndoMapper dataset."""
