"""Images, depth and a trajectory in TUM's form."""
