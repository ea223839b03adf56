"""Training loop, and the one place that decides whether a run begins, goes on or is refused."""

from __future__ import annotations

import json
import logging
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import replace
from typing import Any, Literal

import torch
from torch import Tensor

from coliags_plugin.config.method_config import LoadedMethod, default_rates, method_name
from coliags_plugin.config.options import TrainOptions
from coliags_plugin.contracts import Field, Follower, Loss, Sampler, Schedule, Strategy, TrainingStep
from coliags_plugin.core.errors import (
    DeviceMemoryError,
    InputError,
    InterruptedRunError,
    NotFiniteError,
    NothingDrawnError,
)
from coliags_plugin.core.files import atomic_write
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.registry import REGISTRIES
from coliags_plugin.core.render_output import BLANK_ALPHA, concatenate_pixels
from coliags_plugin.core.scenes import Frame, Scene, concatenate_targets
from coliags_plugin.core.tensors import masked_mean, sent
from coliags_plugin.datamanagers.agreement import agreed_depth
from coliags_plugin.engine import checkpoints
from coliags_plugin.engine.costs import CostMeter, HeapTrimmer, TrainingCost
from coliags_plugin.engine.data_formats import at_scale, load_method_for, load_scene, training_scale
from coliags_plugin.engine.devices import software
from coliags_plugin.engine.evaluator import check_evaluable
from coliags_plugin.engine.loggers import Followers
from coliags_plugin.engine.model import Model, check_components, make_view_modules
from coliags_plugin.engine.optimizers import Optimizers
from coliags_plugin.engine.progress import ProgressReport
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.samplers import generators
from coliags_plugin.engine.scoring import Scorer
from coliags_plugin.renderers.splatting import ChosenRenderer, choose_renderer

logger = logging.getLogger(__name__)

#: Blank views in a row after which a run stops.
MAX_BLANK_VIEWS = 10
#: What takes less memory on a device.
LESS = (
    "Fewer initial points (`datamanager.points_count=50000`), slower growth (a higher strategy.gradient_threshold) "
    "or smaller images (datamanager.width and height) take less; `device=cpu` has the computer's memory"
)
#: So that the PSNR of a perfect view stays a number, dB.
MAX_PSNR = 100.0


class Trainer:
    """Trains one method on one scene into one run folder, from a field of its own unless one is given.

    Components that fit neither each other nor the scene are refused before anything is written.
    """

    def __init__(
        self,
        method: LoadedMethod,
        scene: Scene,
        scene_path: str,
        run: RunFolder,
        seed: int,
        device: torch.device,
        field: Field | None = None,
    ) -> None:
        config = method.config
        scene, self.agreement = scene.with_near_plane(config.near_plane), None
        if config.agreed_depth:
            scene, self.agreement = agreed_depth(scene)
            logger.info("depth of %s: %s", scene.name, self.agreement or "in too few frames to be compared")
        self.method, self.scene, self.scene_path, self.run = method, scene, scene_path, run
        self.seed, self.device = seed, device
        self.steps = config.schedule.steps
        self.chosen: ChosenRenderer = choose_renderer(config.renderer, config.field.target.primitive, device)
        self.schedule = Schedule(self.steps, config.schedule.written_for)
        self.losses: dict[str, Loss] = {key: node.target(node.settings) for key, node in config.losses.items()}
        self.generators = generators(seed)
        sizes = [(frame.camera.width, frame.camera.height) for frame in scene.train]
        self.sampler: Sampler = config.sampler.target(config.sampler.settings, sizes, self.generators["frame_order"])
        self.strategy: Strategy = config.strategy.target(
            config.strategy.settings, self.generators["densification"], self.schedule, scene.extent
        )
        check_components(config, self.chosen, scene, self.losses, self.schedule)
        if field is None:
            field = config.field.target.from_scene(scene, config.field.settings, self.generators["initialisation"])
        modules = make_view_modules(config, scene)
        for module in modules.values():
            module.prepare(scene)
        self.model = Model(field, self.chosen.renderer, modules, config.near_plane)
        self.wants = tuple(sorted({"rgb", "alpha"}.union(*(loss.wants for loss in self.losses.values()))))
        self.step = 0
        try:
            self.frames = self._prepare_device()
        except torch.OutOfMemoryError as error:
            raise self._out_of_memory(error) from error
        self.model.check_outputs(self.wants, "the losses")
        for loss in self.losses.values():
            loss.check(self.model)
        self.chosen.renderer.check_field(field, config.near_plane)
        self.optimizers = self._optimizers()
        self.blank_views = 0  # in a row, up to this step
        self.costs = CostMeter(device)

    def start(self, overwrite: bool = False) -> None:
        """Make the run folder."""
        self.run.create(self.method.config.to_yaml(), self.provenance(), overwrite)

    def resume(self) -> None:
        """Resume from the run's newest whole checkpoint, or from the start without one; bitwise identical on the CPU.

        A schedule that differs from the run's own is taken as a change on purpose and recorded.
        """
        self.run.check_same(self.method, self.scene, self.scene_path)
        saved = checkpoints.take_newest(self.run.checkpoints, self.method.name, self.device)
        cost = None if saved is None else self._restore(saved)
        self.run.record_schedule(self.method.config, self.step, self.strategy.plan())
        if self.step < self.steps:
            self.run.record_code(self.step, self._plugins())
        self._cut_log()
        self.costs = CostMeter(self.device, cost)
        logger.info("resuming %s at step %d of %d", self.run.path, self.step, self.steps)

    def _restore(self, saved: checkpoints.Checkpoint) -> TrainingCost | None:
        """Load model, optimizers, strategy, sampler and random generators from a checkpoint; what it had cost."""
        self.model = checkpoints.restore_model(saved, self.method.config, self.scene, self.chosen.renderer)
        self.model.to(self.device)
        self.optimizers = self._optimizers()
        checkpoints.restore_training(saved, self.optimizers, self.sampler, self.generators, self.strategy)
        self.step = saved.step
        return saved.cost

    @property
    def seconds(self) -> float:
        """Time spent in training, all resumptions together."""
        return self.costs.seconds

    def train(
        self, save_seconds: float = math.inf, keep: int | None = None, followers: Sequence[Follower] = ()
    ) -> None:
        """Train to the last step, logging and saving on the way, or until a signal of :data:`STOPPING` comes.

        Besides those of the schedule, a checkpoint is written after so many seconds; of all, so many newest are kept.
        Followers are told of every step and of rows of the log, and closed at the end. One that raises
        :class:`~coliags_plugin.contracts.StopTraining` ends training after this step, whose state is saved.
        """
        schedule = self.method.config.schedule
        logger.info("%s", self.strategy.plan())
        for name, module in self.model.view_modules.items():
            logger.info("module %s: %s", name, module.untrained_views)
        saved, heap = time.monotonic(), HeapTrimmer()
        with (
            self.costs.running(),
            deferred_stop() as interrupted,
            ProgressReport(f"train {self.method.name}", self.steps, self.step) as progress,
            closing(Followers(followers)) as following,
        ):
            while self.step < self.steps and not following.stopped:
                try:
                    row = self.take_step()
                except torch.OutOfMemoryError as error:
                    raise self._out_of_memory(error) from error
                if self.step % schedule.log_every == 0 or self.step == self.steps:
                    row = {**row, "seconds": round(self.seconds, 3)}
                    self.run.log(row)
                    following.logged(row)
                progress.update(self.step, f"loss {row['loss']:.4f}, {row['psnr']:.2f} dB")
                following.stepped(self.step)
                heap.trim_if_grown()
                is_interrupted = interrupted() and self.step < self.steps
                stop = is_interrupted or following.stopped or self.step == self.steps
                late = time.monotonic() - saved >= save_seconds
                if self.step % schedule.checkpoint_every == 0 or stop or late:
                    self.save()
                    saved = time.monotonic()
                    if keep is not None:
                        checkpoints.keep_newest(self.run.checkpoints, keep)
                if is_interrupted:
                    raise InterruptedRunError(
                        f"stopped after step {self.step} of {self.steps}, which is saved; go on with "
                        f"{self.run.resume_command(self.method.name, self.scene_path)}"
                    )

    def take_step(self) -> JsonObject:
        """Train on the next frame; the row of the log.

        Step, loss, terms, PSNR of this view in dB, what was drawn, what the strategy did. NotFiniteError if a loss
        term, or a parameter as the step before left it, is NaN or infinite; NothingDrawnError if views stay empty.
        """
        training_step = self.render_step()
        step, output, target = training_step.step, training_step.output, training_step.target
        active = {key: loss for key, loss in self.losses.items() if loss.settings.active(step, self.schedule)}
        terms = {key: loss(training_step) for key, loss in active.items()}
        weights = {key: loss.settings.weight_at(step, self.steps) for key, loss in active.items()}
        total = torch.stack([weights[key] * term for key, term in terms.items()]).sum()
        with torch.no_grad():
            # A NaN opacity draws nothing and leaves every term finite, so parameters are looked at themselves: their
            # sum is finite if all of a group are.
            groups = self.model.parameter_groups()
            sums = [torch.stack([value.sum() for value in group]).sum() for group in groups.values()]
            squared_error = masked_mean((output.rgb - target.rgb).square(), target.mask)
            # Everything the log and the checks need, in one wait for the device.
            scalars = torch.stack([total, squared_error, output.alpha.mean(), *terms.values(), *sums])
        loss, error, alpha, *rest = scalars.tolist()
        values = dict(zip(terms, rest[: len(terms)], strict=True))
        _check_finite(dict(zip(groups, rest[len(terms) :], strict=True)), values, step, target.name)
        self._check_drawn(alpha, step)
        changes = self.finish_step(training_step, total)
        drawn = None if output.splats is None else output.splats.gaussians
        return {
            "step": step,
            "loss": loss,
            "terms": values,
            "psnr": min(MAX_PSNR, -10.0 * math.log10(max(error, 1e-30))),
            # Of Gaussians, and of the field's elements that they come from.
            **({} if drawn is None else {"gaussians": len(drawn), "visible": len(drawn.visible_sources)}),
            **changes,
        }

    def render_step(self) -> TrainingStep:
        """Render what the sampler draws next, with the outputs of ``wants``: the first half of a step."""
        step = self.step + 1
        self.model.field.before_step(step, self.schedule)
        views, targets = [], []
        for draw in self.sampler.next():
            frame = self.frames[draw.frame].to(self.device)
            view = frame.view(trained=True)
            pixels = None if draw.pixels is None else sent(draw.pixels, self.device)
            generator = self.generators["rendering"]
            views.append((view, self.model.render_stages(frame.camera, self.wants, view, pixels, generator)))
            targets.append(frame.target if pixels is None else frame.target_at(pixels))
        output = concatenate_pixels([stages[-1] for _, stages in views])
        return TrainingStep(output, concatenate_targets(targets), self.model, step, self.schedule, views)

    def finish_step(self, step: TrainingStep, loss: Tensor) -> dict[str, int]:
        """Backpropagate the loss, grow and prune, and step the optimizers: the second half of a step.

        Returns counts of what the strategy changed.
        """
        if loss.requires_grad:
            torch.autograd.backward(loss)
        changes = self.strategy.after_backward(step, self.optimizers)
        self.optimizers.step(step.step)
        for view, stages in step.views:
            for module, stage in zip(self.model.view_modules.values(), stages, strict=False):
                module.after_step(view, stage)
        self.step = step.step
        return changes

    def save(self) -> None:
        """Write a checkpoint of the current step."""
        tensors = checkpoints.training_tensors(self.model, self.optimizers, self.strategy, self.generators)
        queue, cost = self.sampler.queue, self.costs.cost()
        checkpoint = checkpoints.Checkpoint(self.step, self.method.name, queue, tensors, cost)
        checkpoints.save_checkpoint(self.run.checkpoints, checkpoint)

    def provenance(self) -> JsonObject:
        """Provenance of the run: method, scene, renderer, software and plan."""
        scene, footprint = self.scene, self.scene.pixel_footprint
        return {
            "method": self.method.name,
            "seed": self.seed,
            "steps": self.steps,
            "device": str(self.device),
            "renderer": self.chosen.name,
            "renderer_reason": self.chosen.reason,
            "untrained_views": {name: module.untrained_views for name, module in self.model.view_modules.items()},
            **software(),
            **({"plugins": plugins} if (plugins := self._plugins()) else {}),
            "scene": {
                "name": scene.name,
                "path": self.run.relative(self.scene_path),
                "extent": scene.extent,
                "pixel_footprint": footprint if math.isfinite(footprint) else None,  # without points there is none
                "points": len(scene.points),
                **({} if self.agreement is None else {"agreement": self.agreement.record}),
                "provenance": scene.provenance.record(),
            },
            "plan": self.strategy.plan(),
        }

    def _plugins(self) -> dict[str, JsonObject]:
        """Origins of the components of other packages and files, by ``kind.name``."""
        used = sorted({*self.method.config.components(), ("renderers", self.chosen.name)})
        plugins = ((kind, name) for kind, name in used if REGISTRIES[kind].source(name) != "built in")
        return {f"{kind}.{name}": REGISTRIES[kind].origin(name) for kind, name in plugins}

    def _out_of_memory(self, error: torch.OutOfMemoryError) -> DeviceMemoryError:
        count, first = self.model.field.element_count, str(error).partition("\n")[0]
        at = f"step {self.step + 1}, {count:,} elements: the memory of {self.device} ran out"
        return DeviceMemoryError(f"{at} ({first.rstrip('.')}). Checkpoints stay whole. {LESS}.")

    def _check_drawn(self, alpha: float, step: int) -> None:
        self.blank_views = 0 if alpha >= BLANK_ALPHA else self.blank_views + 1
        if self.blank_views >= MAX_BLANK_VIEWS:
            raise NothingDrawnError(
                f"nothing was drawn in the last {MAX_BLANK_VIEWS} views, until step {step}: their mean alpha is below "
                f"{BLANK_ALPHA:g}. Checkpoints stay whole. Learning rates or weights of losses may be too large, or "
                f"near_plane {self.method.config.near_plane:g} may lie beyond the tissue; `coliags check data` looks "
                "into poses and units."
            )

    def _prepare_device(self) -> list[Frame]:
        """Move the model to the device, and the frames if they fill at most a quarter of what is free there.

        Images stay uint8 there too. Returns the frames.
        """
        frames, device = self.scene.train, self.device
        self.model.to(device)
        if device.type == "cuda" and sum(map(_size, frames)) < torch.cuda.mem_get_info(device)[0] / 4:
            frames = [frame.to(device) for frame in frames]
        return frames

    def _optimizers(self) -> Optimizers:
        """Optimizers of the model's groups; defaults of groups that a component leaves out are not used."""
        config, groups = self.method.config, self.model.parameter_groups()
        unused = default_rates(config.field, config.modules).keys() - groups.keys()
        rates = {group: each for group, each in config.optimizers.items() if group not in unused}
        return Optimizers(self.model, rates, self.steps, self.scene.extent)

    def _cut_log(self) -> None:
        """Remove log rows of steps after the checkpoint, which will be repeated."""
        if self.run.log_file.is_file():
            rows = self.run.log_rows(self.step)
            atomic_write(self.run.log_file, "".join(f"{json.dumps(row)}\n" for row in rows))


def _size(frame: Frame) -> int:
    """Bytes of a frame's pixels."""
    return sum(tensor.nbytes for tensor in frame.source.read_all().values())


def _check_finite(sums: dict[str, float], terms: dict[str, float], step: int, frame: str) -> None:
    """Refuse sums of parameter groups, and loss terms, that are not finite."""
    for group, total in sums.items():
        if not math.isfinite(total):
            raise NotFiniteError(
                f"step {step - 1} left parameters of group '{group}' that are not finite. "
                f"The last checkpoint is whole; look for too large a learning rate of {group}."
            )
    for key, term in terms.items():
        if not math.isfinite(term):
            raise NotFiniteError(
                f"step {step}, frame {frame}: loss term '{key}' is {term}. "
                "The last checkpoint is whole; look for too large a learning rate or damaged data in that frame."
            )


#: Ctrl-C, what clusters send before they kill, and what a terminal sends when it is closed.
_HANGUP = getattr(signal, "SIGHUP", None)  # not on Windows
STOPPING = tuple(filter(None, (signal.SIGINT, signal.SIGTERM, _HANGUP)))


@contextmanager
def deferred_stop() -> Iterator[Callable[[], bool]]:
    """Defer :data:`STOPPING` signals: the yielded function tells whether one has come.

    The second one raises KeyboardInterrupt. SIGHUP stays ignored where it is, as under nohup.
    """
    is_asked = False

    def remember(number: int, frame: Any) -> None:
        nonlocal is_asked
        if is_asked:
            raise KeyboardInterrupt
        is_asked = True
        logger.info("%s: stopping after this step; once more to stop at once", signal.Signals(number).name)

    if threading.current_thread() is not threading.main_thread():  # signals arrive at the main thread only
        yield lambda: False
        return
    before = {number: signal.getsignal(number) for number in STOPPING}
    if before.get(_HANGUP) is signal.SIG_IGN:
        del before[_HANGUP]
    try:
        for number in before:
            signal.signal(number, remember)
        yield lambda: is_asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


#: What becomes of a run folder that is there; see :func:`open_training`.
IfExists = Literal["refuse", "overwrite", "resume", "continue"]


@contextmanager
def open_training(
    options: TrainOptions,
    folder: RunFolder,
    device: torch.device,
    if_exists: IfExists = "refuse",
    *,
    owned: bool = False,
    run_name: str | None = None,
    scene_name: str | None = None,
    protocol: str | None = None,
) -> Iterator[Trainer]:
    """Trainer of a run, from its newest whole checkpoint or from the start, after everything has been checked.

    ============  ====================  ============================================
    ``if_exists`` no or an empty folder a run
    ============  ====================  ============================================
    ``refuse``    begins                is refused
    ``overwrite`` begins                is replaced
    ``resume``    is refused            goes on, with the overrides on its own config
    ``continue``  begins                goes on as it was begun
    ============  ====================  ============================================

    Any other folder is refused; after a refusal, nothing was written. No other process can train the run until the
    block ends.

    Args:
        options: Method, scene, changes and seed.
        folder: The run.
        device: To train on.
        if_exists: See above.
        owned: The caller holds the run's lock.
        run_name: The method's name in the run; None: its own.
        scene_name: The scene's name in the run; None: its own.
        protocol: Protocol of evaluations that has to fit the run; None: not checked.
    """
    resumes = if_exists == "resume" or (if_exists == "continue" and folder.config_file.is_file())
    if resumes:
        folder = RunFolder.existing(folder.path)
        overrides, data_format = ((), None) if if_exists == "continue" else (options.overrides, options.data_format)
        name = method_name(run_name or options.method)
        folder.check_method(name)
        folder.check_plugins()
        # The config stored in the run, even if that of this name has changed since.
        method = load_method_for(options.data, str(folder.config_file.resolve()), overrides, data_format)
        method = replace(method, name=name)
        identity = folder.identity()
        seed, scale = identity.seed, identity.scale
        if options.seed not in (None, seed):
            begun = f"{folder.path}, which was started with seed {seed}"
            raise InputError(f"`seed={options.seed}` for {begun}", "no `seed`, or that one")
    else:
        folder.check_free(if_exists == "overwrite")
        method = load_method_for(options.data, options.method, options.overrides, options.data_format)
        method, seed, scale = replace(method, name=run_name or method.name), options.seed or 0, None
    scene, path = load_scene(method.config, options.data), str(options.data.resolve())
    scene = at_scale(scene, training_scale(scene) if scale is None else scale, method.config.near_plane)
    if scene_name is not None:
        scene = replace(scene, name=scene_name)
    trainer = Trainer(method, scene, path, folder, seed, device)
    if protocol is not None:
        check_evaluable(trainer.model, scene, Scorer(protocol))
    logger.info("renderer %s: %s", trainer.chosen.name, trainer.chosen.reason)
    with nullcontext() if owned else folder.owned():
        if resumes:
            trainer.resume()
        else:
            trainer.start(if_exists == "overwrite")
        yield trainer
