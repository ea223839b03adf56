"""A procedural, physically lit colon, filmed by a moving colonoscope and written in the layouts of real data sets.

:func:`coliags_plugin.phantom.generate.generate` makes one. Importing this package loads nothing heavy.
"""
