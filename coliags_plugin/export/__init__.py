"""Export of runs: files of Gaussians, baked appearance and the viewer."""
