"""Camera trajectories: the files they come in, and how far two of them are apart.

Plain modules: nothing here knows a room.
"""
