"""A procedural, physically lit colon, filmed by a moving colonoscope and written in C3VD's own layouts.

:func:`coliags_plugin.datamanagers.phantom.generate.generate` makes one. Importing this package loads nothing heavy.
"""
