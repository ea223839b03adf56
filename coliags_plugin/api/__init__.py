"""Python API: what the command line does, as functions and handles for scripts and notebooks (docs/api.md).

Its names are attributes of :mod:`coliags_plugin`, imported on first use. All of it raises
:class:`~coliags_plugin.core.errors.InputError` for invalid input; torch is imported when something is computed.
"""
