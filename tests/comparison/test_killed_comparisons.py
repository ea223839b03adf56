"""A comparison whose processes are killed ends with the results of one that nobody disturbed, and repeats nothing.

The cluster is a real Ray cluster of two nodes on this machine. All nodes share one disk, so that these tests do not
show that run folders travel between machines.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

import coliags_plugin as cp
from coliags_plugin.comparison.worker import CellTask
from coliags_plugin.config.yaml_tree import parse_assignments
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine import ray_executor
from coliags_plugin.engine.ray_executor import RayExecutor
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.tasks import LocalExecutor, TaskOutcome
from tests.commands import refused
from tests.comparison.small import OFTEN, TINY, compare_inline, hashes, lock_holder, until

STEPS, METHODS = 120, ("coliags", "scaffold-gs-depth")
#: Runs that last longer, as a node of a cluster needs a second to begin one.
CLUSTER_STEPS, CLUSTER_METHODS = 300, ("coliags", "scaffold-gs-depth", "scaffold-gs", "scaffold-gs-distance")


def trainings(folder: Path) -> dict[str, list[int]]:
    """Steps from which training was started or resumed, by run."""
    return {
        path.relative_to(folder / "logs").with_suffix("").as_posix(): [
            int(step) for step in re.findall(r"training from step (\d+)", path.read_text(encoding="utf-8"))
        ]
        for path in sorted((folder / "logs").rglob("*.log"))
    }


def start_compare(methods, wall, folder, steps, *words, stderr=subprocess.PIPE):
    """``coliags compare`` as a process, alone in its group; each run on one CPU thread."""
    argv = ["compare", *methods, "--scenes", wall, "--output", folder, "--steps", steps, "--threads", 1, *words]
    sets = [word for each in OFTEN for word in ("--set", each)]
    command = [sys.executable, "-c", "from coliags_plugin.cli import main; main()", *map(str, argv)]
    return subprocess.Popen([*command, "--device", "cpu", *sets], stderr=stderr, text=True, start_new_session=True)


def check_logs(folder, steps):
    """Every run has logged every step once, and went on from further and further steps."""
    for run, begun in trainings(folder).items():
        log = (folder / "runs" / run / "metrics.jsonl").read_text(encoding="utf-8")
        assert [json.loads(line)["step"] for line in log.splitlines()] == list(range(1, steps + 1))
        assert begun[0] == 0 and begun == sorted(set(begun)), f"{run} was begun at {begun}"


@pytest.fixture
def undisturbed(request, wall, tmp_path):
    """Hashes of a comparison that nobody disturbs, each run on one CPU thread."""
    on_cluster = "cluster" in request.fixturenames
    methods, steps = (CLUSTER_METHODS, CLUSTER_STEPS) if on_cluster else (METHODS, STEPS)
    assert not compare_inline(methods, [wall], tmp_path / "undisturbed", steps=steps, overrides=OFTEN).failures
    return hashes(tmp_path / "undisturbed")


# On this machine


def process_of(folder, method):
    """The worker that has the run of a method; None if none has, be it that the run is done."""
    return lock_holder(folder, f"runs/wall/{method}/.*.lock")


def run_of(folder, method):
    """The run folder of a method, once there is one with so many steps."""
    folders = [path for path in folder.glob(f"runs/wall/{method}/s0-*") if RunFolder(path).logged_step > 20]
    return folders[0] if folders else None


def is_running(process):
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_comparison_that_is_asked_to_stop_saves_its_runs(wall, undisturbed, tmp_path, number):
    folder = tmp_path / "stopped"
    first = start_compare(METHODS, wall, folder, STEPS, "--jobs", 2)
    until("step", lambda: run_of(folder, "coliags") and run_of(folder, "scaffold-gs-depth"))
    os.kill(first.pid, number)
    _, messages = first.communicate()
    assert first.returncode == 130
    assert "stopped with 0 of 2 cells done; the same command goes on where it stopped" in messages
    runs = sorted(folder.glob("runs/wall/*/s0-*"))
    saved = {run.relative_to(folder / "runs").as_posix(): RunFolder(run).step for run in runs}
    assert list(saved.values()) == [RunFolder(run).logged_step for run in runs], "the last step that was taken is saved"
    last = start_compare(METHODS, wall, folder, STEPS, "--jobs", 2)
    last.communicate()
    assert last.returncode == 0 and hashes(folder) == undisturbed
    assert trainings(folder) == {run: [0, step] for run, step in saved.items()}


@pytest.mark.thorough
def test_killed_worker_and_killed_driver(wall, undisturbed, tmp_path):
    folder = tmp_path / "killed"
    first = start_compare(METHODS, wall, folder, STEPS, "--jobs", 2)
    until("step", lambda: run_of(folder, "coliags"))
    struck = process_of(folder, "coliags")
    os.kill(struck, signal.SIGKILL)
    until("retry", lambda: process_of(folder, "coliags") not in (None, struck))
    workers = [worker for method in METHODS if (worker := process_of(folder, method))]
    first.kill()
    _, messages = first.communicate()
    assert "SIGKILL" in messages and "trying again" in messages
    until("end of the workers", lambda: not any(map(is_running, workers)))

    options = {"steps": STEPS, "settings": parse_assignments(OFTEN), "jobs": 2, "threads": 1, "device": "cpu"}
    assert not cp.compare(METHODS, wall, folder, **options).failures
    assert hashes(folder) == undisturbed
    check_logs(folder, STEPS)
    assert any(len(begun) > 1 for begun in trainings(folder).values())

    before = trainings(folder)
    cp.compare(METHODS, wall, folder, **options)
    assert trainings(folder) == before, "what is done is not run again"


# Tasks of worker processes


@pytest.fixture
def task(tmp_path):
    places = {name: tmp_path / name for name in ("data", "folder", "result", "log")}
    return CellTask(
        title="wall coliags seed 0",
        name="coliags",
        method="coliags",
        overrides=("field.features=8",),
        scene="wall",
        data_format=None,
        seed=0,
        device="cpu",
        protocol="paper",
        key="0" * 16,
        threads=3,
        variables={"COLIAGS_LPIPS_WEIGHTS": "here"},
        **places,
    )


def test_a_task_travels_as_json(task):
    assert CellTask.from_json(task.to_json()) == task


def test_the_environment_names_threads_package_and_variables(task):
    environment = task.environment({"HOME": "/home", "PYTHONPATH": "mine", "OMP_NUM_THREADS": "64"})
    assert environment["OMP_NUM_THREADS"] == environment["OPENBLAS_NUM_THREADS"] == "3"
    assert environment["COLIAGS_LPIPS_WEIGHTS"] == "here" and environment["HOME"] == "/home"
    first, second = environment["PYTHONPATH"].split(os.pathsep)
    assert second == "mine" and os.path.isdir(os.path.join(first, "coliags_plugin"))


def test_an_outcome_is_read_from_the_last_line_and_a_process_that_says_nothing_has_died():
    for outcome in (TaskOutcome("done"), TaskOutcome("failed", 'no "depth"\nat all')):
        assert TaskOutcome.read(1, f"noise\n{outcome.line()}\n") == outcome
    for returncode, printed, reason in (
        (-signal.SIGKILL, "", "was ended by SIGKILL; the system does so when memory runs out"),
        (-signal.SIGSEGV, "half a li", "was ended by SIGSEGV"),
        (0, "[1]", "ended with status 0 without a message"),
    ):
        assert TaskOutcome.read(returncode, printed) == TaskOutcome("died", f"the process {reason}")


def test_a_crash_a_scene_that_is_gone_and_a_run_that_another_process_has_are_the_reason(task, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(CellTask, "complete", lambda self: 1 / 0)
        assert task.attempt() == TaskOutcome("failed", "ZeroDivisionError: division by zero")
    outcome = task.attempt()
    assert outcome.ending == "failed" and f"no folder {task.data}" in outcome.reason
    with RunFolder(task.folder).owned():
        outcome = replace(task, lock_seconds=0.3).attempt()
    owner = f"{task.folder} is in use by process {os.getpid()} on {os.uname().nodename} since 20"
    assert outcome.ending == "failed" and outcome.reason.startswith(owner)


class Sleeper(CellTask):
    """Whose process sleeps until its input is closed, then needs a moment."""

    def command(self):
        code = f"# on {self.device}\nimport sys, time\nprint('up', file=sys.stderr, flush=True)\n"
        code += "sys.stdin.read()\ntime.sleep(0.2)\n"
        code += 'print(\'{"ending": "stopped", "reason": "asked"}\')'
        return [sys.executable, "-c", code]


def test_the_local_executor_runs_as_many_as_it_has_slots_for_and_stops_them(task):
    executor = LocalExecutor(2, threads=1, gpus=("4", "7"))
    sleeper = Sleeper.from_json(task.to_json())
    executor.start(sleeper)
    executor.start(sleeper)
    assert executor.wait(0.2) == []
    environments = [
        Path(f"/proc/{worker._process.pid}/environ").read_bytes().split(b"\0") for worker in executor._workers.values()
    ]
    assert [b"CUDA_VISIBLE_DEVICES=%d" % gpu in each for gpu, each in zip((4, 7), environments, strict=True)] == [
        True
    ] * 2
    # Each sees one GPU, which is cuda whatever its number is, and may not go without.
    assert task.device == "cpu" and all("# on cuda\n" in each._process.args[-1] for each in executor._workers.values())
    while task.log.read_text().count("up") < 2:
        time.sleep(0.01)
    processes = [worker._process for worker in executor._workers.values()]
    executor.stop()
    assert [process.returncode for process in processes] == [0, 0]
    executor.start(sleeper)
    executor._workers[0]._process.kill()
    ((_, outcome),) = executor.wait(30.0)
    assert outcome.ending == "died" and "SIGKILL" in outcome.reason


# On a cluster


def test_ray_that_is_not_installed_is_told_how_to_get(wall, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    message = refused(capsys, "compare", "coliags", "--scenes", wall, "--output", tmp_path / "x", "--executor", "ray")
    assert 'pip install "coliags_plugin[sweep]"' in message and not (tmp_path / "x").exists()


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nowhere"])
def test_a_cluster_that_cannot_be_reached(wall, tmp_path, capsys, address):
    pytest.importorskip("ray")
    words = ("compare", "coliags", "--scenes", wall, "--output", tmp_path / "x", "--executor", "ray")
    message = refused(capsys, *words, "--ray-address", address)
    assert f"no Ray cluster at {address}" in message and "ray start --head" in message


def patiently(start):
    """Result of a start tried four times: on a busy machine a node may miss the 30 seconds that Ray gives it."""
    for _ in range(4):
        try:
            return start()
        except Exception as error:
            last_error = error
    raise last_error


@pytest.fixture
def cluster():
    """A head, which this process belongs to and which runs nothing, and two nodes of one CPU each."""
    pytest.importorskip("ray")
    import ray
    from ray.cluster_utils import Cluster

    head = {"num_cpus": 0, "include_dashboard": False}
    ray_cluster = patiently(lambda: Cluster(initialize_head=True, head_node_args=head))
    nodes = [patiently(lambda: ray_cluster.add_node(num_cpus=1)) for _ in range(2)]
    ray_cluster.wait_for_nodes(timeout=120)
    yield ray_cluster, nodes
    ray.shutdown()
    ray_cluster.shutdown()


def driver(wall, folder, address):
    """``coliags compare --executor ray``; its messages go to a file beside."""
    with messages_of(folder).open("w") as messages:
        return start_compare(
            CLUSTER_METHODS, wall, folder, CLUSTER_STEPS, "--executor", "ray", "--ray-address", address, stderr=messages
        )


def messages_of(folder):
    return folder.with_suffix(".txt")


def told_by(folder):
    return messages_of(folder).read_text()


def under_way(folder):
    """A process that has taken some steps of a run and has not ended; None where there is none."""
    for lock in folder.glob("runs/wall/*/.s0-*.lock"):
        run = lock.with_name(lock.name[1:].removesuffix(".lock"))
        holder = lock_holder(lock.parent, lock.name)
        if holder and 20 < RunFolder(run).logged_step < CLUSTER_STEPS and is_running(holder):
            return holder
    return None


def parent_of(process):
    return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])


def node_of(process, nodes):
    """The node that a worker's Ray process belongs to: its raylet is the parent of that."""
    raylet = parent_of(parent_of(process))
    return next(
        node for node in nodes if any(info.process.pid == raylet for info in node.all_processes.get("raylet", []))
    )


def check(folder, undisturbed):
    """Every result is that of the undisturbed comparison, and no step was kept twice or lost."""
    assert hashes(folder) == undisturbed
    check_logs(folder, CLUSTER_STEPS)
    assert not list(folder.rglob(".storage-*")) and not list((folder / "failures").rglob("*.json"))


@pytest.mark.slow
def test_a_worker_a_node_and_the_driver_are_killed(cluster, wall, undisturbed, tmp_path):
    ray_cluster, nodes = cluster
    folder = tmp_path / "killed"
    first = driver(wall, folder, ray_cluster.address)
    os.kill(until("run", lambda: under_way(folder)), signal.SIGKILL)
    until("retry of the worker", lambda: told_by(folder).count("trying again") == 1)
    lost = node_of(until("second run", lambda: under_way(folder)), nodes)
    ray_cluster.remove_node(lost, allow_graceful=False)
    nodes.remove(lost)
    until("retry on the other node", lambda: told_by(folder).count("trying again") == 2)
    assert "SIGKILL" in told_by(folder) and "the node died" in told_by(folder)
    until("third run", lambda: under_way(folder))
    first.kill()
    first.wait()

    assert driver(wall, folder, ray_cluster.address).wait() == 0, told_by(folder)
    check(folder, undisturbed)
    before = trainings(folder)
    assert sum(map(len, before.values())) >= len(CLUSTER_METHODS) + 2, "what was struck went on"
    assert driver(wall, folder, ray_cluster.address).wait() == 0
    assert trainings(folder) == before, "what is done is not run again"


@pytest.mark.slow
def test_a_sweep_that_nobody_disturbs_and_one_that_is_asked_to_stop(cluster, wall, undisturbed, tmp_path):
    ray_cluster, _ = cluster
    folder = tmp_path / "stopped"
    first = driver(wall, folder, ray_cluster.address)
    until("run", lambda: under_way(folder))
    os.kill(first.pid, signal.SIGINT)
    assert first.wait() == 130 and "the same command goes on" in told_by(folder)
    settings = parse_assignments(OFTEN)
    options = {"threads": 1, "device": "cpu", "executor": "ray", "ray_address": ray_cluster.address}
    comparison = cp.compare(CLUSTER_METHODS, wall, folder, steps=CLUSTER_STEPS, settings=settings, **options)
    assert not comparison.failures
    check(folder, undisturbed)


@pytest.mark.slow
def test_tries_are_counted_when_memory_runs_out(monkeypatch, request, wall, tmp_path):
    """Ray's own retries then have no end."""
    monkeypatch.setenv("RAY_memory_usage_threshold", "0.001")  # less than is in use
    monkeypatch.setenv("RAY_memory_monitor_refresh_ms", "100")
    monkeypatch.setattr(RayExecutor, "check", lambda *_: None)  # whose tasks would end likewise
    ray_cluster, _ = request.getfixturevalue("cluster")
    settings = parse_assignments(TINY)
    options = {"threads": 1, "device": "cpu", "executor": "ray", "ray_address": ray_cluster.address, "retries": 1}
    comparison = cp.compare("coliags", wall, tmp_path / "full", steps=100_000, settings=settings, **options)
    (failure,) = comparison.failures
    assert (failure.reason, failure.attempts) == ("the node's memory ran out, 2 times", 2)


@pytest.mark.slow
def test_a_folder_that_a_node_does_not_see(cluster, wall, tmp_path, monkeypatch):
    ray_cluster, _ = cluster
    executor = RayExecutor(ray_cluster.address, None, 1, "cpu")
    assert executor.slots == 2
    executor.check(tmp_path, [wall])
    assert not list(tmp_path.glob(".storage-*"))
    with pytest.raises(InputError, match=r"node .* does not see .*/gone\. Expected inputs on storage"):
        executor.check(tmp_path, [wall, tmp_path / "gone"])
    ask = RayExecutor._ask

    def elsewhere(self, node, file, scenes):
        return ask(self, node, Path("/proc/1/nowhere") / file.name, scenes)

    monkeypatch.setattr(RayExecutor, "_ask", elsewhere)
    with pytest.raises(InputError, match=r"node .* does not see .*No such file.*storage that all machines share"):
        executor.check(tmp_path, [wall])


@pytest.mark.slow
def test_every_run_gets_a_gpu_of_its_own(cluster, wall, tmp_path, monkeypatch):
    ray_cluster, _ = cluster
    with pytest.raises(InputError, match="the cluster has no GPU"):
        RayExecutor(ray_cluster.address, None, 1, "cuda")
    patiently(lambda: ray_cluster.add_node(num_cpus=3, num_gpus=2))
    ray_cluster.wait_for_nodes(timeout=120)
    assert RayExecutor(ray_cluster.address, None, 1, "cpu").slots == 5

    def device_seen(task):
        time.sleep(2.0)
        return {"ending": "done", "reason": os.environ.get("CUDA_VISIBLE_DEVICES", "")}

    monkeypatch.setattr(ray_executor, "_work", device_seen)
    for device, gpus in (("auto", {"0", "1"}), ("cpu", {""})):
        executor = RayExecutor(ray_cluster.address, None, 1, device)
        for _ in range(2):
            executor.start(None)
        ended = []
        while len(ended) < 2:
            ended += executor.wait(60.0)
        assert {outcome.reason for _, outcome in ended} == gpus
        assert executor.slots == (2 if device == "auto" else 5)
