"""Compilation, vectors and threads of the numba kernels. Importing any of them imports numba."""
