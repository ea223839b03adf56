"""RGB-D odometry: poses from pictures and depth, where there are none or none to trust.

Plain modules, like all of ``poses``: nothing here knows a room, and no given pose can come in.
"""
