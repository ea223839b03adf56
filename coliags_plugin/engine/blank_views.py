"""Stops a run whose views stay empty."""

from __future__ import annotations

from coliags_plugin.core.errors import ReportedError

#: Views in a row without anything in them after which a run stops.
LIMIT = 100


class NothingDrawnError(ReportedError):
    """Nothing was drawn for many steps: the field is not where the cameras look."""


class BlankViews:
    """Counts training views in a row in which nothing was drawn."""

    def __init__(self) -> None:
        self._count = 0

    def see(self, alpha: float, step: int) -> None:
        """Count the view of a step.

        Args:
            alpha: Largest in the view.
            step: Of training, for the message.

        Raises:
            NothingDrawnError: It and :data:`LIMIT` - 1 views before it are empty.
        """
        self._count = 0 if alpha > 0.0 else self._count + 1
        if self._count >= LIMIT:
            raise NothingDrawnError(
                f"nothing was drawn in the last {LIMIT} views, until step {step}. The last checkpoint is whole; "
                "learning rates or weights of losses may be too large. `coliags data check` looks into poses and units."
            )
