"""The folder layouts a phantom can be written in; :data:`coliags_plugin.config.registry.phantom_layouts` names them.

To add one, subclass :class:`coliags_plugin.phantom.layouts.base.Layout` in a module of its own and register it.
"""
