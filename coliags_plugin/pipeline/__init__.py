"""Reconstruction of a video: mesh, coverage and report, in resumable stages."""
