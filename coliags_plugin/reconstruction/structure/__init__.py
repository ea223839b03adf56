"""Structure from motion: surface points from pictures, and poses where there are none.

Plain modules, like all of ``poses``: nothing here knows a room. COLMAP does the geometry.
"""
