"""Executor on a Ray cluster: plain Ray tasks, each of which starts the same worker process as on one machine.

Ray's own retries are off: its retries when memory runs out have no end, and the queue counts its own, whatever ends a
worker. What a task has done is in its folder, which all nodes must see.
"""

from __future__ import annotations

import logging
import os
import socket
import time
import uuid
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from coliags_plugin.core import __version__
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.engine.tasks import STOPPING, Executor, LocalWorker, Task, TaskOutcome

log = logging.getLogger(__name__)

#: Time for an answer of a node to the question what it sees, seconds.
_ANSWER = 120.0
#: Time for a connection to the cluster's address, seconds.
_CONNECT = 10.0
_PAUSE = 0.1
#: Ray's errors of tasks that ended without a word, whose own texts are long.
_DEATHS = {
    "NodeDiedError": "the node died",
    "OutOfMemoryError": "the node's memory ran out",
    "WorkerCrashedError": "the task's process was ended",
}
_START = "Start one: `ray start --head`, and `ray start --address HOST:PORT` on every other machine"


class RayExecutor(Executor):
    """Tasks on the nodes of a cluster.

    Args:
        address: ``HOST:PORT`` of the cluster's head; None: ``RAY_ADDRESS``, or the cluster of this machine.
        slots: How many at once; None: as many as the cluster has CPUs or GPUs for.
        threads: CPU threads of each, which it takes from the node's CPUs.
        device: ``auto``, ``cpu`` or ``cuda``; each task takes a GPU for itself unless it is ``cpu`` or there is none.
    """

    def __init__(self, address: str | None, slots: int | None, threads: int, device: str) -> None:
        if device not in ("auto", "cpu", "cuda"):
            raise InputError(
                f"`device={device}` with `executor=ray`", "auto, cpu or cuda", "Ray gives each run its GPU"
            )
        self._ray = _connected(address or os.environ.get("RAY_ADDRESS") or "auto")
        self.threads, self._slots = threads, slots
        self._gpus = 0 if device == "cpu" or not self._resource("GPU") else 1
        if device == "cuda" and not self._gpus:
            raise InputError("device cuda was requested, but the cluster has no GPU", "cpu, or auto")
        self._tasks: dict[Any, Task] = {}  # by reference of the answer
        self._work = self._ray.remote(_work).options(num_cpus=threads, num_gpus=self._gpus, max_retries=0)

    @property
    def slots(self) -> int:  # type: ignore[override]
        """Number of tasks that the cluster has room for now; fewer where that was asked for."""
        rooms = [int(self._resource("CPU") // self.threads)]
        rooms += [int(self._resource("GPU"))] if self._gpus else []
        return max(1, min(rooms if self._slots is None else [*rooms, self._slots]))

    def check(self, folder: Path, inputs: Sequence[Path]) -> None:
        """Have every node read and write in the folder, and see the inputs."""
        file = folder.resolve() / f".storage-{uuid.uuid4().hex}"
        atomic_write(file, "")
        try:
            for node in (node for node in self._ray.nodes() if node["Alive"]):
                if fault := self._ask(node, file, [path.resolve() for path in inputs]):
                    raise InputError(f"node {node['NodeManagerAddress']} {fault[0]}", *fault[1:])
        finally:
            for path in folder.resolve().glob(f"{file.name}*"):
                path.unlink(missing_ok=True)

    def start(self, task: Task) -> None:
        """Give a task to the cluster."""
        self._tasks[self._work.remote(task)] = task

    def wait(self, seconds: float) -> list[tuple[Task, TaskOutcome]]:
        """Wait for a task that ends; returns it with its outcome."""
        ready, _ = self._ray.wait(list(self._tasks), num_returns=1, timeout=seconds)
        return [(self._tasks.pop(reference), self._outcome(reference)) for reference in ready]

    def stop(self) -> None:
        """Cancel all tasks, whose workers save their state; by force those that need too long."""
        for reference in self._tasks:
            self._ray.cancel(reference)
        if self._tasks:
            _, unfinished = self._ray.wait(list(self._tasks), num_returns=len(self._tasks), timeout=STOPPING + 10.0)
            for reference in unfinished:
                self._ray.cancel(reference, force=True)
        self._tasks.clear()

    def _resource(self, name: str) -> float:
        return float(self._ray.cluster_resources().get(name, 0.0))

    def _ask(self, node: Mapping[str, Any], file: Path, inputs: Sequence[Path]) -> tuple[str, ...]:
        """Fault of a node: what was seen, expected, and to do; empty where it has none, or is gone meanwhile."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        there, errors = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False), self._ray.exceptions
        look = self._ray.remote(_fault_of_node).options(num_cpus=0, max_retries=0, scheduling_strategy=there)
        try:
            fault: tuple[str, ...] = self._ray.get(look.remote(__version__, file, inputs), timeout=_ANSWER)
        except (errors.TaskUnschedulableError, errors.NodeDiedError):
            log.warning("node %s is gone", node["NodeManagerAddress"])
            return ()
        except errors.RayError as error:
            expected = f"coliags_plugin {__version__} on every node"
            return f"cannot run tasks: {_last_line(error)}", expected, "Install it there in the Python of `ray start`"
        return fault

    def _outcome(self, reference: Any) -> TaskOutcome:
        try:
            return TaskOutcome(**self._ray.get(reference))
        except self._ray.exceptions.TaskCancelledError:
            return TaskOutcome("stopped")
        except self._ray.exceptions.RayError as error:
            reason = _DEATHS.get(type(error).__name__)
            return TaskOutcome("died", reason or f"{type(error).__name__}: {_last_line(error)}")


def _connected(address: str) -> Any:
    """Ray, connected to the cluster at an address; to the one that it is connected to already."""
    try:
        import ray
    except ImportError as error:
        expected, do = "the package with its extra 'sweep'", 'pip install "coliags_plugin[sweep]"'
        raise InputError("`executor=ray`, but Ray is not installed", expected, do) from error
    if ray.is_initialized():
        return ray
    try:
        if address != "auto" and "://" not in address:  # Ray itself would wait for long
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), _CONNECT).close()
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except (OSError, RuntimeError, ValueError) as error:
        reason = str(error).strip().partition("\n")[0]
        raise InputError(
            f"no Ray cluster at {address}: {reason}", "HOST:PORT of a running one's head", _START
        ) from error
    return ray


def _fault_of_node(version: str, file: Path, inputs: Sequence[Path]) -> tuple[str, ...]:
    """Fault of the node that this runs on: another version, a folder that it cannot write, or inputs that it lacks."""
    if version != __version__:
        return f"has coliags_plugin {__version__}", f"{version}, as here", "Install it there"
    place = "on storage that all machines share, under the same path"
    try:
        renamed = file.rename(file.with_name(f"{file.name}-seen"))
        renamed.rename(file)
    except OSError as error:
        fault = f"does not see {file.parent}, or cannot write there: {error.strerror or error}"
        return fault, f"an `output` {place}", "Choose a folder on a network file system"
    missing = ", ".join(str(path) for path in inputs if not path.exists())
    return (f"does not see {missing}", f"inputs {place}", "Copy them there") if missing else ()


def _work(task: Task) -> dict[str, Any]:
    """Run a worker process on a node, to its end or until the task is cancelled."""
    worker = LocalWorker(task)
    try:
        while not worker.ended:
            time.sleep(_PAUSE)
        return asdict(worker.outcome())
    except KeyboardInterrupt:
        worker.ask_to_stop()
        with suppress(KeyboardInterrupt):
            worker.wait_or_kill(STOPPING)
        return asdict(TaskOutcome("stopped"))


def _last_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__
