"""Datasets on disk, each read into a scene.

A folder a format, its ``manager`` being what the registry names; ``reading``: files that any of them may have; beside
them what all share, from a recording on disk to a scene (``recorded``); ``phantom``: writes data instead.
"""
