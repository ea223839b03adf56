"""Data managers by dataset format; shared code in ``recorded`` and ``file_formats``."""
