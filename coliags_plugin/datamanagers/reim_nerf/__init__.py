"""REIM-NeRF's processed C3VD."""
