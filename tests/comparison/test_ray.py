"""Sweeps on a real Ray cluster of two nodes on this machine: whatever is killed, the results are those of one that
nobody disturbed, nothing is run twice and nothing is lost.

All nodes share one disk, so that these tests do not show that run folders travel between machines.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import pytest

import coliags_plugin as cp
from coliags_plugin.config.assignments import parse_assignments
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine import ray_executor
from coliags_plugin.engine.ray_executor import RayExecutor
from coliags_plugin.engine.run_folder import RunFolder
from tests.commands import refused
from tests.comparison.small import (
    OFTEN,
    TINY,
    check_logs,
    hashes,
    lock_holder,
    start_compare,
    trainings,
    undisturbed_hashes,
    until,
)

STEPS = 300
METHODS = ("coliags", "scaffold-gs-depth", "scaffold-gs", "scaffold-gs-distance")


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


@pytest.fixture
def undisturbed(wall, tmp_path):
    return undisturbed_hashes(METHODS, wall, tmp_path / "undisturbed", STEPS)


def driver(wall, folder, address):
    """``coliags compare --executor ray``; its messages go to a file beside."""
    with messages_of(folder).open("w") as messages:
        return start_compare(
            METHODS, wall, folder, STEPS, "--executor", "ray", "--ray-address", address, stderr=messages
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
        if holder and 20 < RunFolder(run).logged_step < STEPS and is_running(holder):
            return holder
    return None


def is_running(process):
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


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
    check_logs(folder, STEPS)
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
    assert sum(map(len, before.values())) >= len(METHODS) + 2, "what was struck went on"
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
    comparison = cp.compare(METHODS, wall, folder, steps=STEPS, settings=settings, **options)
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
