"""Tables that show themselves."""

from __future__ import annotations

from dataclasses import dataclass

from coliags_plugin.reporting.model import Table
from coliags_plugin.reporting.terminal import terminal_text


@dataclass(frozen=True, repr=False)
class DisplayTable(Table):
    """A table that ``print`` shows as text and a notebook as HTML; ``pandas.DataFrame(table.rows)`` is a data frame."""

    def __str__(self) -> str:
        """The table as text."""
        return terminal_text([self])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        """The table as HTML; notebooks ask for it."""
        from coliags_plugin.reporting.html_page import html_blocks

        return html_blocks([self])
