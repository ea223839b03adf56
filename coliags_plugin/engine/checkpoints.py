"""Checkpoints: safetensors for tensors and JSON for the rest, written atomically."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import torch
from pydantic import ConfigDict, NonNegativeInt
from pydantic.dataclasses import dataclass
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from coliags_plugin.config.method_config import MethodConfig
from coliags_plugin.contracts import Renderer, Sampler, Strategy
from coliags_plugin.core import __version__
from coliags_plugin.core.errors import InputError, NotFiniteError
from coliags_plugin.core.files import atomic_folder, differing_files, final_place, write_checksums, write_json
from coliags_plugin.core.json_files import JsonObject, json_text, parse_json
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.costs import TrainingCost
from coliags_plugin.engine.model import Model, make_view_modules
from coliags_plugin.engine.optimizers import Optimizers
from coliags_plugin.engine.run_folder import checkpoint_step, checkpoints_in_order

logger = logging.getLogger(__name__)

FORMAT = 4


class DamagedCheckpointError(InputError):
    """A file of a checkpoint is missing or is not what was written."""


@dataclass(frozen=True, config=ConfigDict(strict=True, arbitrary_types_allowed=True))
class Checkpoint:
    """Content of a checkpoint: of ``state.json``, and the tensors."""

    step: NonNegativeInt  # taken
    method: str
    frame_queue: list[NonNegativeInt]  # that the sampler has planned, the last being next
    tensors: dict[str, Tensor]  # by ``<part>/<name>``: field, modules, optimizer, strategy and generator
    cost: TrainingCost | None = None  # of the run so far; None before the first step of a training loop

    def part(self, name: str) -> dict[str, Tensor]:
        """The tensors of one part."""
        prefix = f"{name}/"
        return {key[len(prefix) :]: value for key, value in self.tensors.items() if key.startswith(prefix)}


def training_tensors(
    model: Model, optimizers: Optimizers, strategy: Strategy, generators: Mapping[str, torch.Generator]
) -> dict[str, Tensor]:
    """The tensors of a checkpoint, for bitwise identical continuation of training."""
    tensors: dict[str, Tensor] = {f"field/{name}": value for name, value in model.field.state_dict().items()}
    for module, part in model.view_modules.items():
        tensors |= {f"modules/{module}/{name}": value for name, value in part.state_dict().items()}
    for group, adam in optimizers.adam.items():
        for index, parameter in enumerate(adam.param_groups[0]["params"]):
            for key, value in adam.state.get(parameter, {}).items():
                tensors[f"optimizer/{group}/{index}/{key}"] = value
    tensors |= {f"strategy/{name}": value for name, value in strategy.state_dict().items()}
    return tensors | {f"generator/{name}": generator.get_state() for name, generator in generators.items()}


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Write ``step-<step>`` into a folder.

    Raises:
        NotFiniteError: A number in it is NaN or infinite; nothing was written.
    """
    _check_finite(checkpoint.tensors, checkpoint.step)
    state: JsonObject = {"format": FORMAT}
    state |= {name: getattr(checkpoint, name) for name in ("step", "method", "frame_queue")}
    if checkpoint.cost is not None:
        state["cost"] = checkpoint.cost.model_dump()
    with atomic_folder(checkpoint_folder(folder, checkpoint.step), overwrite=True) as scratch:
        save_tensors(checkpoint.tensors, scratch / "state.safetensors")
        write_json(scratch / "state.json", state)
        write_checksums(scratch)


def save_tensors(tensors: Mapping[str, Tensor], file: Path) -> None:
    """Write named tensors as safetensors, with the permissions that the umask leaves."""
    file.touch()
    permissions = file.stat().st_mode & 0o777  # safetensors itself gives them to the owner only
    try:
        save_file({key: value.detach().contiguous() for key, value in tensors.items()}, file)
        file.chmod(permissions)
    except SafetensorError as error:  # the only error it knows, of a full disk too
        raise InputError(
            f"cannot write to {final_place(file.parent)}: {error}",
            "a disk with space left",
            "Free some; `resume=True` goes on",
        ) from error


def _check_finite(tensors: Mapping[str, Tensor], step: int) -> None:
    spoiled = [key for key, value in tensors.items() if not torch.isfinite(value).all()]
    if spoiled:
        raise NotFiniteError(
            f"after step {step} these are not finite: {', '.join(spoiled)}. No checkpoint was written; "
            "the last one is whole. Look for too large a learning rate."
        )


def checkpoint_folder(folder: Path, step: int) -> Path:
    """Folder of the checkpoint of a step."""
    return folder / f"step-{step:06d}"


def keep_newest(folder: Path, count: int) -> None:
    """Remove all checkpoints but so many of the highest steps."""
    for path in checkpoints_in_order(folder)[:-count]:
        shutil.rmtree(path)


def take_newest(folder: Path, method: str, device: torch.device) -> Checkpoint | None:
    """The newest whole checkpoint, to go on from; None without one. Damaged ones are renamed to ``damaged-*``."""
    for newest in reversed(checkpoints_in_order(folder)):
        try:
            return read_checkpoint(newest, method, device)
        except DamagedCheckpointError as error:
            aside = newest.with_name(f"damaged-{newest.name}-{time.time_ns()}")
            logger.warning("%s; set aside as %s", error.seen, aside.name)
            newest.rename(aside)
    return None


def read_checkpoint(path: Path, method: str, device: torch.device) -> Checkpoint:
    """Read one checkpoint of a method; generator states stay on the CPU."""
    differing = differing_files(path)
    if differing:
        raise _damaged(path, f"{', '.join(differing)} is not what was written")
    try:
        content = parse_json(json_text(path / "state.json"), finite=True)
        if (version := content["format"]) != FORMAT:
            raise InputError(
                f"checkpoint {path} has format {version}",
                f"format {FORMAT}, of version {__version__}",
                "Train again, or use the version of this package that wrote it",
            )
        tensors = load_file(path / "state.safetensors")
        placed = {key: value if key.startswith("generator/") else value.to(device) for key, value in tensors.items()}
        saved = Checkpoint(**{**content, "tensors": placed})
    except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
        raise _damaged(path, str(error)) from error
    if saved.method != method:
        raise InputError(
            f"checkpoint {path} is of method '{saved.method}'", f"one of method '{method}'", "Name its own method"
        )
    return saved


@contextmanager
def _fitting(what: str) -> Iterator[None]:
    """Report that a part of a checkpoint is not of this run; ``what`` begins the message."""
    try:
        yield
    except (KeyError, IndexError, RuntimeError, TypeError, ValueError) as error:
        raise InputError(f"{what}: {error}", "one of this run") from error


def restore_model(
    checkpoint: Checkpoint, config: MethodConfig, scene: Scene, renderer: Renderer, scale: float = 1.0
) -> Model:
    """The model of a checkpoint, which trained on a scene at a scale; view modules have parameters of its frames."""
    with _fitting(f"the checkpoint does not fit field '{config.field.name}'"):
        field = config.field.target.from_state(checkpoint.part("field"), config.field.settings)
    modules = make_view_modules(config, scene.scaled(scale))
    for name, module in modules.items():
        with _fitting(f"the checkpoint's module '{name}' does not fit"):
            module.load_state_dict(checkpoint.part(f"modules/{name}"))
    return Model(field, renderer, modules, config.near_plane, scale)


def restore_training(
    checkpoint: Checkpoint,
    optimizers: Optimizers,
    sampler: Sampler,
    generators: Mapping[str, torch.Generator],
    strategy: Strategy,
) -> None:
    """Load Adam's moments, the frames that were planned, the states of the random generators, a strategy's counters."""
    with _fitting("the checkpoint's moments are of another optimizer"):
        for key, value in checkpoint.part("optimizer").items():
            group, index, name = key.split("/")
            adam = optimizers.adam[group]
            adam.state[adam.param_groups[0]["params"][int(index)]][name] = value
        optimizers.check_moments()
    queue, count = list(checkpoint.frame_queue), len(sampler.sizes)
    if any(frame >= count for frame in queue):
        raise InputError(f"the checkpoint plans frame {max(queue)}", f"one of {count} frames")
    sampler.queue = queue
    with _fitting("the checkpoint's random state does not fit"):
        states = checkpoint.part("generator")
        if states.keys() != generators.keys():
            raise KeyError(f"generators {', '.join(states)}")
        for name, state in states.items():
            generators[name].set_state(state)
    with _fitting("the checkpoint lacks a counter of the strategy"):
        strategy.load_state_dict(checkpoint.part("strategy"))


def _damaged(path: Path, reason: str) -> DamagedCheckpointError:
    """The error of a damaged checkpoint, which names the one before it."""
    before = [
        other.name for other in checkpoints_in_order(path.parent) if checkpoint_step(other) < checkpoint_step(path)
    ]
    way = f"`resume=True` sets it aside and goes on from {before[-1] if before else 'the start'}"
    return DamagedCheckpointError(f"checkpoint {path} is damaged: {reason}", "an intact checkpoint", way)
