"""Building blocks of a report's text: what HTML, Markdown and LaTeX have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from coliags_plugin.comparison.report.tables import Table


@dataclass(frozen=True)
class Paragraph:
    """Sentences."""

    text: str


@dataclass(frozen=True)
class Folded:
    """Blocks behind a title that a reader unfolds; in Markdown and LaTeX, blocks under a title."""

    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Section:
    """Blocks under a heading."""

    title: str
    blocks: Sequence[Block]


Block = Paragraph | Table | Folded


@dataclass(frozen=True)
class Content:
    """The text of a report.

    Attributes:
        title: Heading.
        note: Remark under it; may be empty.
        reference: Method that the others are compared with.
        facts: Names and values: scenes, methods, protocol.
        description: How the protocol computes its metrics.
        cautions: What limits the comparison.
        metrics: Summary tables and statistics.
        failures: Cells without a result; None without one.
        costs: Table of costs.
        scenes: Tables of single scenes; None for a single one.
    """

    title: str
    note: str
    reference: str
    facts: Sequence[tuple[str, str]]
    description: str
    cautions: Sequence[str]
    metrics: Section
    failures: Section | None
    costs: Section
    scenes: Section | None

    @property
    def sections(self) -> list[Section]:
        """All sections in order."""
        return [part for part in (self.metrics, self.failures, self.costs, self.scenes) if part is not None]
