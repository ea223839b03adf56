"""Synthetic colonoscopy videos of a procedural, physically lit colon, written in the layouts of real datasets.

:func:`coliags_plugin.phantom.generate.generate` makes one. Importing this package loads nothing heavy.
"""
