"""Pictures, charts and video of what was rendered."""
