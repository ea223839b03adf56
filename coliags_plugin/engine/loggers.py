"""Followers of a training run together; loggers of the extra ``loggers``."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any
from uuid import uuid4

from coliags_plugin.config.yaml_tree import dump
from coliags_plugin.contracts import Follower, Logger, StopTraining
from coliags_plugin.core import registry
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.json_files import JsonObject, scalars

log = logging.getLogger(__name__)


class Followers(Follower):
    """Tells several followers the same; one that fails is left out from then on, with a warning."""

    def __init__(self, followers: Sequence[Follower]) -> None:
        self._followers = list(followers)
        self.stopped = False  # whether one of them has ended training

    def logged(self, row: JsonObject) -> None:
        """Pass on a row of the log."""
        self._tell(lambda follower: follower.logged(row))

    def stepped(self, step: int) -> None:
        """Pass on that a step was taken."""
        self._tell(lambda follower: follower.stepped(step))

    def close(self) -> None:
        """Close all followers."""
        self._tell(lambda follower: follower.close())

    def _tell(self, call: Callable[[Follower], None]) -> None:
        for follower in tuple(self._followers):
            try:
                call(follower)
            except StopTraining as reason:
                self.stopped = True
                log.info("%s ends training: %s", type(follower).__name__, reason)
            except Exception as error:  # whatever its library raises
                self._followers.remove(follower)
                log.warning("training goes on without %s: %r", type(follower).__name__, error)


class TensorBoardLogger(Logger):
    """Event files for TensorBoard in ``RUN/tensorboard``: ``tensorboard --logdir runs`` shows all runs."""

    library = "tensorboard"

    def __init__(self, run: Path, title: str, config: Mapping[str, Any], step: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer: Any = SummaryWriter(str(run / "tensorboard"), purge_step=step + 1 if step else None)
        self._writer.add_text("config", f"{title}\n\n```yaml\n{dump(config)}```", step)

    def logged(self, row: JsonObject) -> None:
        """Write a scalar for each number."""
        for name, value in scalars(row).items():
            self._writer.add_scalar(name, value, row["step"])

    def close(self) -> None:
        """Write what is left."""
        self._writer.close()


class WandbLogger(Logger):
    """A run of Weights & Biases in ``RUN/wandb``.

    It stays on this machine, for ``wandb sync``, unless the environment variable WANDB_MODE is ``online``; the project
    is WANDB_PROJECT, or else ``coliags_plugin``.
    """

    library = "wandb"

    def __init__(self, run: Path, title: str, config: Mapping[str, Any], step: int) -> None:
        wandb: Any = import_module("wandb")
        identity = run / "wandb" / "id.txt"  # of all attempts at the run
        identity.parent.mkdir(exist_ok=True)
        if not identity.is_file():
            identity.write_text(uuid4().hex, encoding="utf-8")
        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", "coliags_plugin"),
            name=title,
            id=identity.read_text(encoding="utf-8"),
            resume="allow",
            dir=str(run),
            config=dict(config),
            mode=os.environ.get("WANDB_MODE", "offline"),
            settings=wandb.Settings(silent=True, console="off", disable_git=True, save_code=False),
        )

    def logged(self, row: JsonObject) -> None:
        """Log all numbers of a step."""
        self._run.log(scalars(row), step=row["step"])

    def close(self) -> None:
        """Write what is left."""
        self._run.finish()


def find_loggers(names: Iterable[str]) -> list[type[Logger]]:
    """Loggers by their names, once each; InputError where one, or a library that it needs, is not here."""
    loggers: list[type[Logger]] = [registry.loggers.get(name) for name in dict.fromkeys(names)]
    for logger in loggers:
        try:
            import_module(logger.library)
        except ImportError as error:
            raise InputError(
                f"{logger.library} cannot be imported ({error})",
                f"the library that {logger.__name__} needs",
                "Install it: pip install 'coliags_plugin[loggers]' brings those of tensorboard and wandb",
            ) from error
    return loggers
