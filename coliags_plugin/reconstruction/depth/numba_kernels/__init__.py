"""Compiled loops of depth estimation. Importing any of them imports numba; each file stands alone for numba's cache."""
