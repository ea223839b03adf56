"""Triangle meshes: files, cleaning, comparison with a true surface."""
