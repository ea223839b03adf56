"""The kernels of the cpu renderer, one stage per file. Importing any of them imports numba.

They share the tables that ``layout`` describes, and ``pipeline`` calls them in order.
"""
