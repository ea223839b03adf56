"""Data managers, one folder per dataset format; shared code in ``recorded`` and, for reading files, in ``reading``."""
