"""The fields' numba kernels on the CPU. Importing any of them imports numba."""
