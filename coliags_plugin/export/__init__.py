"""What leaves a run: files of Gaussians, baked appearance and the viewer."""
