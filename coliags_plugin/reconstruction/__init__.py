"""Poses and points from pictures: structure from motion, triangulation, RGB-D odometry."""
