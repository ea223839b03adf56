"""Compositing by triton kernels, on the devices that triton serves.

One program composites one tile of 8 x 8 pixels, front to back, 16 pairs at a time: what a pair is at a pixel is an
element of a [16, 64] block, transmittances are products along its columns, sums over pairs and their derivatives are
products of matrices, and those over pixels sums of rows. The rules, and why the backward pass goes front to back too,
are those of ``renderers/compositing.py``; ``docs/rendering.md``, section "The triton backend", tells what is
tested where.
"""
