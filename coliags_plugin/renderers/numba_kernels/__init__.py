"""The kernels of the cpu renderer, one stage per file. Importing any of them imports numba.

They share the tables that ``layout`` describes, and ``pipeline`` calls them in order: project, bin, sweep forward; sweep
backward, gather, project backward. 3D Gaussians and surfels have the same kernels, made from what differs by factories
(``projecting``, ``sweeping``, ``gathering``). Names used throughout:

- **lanes**: a SIMD vector of sixteen float32, one Gaussian or one pixel each.
- **group**: sixteen Gaussians, processed as lanes; tables are padded to whole groups.
- **parcel**: 1024 Gaussians, the unit of work of the projection's threads.
- **tile**: 16 x 16 pixels; **block**: 4 x 4 pixels of a tile, processed as lanes.
- **pair**: a Gaussian and a tile that it touches, while lists are built; **entry**: the same pair in its tile's list,
  front to back; **cell**: the three integers that store an entry.
- **stretch**: consecutive Gaussians of the list sorted by depth, the unit of work of binning and gathering.
- **chunk**: the entries of a tile whose rows are fetched into the cache at a time.
- **record**: the sixteen numbers that projection leaves of a Gaussian; **row**: a record as fetched for a tile.
- **sweep**: compositing of all tiles (forward), or its derivatives (backward), both front to back.
- **sums**: derivatives added up over the pixels of an entry, then over the entries of a Gaussian.
- **crew**: the threads that run a kernel; each takes the next parcel, stretch or tile from a shared counter.

Arguments of kernels, besides: ``counters`` are zeros from which threads take work; ``view``, ``grid``, ``projections``,
``bins`` and ``pairs`` are what ``layout`` describes, and ``outputs`` what is composited; ``scratch`` has NUMBERS and
INTEGERS of ``tiles`` for each thread. What is written comes last, padded to whole groups.
"""
