"""Interactive view of a run in a browser."""
