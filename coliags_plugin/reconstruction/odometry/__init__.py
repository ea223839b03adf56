"""RGB-D odometry with pose-graph optimisation by open3d; given poses are not used."""
