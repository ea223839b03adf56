"""Pictures, depth and a trajectory in TUM's form."""
