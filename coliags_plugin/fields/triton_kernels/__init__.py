"""Decoding of anchors by triton kernels, on CUDA.

A program decodes 32 anchors at a time; what networks see, and their hidden layers, are blocks that are multiplied in
float32. Two launches decode a view, and two differentiate it: hidden layers are computed again instead of stored.
``docs/methods.md`` 3.5 tells what is tested where.
"""
