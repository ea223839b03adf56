"""All that follows a training run, which none of them can end."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from coliags_plugin.contracts import Follower
from coliags_plugin.core.json_files import JsonObject

log = logging.getLogger(__name__)


class Followers(Follower):
    """Tells several followers the same; one that fails is left out from then on, with a warning."""

    def __init__(self, followers: Sequence[Follower]) -> None:
        self._followers = list(followers)

    def logged(self, row: JsonObject) -> None:
        """See :class:`Follower`."""
        self._tell(lambda follower: follower.logged(row))

    def stepped(self, step: int) -> None:
        """See :class:`Follower`."""
        self._tell(lambda follower: follower.stepped(step))

    def close(self) -> None:
        """See :class:`Follower`."""
        self._tell(lambda follower: follower.close())

    def _tell(self, call: Callable[[Follower], None]) -> None:
        for follower in tuple(self._followers):
            try:
                call(follower)
            except Exception as error:  # whatever its library raises
                self._followers.remove(follower)
                log.warning("training goes on without %s: %s", type(follower).__name__, error)
