"""Training: determinism, bit-exact resume, and stopping cleanly; run folders, their names and logs."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from dataclasses import replace
from datetime import datetime
from unittest import mock

import numpy as np
import pytest
import torch

from coliags_plugin.config.method_config import load_method
from coliags_plugin.core import registry
from coliags_plugin.core.errors import DeviceMemoryError, InputError, InterruptedRunError, NotFiniteError
from coliags_plugin.core.files import CHECKSUMS, write_checksums
from coliags_plugin.core.registry import REGISTRIES, Registry, register
from coliags_plugin.engine import run_folder
from coliags_plugin.engine.checkpoints import DamagedCheckpointError, read_checkpoint, take_newest
from coliags_plugin.engine.devices import software
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trainer import Trainer
from coliags_plugin.losses.target import L1Loss
from tests.pretended_cuda import CUDA, PretendedCuda
from tests.scenes import SMALL, wall_scene

CPU = torch.device("cpu")

#: A window so early that growing and pruning happen within a test.
EARLY_GROWTH = (
    *("strategy.statistics_from=0", "strategy.growth_from=2", "strategy.every=3", "strategy.until=8"),
    *("strategy.min_opacity=0.5", "strategy.gradient_threshold=1e-7", "strategy.pixels_per_birth=50"),
    *("schedule.written_for=16", "field.voxel_size=1.0", "optimizers.offsets.lr=0.3"),
)
MODULES = (
    *("modules.exposure=gain", 'optimizers."exposure.gain"={lr: 0.01}', "modules.poses=pose-correction"),
    *('optimizers."poses.rotation"={lr: 0.001}', 'optimizers."poses.translation"={lr: 0.01}'),
)
#: Growth and both regularization losses of surfels within a few steps.
SURFELS = (
    *("renderer=torch", "schedule.written_for=14", "losses.distortion.from_step=3", "losses.normals.from_step=5"),
    *("strategy.densify_from=1", "strategy.until=12", "strategy.every=4", "strategy.reset_every=9"),
    *("strategy.gradient_threshold=1e-4", "strategy.min_opacity=0.09"),
)
#: Noise and growth of Gaussians that are lit.
LIT = (
    *("schedule.written_for=14", "field.network_from=3", "field.normal_neighbours=10", "strategy.densify_from=2"),
    *("strategy.until=12", "strategy.every=4", "strategy.gradient_threshold=1e-7", "strategy.prune_above=0"),
    "losses.diffuse-factor={from_step: 3, until_step: 12}",
)


def make_trainer(path, method="coliags", steps=6, scene=None, seed=0, overrides=(), device=CPU):
    small = SMALL if load_method(method).config.field.name == "anchors" else (SMALL[0], SMALL[2])
    loaded = load_method(method, [*small, f"schedule.steps={steps}", *overrides])
    return Trainer(loaded, scene or wall_scene(), "wall", RunFolder(path), seed, device)


def train(path, **options):
    trainer = make_trainer(path, **options)
    trainer.start()
    trainer.train()
    return trainer


def final_state(trainer):
    return read_checkpoint(trainer.run.newest_checkpoint, trainer.method.name, CPU)


def assert_same(first, second):
    assert first.step == second.step
    assert first.frame_queue == second.frame_queue
    assert first.tensors.keys() == second.tensors.keys()
    for name, tensor in first.tensors.items():
        assert torch.equal(tensor, second.tensors[name]), name


def interfere(trainer, act):
    """Let each step call a function of its number before it is taken."""
    take = trainer.take_step

    def step():
        act(trainer.step + 1)
        return take()

    trainer.take_step = step


def interrupt(trainer, last, number=signal.SIGINT, times=1):
    """Send a real signal, or several, while a step is in hand."""
    interfere(trainer, lambda step: [os.kill(os.getpid(), number) for _ in range(times if step == last else 0)])


def kill(trainer, last):
    """Let the process fail, as if killed, after a step."""

    def act(step):
        if step > last:
            raise RuntimeError("killed")

    interfere(trainer, act)


def log_rows(trainer):
    return [json.loads(line) for line in trainer.run.log_file.read_text().splitlines()]


def without_clock(rows):
    return [{key: value for key, value in row.items() if key != "seconds"} for row in rows]


def test_a_loop_of_halves_of_steps_is_training_to_the_bit(tmp_path):
    overrides = ["modules.exposure={name: gain}", "optimizers={exposure.gain: {lr: 0.01}}"]
    usual, trainer = train(tmp_path / "a", overrides=overrides), make_trainer(tmp_path / "b", overrides=overrides)
    trainer.start()
    while trainer.step < trainer.steps:
        step = trainer.render_step()
        terms = {key: loss(step) for key, loss in trainer.losses.items()}
        weights = {key: trainer.losses[key].settings.weight_at(step.step, trainer.steps) for key in terms}
        trainer.finish_step(step, torch.stack([weights[key] * term for key, term in terms.items()]).sum())
    trainer.save()
    assert_same(final_state(trainer), final_state(usual))


@pytest.mark.parametrize(
    ("method", "steps", "cut", "overrides", "number"),
    [
        ("coliags", 16, 7, EARLY_GROWTH, signal.SIGINT),
        ("scaffold-gs", 6, 3, MODULES, signal.SIGTERM),
        ("scaffold-gs", 6, 3, MODULES, signal.SIGHUP),
        pytest.param("2dgs", 14, 6, SURFELS, signal.SIGINT, marks=pytest.mark.thorough),
        pytest.param("pr-endo", 14, 6, LIT, signal.SIGINT, marks=pytest.mark.thorough),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_an_interrupted_run_resumes_to_the_bit(tmp_path, request, method, steps, cut, overrides, number):
    """Interrupted in the middle of a round, resumed by a fresh trainer: the same bits as never interrupted."""
    before = signal.signal(number, signal.default_int_handler)  # nohup and background jobs ignore some of them
    request.addfinalizer(lambda: signal.signal(number, before))
    options = {"method": method, "steps": steps, "overrides": overrides}
    whole, broken = train(tmp_path / "whole", **options), make_trainer(tmp_path / "cut", **options)
    broken.start()
    interrupt(broken, cut, number)
    with pytest.raises(InterruptedRunError, match=f"stopped after step {cut}"):
        broken.train()
    resumed = make_trainer(tmp_path / "cut", **options)
    resumed.resume()
    assert resumed.step == cut
    resumed.train()
    assert_same(final_state(whole), final_state(resumed))
    assert without_clock(log_rows(whole)) == without_clock(log_rows(resumed))
    changes = {name: sum(row.get(name, 0) for row in log_rows(resumed)) for name in ("grown", "pruned")}
    assert changes["grown"] > 0 or overrides is MODULES
    assert changes["pruned"] > 0 or overrides in (MODULES, LIT)


def test_a_signal_that_nohup_ignores_stays_ignored(tmp_path):
    trainer = make_trainer(tmp_path / "run", steps=4)
    trainer.start()
    interrupt(trainer, 2, signal.SIGHUP)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        trainer.train()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
    assert trainer.step == 4
    again = make_trainer(tmp_path / "again")
    again.start()
    interrupt(again, 1, times=2)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):  # a second interrupt does not wait
        again.train()
    assert signal.getsignal(signal.SIGINT) is before


def test_loss_that_is_not_finite_names_step_frame_and_term(tmp_path):
    trainer = make_trainer(tmp_path / "run")
    trainer.start()
    honest, factors = trainer.losses["d-ssim"], iter([1.0, 1.0, float("nan")])
    poisoned = mock.Mock(side_effect=lambda step: honest(step) * next(factors), settings=honest.settings)
    trainer.losses["d-ssim"] = poisoned
    with pytest.raises(NotFiniteError, match=r"step 3, frame 000\d: loss term 'd-ssim' is nan"):
        trainer.train()


def test_resuming_another_run_is_refused(tmp_path):
    train(tmp_path / "run", steps=1)
    with pytest.raises(InputError, match="other settings of field"):
        make_trainer(tmp_path / "run", overrides=["field.features=16"]).resume()
    with pytest.raises(InputError, match="not the data"):
        make_trainer(tmp_path / "run", scene=wall_scene(frames=12)).resume()


def test_a_run_killed_before_its_first_checkpoint_starts_again(tmp_path):
    whole = train(tmp_path / "whole", steps=4)
    killed = make_trainer(tmp_path / "run", steps=4)
    killed.start()
    killed.run.log_file.write_text('{"step": 1, "loss": 1.0}\n')
    again = make_trainer(tmp_path / "run", steps=4)
    again.resume()
    again.train()
    assert_same(final_state(whole), final_state(again))
    assert without_clock(log_rows(whole)) == without_clock(log_rows(again))


def test_a_changed_schedule_is_recorded_and_rows_after_the_checkpoint_are_forgotten(tmp_path):
    trainer = train(tmp_path / "run", steps=4)
    with trainer.run.log_file.open("a") as log:
        log.write('{"step": 5, "loss": 1.0}\n{"step": 6, "lo')
    longer = make_trainer(tmp_path / "run", steps=6)
    longer.resume()
    longer.train()
    assert [row["step"] for row in log_rows(longer)] == [1, 2, 3, 4, 5, 6]
    provenance = longer.run.provenance()
    assert provenance["steps"] == longer.run.method().config.schedule.steps == 6
    assert provenance["plan"] == longer.strategy.plan()
    (change,) = provenance["schedule_changes"]
    assert (change["at_step"], change["from"]["steps"], change["to"]["steps"]) == (4, 4, 6)
    make_trainer(tmp_path / "run", steps=6).resume()
    assert longer.run.provenance() == provenance
    with pytest.raises(InputError, match="has taken 6 steps already"):
        make_trainer(tmp_path / "run", steps=5).resume()


def test_other_code_is_recorded_where_a_run_goes_on_with_it(tmp_path, monkeypatch, caplog):
    train(tmp_path / "run", steps=4)
    before = RunFolder(tmp_path / "run").provenance()
    assert before["code"] == run_folder.code_key() and "code_changes" not in before
    monkeypatch.setattr(run_folder, "code_key", lambda: "0123456789abcdef")
    make_trainer(tmp_path / "run", steps=4).resume()  # there is nothing left to train
    assert RunFolder(tmp_path / "run").provenance() == before
    for _ in range(2):
        make_trainer(tmp_path / "run", steps=6).resume()
        changes = RunFolder(tmp_path / "run").provenance()["code_changes"]
        assert changes == [{"at_step": 4, "code": "0123456789abcdef"}]
    assert caplog.text.count("the code has changed since") == 1


def test_a_run_records_its_plugins_and_is_not_loaded_without_them(tmp_path, monkeypatch, caplog):
    plugin, built_in = tmp_path / "mine.py", registry._BUILT_INS[("losses", "loss")]
    imports = "from coliags_plugin.losses.target import L1Loss"
    plugin.write_text(f"{imports}\n\n\nclass Mine(L1Loss): ...\n\n\nCOMPONENTS = {{'losses': {{'mine': Mine}}}}\n")
    monkeypatch.setenv("COLIAGS_PLUGIN_PATH", str(plugin))
    monkeypatch.setitem(REGISTRIES, "losses", Registry("losses", built_in, "loss"))
    register("losses", "ours", L1Loss)
    overrides = ["losses.mine={name: mine, weight: 1.0}", "losses.ours={name: ours, weight: 1.0}"]
    run = train(tmp_path / "run", steps=2, overrides=overrides).run
    plugins = run.provenance()["plugins"]
    assert {name: (each["source"], each["file"]) for name, each in plugins.items()} == {
        "losses.mine": ("COLIAGS_PLUGIN_PATH", "mine.py"),
        "losses.ours": ("coliags_plugin.register", "target.py"),
    }
    plugin.write_text(f"{plugin.read_text()}# changed\n")
    make_trainer(run.path, steps=4, overrides=overrides).resume()
    (change,) = run.provenance()["code_changes"]
    assert change["plugins"]["losses.ours"] == plugins["losses.ours"]
    assert change["plugins"]["losses.mine"]["sha256"] != plugins["losses.mine"]["sha256"]
    monkeypatch.delenv("COLIAGS_PLUGIN_PATH")
    monkeypatch.setitem(REGISTRIES, "losses", Registry("losses", built_in, "loss"))
    message = (
        r"needs loss 'mine', from COLIAGS_PLUGIN_PATH \(mine\.py, SHA-256 \w{8}\.\.\.\)\. .* Set COLIAGS_PLUGIN_PATH"
    )
    with pytest.raises(InputError, match=message):
        run.method()
    monkeypatch.setenv("COLIAGS_PLUGIN_PATH", str(plugin))
    monkeypatch.setitem(REGISTRIES, "losses", Registry("losses", built_in, "loss"))
    with pytest.raises(InputError, match=r"needs loss 'ours', from coliags_plugin\.register .* register it"):
        run.method()


def test_nan_parameters_are_found_in_the_next_step_and_never_saved(tmp_path):
    """A NaN opacity head draws nothing, and every loss term stays finite."""
    trainer = make_trainer(tmp_path / "run", steps=9)
    trainer.start()
    trainer.take_step()
    trainer.save()
    with torch.no_grad():
        trainer.model.field.geometry_head.opacity_mlp[0].weight[0, 0] = float("nan")
    with pytest.raises(NotFiniteError, match="step 1 left parameters of group 'opacity_mlp'"):
        trainer.take_step()
    with pytest.raises(NotFiniteError, match=r"field/geometry_head\.opacity_mlp\.0\.weight"):
        trainer.save()
    assert [path.name for path in trainer.run.checkpoints.iterdir()] == ["step-000001"]
    assert trainer.run.newest_checkpoint.name == "step-000001"


def test_checkpoints_by_the_clock_and_how_many_are_kept(tmp_path):
    trainer = make_trainer(tmp_path / "run", steps=6, overrides=["schedule.checkpoint_every=100"])
    trainer.start()
    trainer.train(save_seconds=0.0, keep=2)
    assert sorted(path.name for path in trainer.run.checkpoints.iterdir()) == ["step-000005", "step-000006"]
    other = make_trainer(tmp_path / "other", steps=6, overrides=["schedule.checkpoint_every=2"])
    other.start()
    other.train(save_seconds=3600.0)
    assert len(list(other.run.checkpoints.iterdir())) == 3
    make_trainer(tmp_path / "other").start(overwrite=True)
    assert not other.run.checkpoints.exists()


def test_damaged_checkpoints_are_set_aside_for_the_one_before(tmp_path, caplog):
    trainer = make_trainer(tmp_path / "run", steps=6, overrides=["schedule.checkpoint_every=2"])
    trainer.start()
    trainer.train()
    folder = trainer.run.checkpoints
    assert take_newest(folder, "coliags", CPU).step == 6
    (folder / "step-000006" / "state.safetensors").write_bytes(b"")
    (folder / "step-000004" / "state.json").write_text("{")
    with pytest.raises(InputError, match=r"step-000006 is damaged: .*goes on from step-000004"):
        read_checkpoint(folder / "step-000006", "coliags", CPU)
    resumed = make_trainer(tmp_path / "run", steps=6)
    resumed.resume()
    assert resumed.step == 2
    assert "step-000006 is damaged: state.safetensors is not what was written; set aside as damaged-" in caplog.text
    assert trainer.run.newest_checkpoint.name == "step-000002"
    assert sorted(path.name.rsplit("-", 1)[0] for path in folder.glob("damaged-*")) == [
        "damaged-step-000004",
        "damaged-step-000006",
    ]
    assert take_newest(tmp_path / "none", "coliags", CPU) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        *(({"frame_queue": frames}, "step-000002 is damaged: 1 validation error") for frames in ([{}], [-1], [True])),
        ({"frame_queue": [3, 7]}, "plans frame 7"),
        ({"format": 99}, "has format 99"),
        ({"method": "other"}, "is of method 'other'"),
    ],
)
def test_a_checkpoint_of_something_else_is_refused(tmp_path, change, message):
    trainer = train(tmp_path / "run", steps=2)
    checkpoint = trainer.run.newest_checkpoint
    state = json.loads((checkpoint / "state.json").read_text())
    (checkpoint / "state.json").write_text(json.dumps({**state, **change}))
    write_checksums(checkpoint)
    with pytest.raises(InputError, match=message):
        trainer._restore(read_checkpoint(checkpoint, "coliags", CPU))
    if "frame_queue" not in change:  # which is not set aside
        with pytest.raises(InputError, match=message):
            trainer.resume()
        assert checkpoint.is_dir()


def test_moments_and_random_states_of_another_run_are_refused(tmp_path):
    trainer = train(tmp_path / "run", steps=2)
    whole = read_checkpoint(trainer.run.newest_checkpoint, "coliags", CPU)
    for name in ("optimizer/none/0/exp_avg", "optimizer/anchors", "generator/none", "generator/frame_order"):
        with pytest.raises(InputError, match=r"moments are of another optimizer|random state does not fit"):
            trainer._restore(replace(whole, tensors={**whole.tensors, name: torch.zeros(3)}))
    moments = [name for name in whole.tensors if name.startswith("optimizer/") and not name.endswith("/step")]
    for name in moments:
        for spoiled in ({}, {name: whole.tensors[name][:-1]}, {name: whole.tensors[name].double()}):
            others = {key: value for key, value in whole.tensors.items() if key != name}
            with pytest.raises(InputError, match="moments are of another optimizer"):
                trainer._restore(replace(whole, tensors=others | spoiled))
    trainer._restore(whole)


def test_every_flipped_byte_of_a_checkpoint_is_noticed(tmp_path):
    checkpoint = train(tmp_path / "run", steps=1).run.newest_checkpoint
    assert subprocess.run(["sha256sum", "--check", "--quiet", CHECKSUMS], cwd=checkpoint, check=False).returncode == 0
    generator = np.random.default_rng(0)
    for file in sorted(checkpoint.iterdir()):
        whole = file.read_bytes()
        for place in [0, len(whole) - 1, *generator.integers(0, len(whole), 20)]:
            spoiled = bytearray(whole)
            spoiled[place] ^= 1 << int(generator.integers(8))
            file.write_bytes(spoiled)
            with pytest.raises(DamagedCheckpointError):
                read_checkpoint(checkpoint, "coliags", CPU)
        file.write_bytes(whole)
    assert read_checkpoint(checkpoint, "coliags", CPU).step == 1


def test_learning_rates_follow_the_papers_schedules(tmp_path):
    trainer = make_trainer(tmp_path / "run", steps=30_000)
    optimizers, extent = trainer.optimizers, trainer.scene.extent
    assert optimizers.rate("offsets", 1) == pytest.approx(0.01 * extent, rel=1e-3)
    assert optimizers.rate("offsets", 15_000) == pytest.approx(0.001 * extent)
    assert optimizers.rate("offsets", 30_000) == pytest.approx(0.0001 * extent)
    assert optimizers.rate("opacity_mlp", 15_000) == pytest.approx(0.0002)
    assert optimizers.rate("color_mlp", 30_000) == pytest.approx(0.00005)
    assert optimizers.rate("features", 1) == optimizers.rate("features", 30_000) == 0.0075


def test_each_step_and_term_is_logged_and_where_the_run_came_from(tmp_path):
    trainer = train(tmp_path / "run", steps=30, seed=5)
    rows = log_rows(trainer)
    assert [row["step"] for row in rows] == list(range(1, 31))
    assert all(set(row["terms"]) == {"l1", "d-ssim", "scale-volume", "depth"} for row in rows)
    assert rows[-1]["psnr"] > rows[0]["psnr"]
    provenance = json.loads(trainer.run.provenance_file.read_text())
    assert provenance["seed"] == 5 and provenance["renderer"] == "cpu" and "auto" in provenance["renderer_reason"]
    assert provenance["scene"]["provenance"]["fingerprint"] == "wall-9-True"
    assert software().items() <= provenance.items()


def test_training_depth_is_what_frames_agree_on_where_the_method_says_so(tmp_path):
    scene, noise = wall_scene(), 0.03 * torch.randn(7, generator=torch.Generator().manual_seed(2))
    noisy = [frame.with_maps(depth=frame.depth * by.exp()) for frame, by in zip(scene.train, noise, strict=True)]
    given = replace(scene, train=noisy)
    plain = make_trainer(tmp_path / "plain", scene=given)
    agreed = make_trainer(tmp_path / "agreed", scene=given, overrides=["agreed_depth=true"])
    assert all(used.depth is frame.depth for used, frame in zip(plain.scene.train, noisy, strict=True))
    assert "agreement" not in plain.provenance()["scene"]

    def error(frames):
        logs = [(frame.depth / true.depth).log() for frame, true in zip(frames, scene.train, strict=True)]
        return float(torch.stack(logs).square().mean().sqrt())

    agreement = agreed.provenance()["scene"]["agreement"]
    assert agreement["noise"] > 2 * agreement["remaining_noise"] > 0
    assert agreed.frames is agreed.scene.train and error(agreed.frames) < error(noisy) / 2
    assert agreed.scene.points is scene.points and agreed.scene.test_sets is scene.test_sets


# Memory of a device


def test_frames_stay_on_the_cpu_where_they_would_fill_the_device(monkeypatch, tmp_path):
    with PretendedCuda():
        assert make_trainer(tmp_path, "3dgs", overrides=["renderer=torch"], device=CUDA).frames[0].image.is_cuda
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda *_: (10_000, 2**34))
        assert not make_trainer(tmp_path, "3dgs", overrides=["renderer=torch"], device=CUDA).frames[0].image.is_cuda


def too_much(*args, **kwargs):
    raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.\nMore")


TOLD = r"step 1, 2,464 elements: .* ran out \(CUDA out of memory.*2.00 GiB\).*whole.*points_count.*width.*device=cpu"


def test_memory_that_runs_out_is_told(tmp_path, monkeypatch):
    trainer = make_trainer(tmp_path / "run", "3dgs")
    trainer.start()
    monkeypatch.setattr(trainer.model, "render_stages", too_much)
    with pytest.raises(DeviceMemoryError, match=TOLD):
        trainer.train()
    monkeypatch.setattr(torch.nn.Module, "to", too_much)
    with pytest.raises(DeviceMemoryError, match=TOLD):
        make_trainer(tmp_path / "other", "3dgs")


def test_runs_begun_in_one_second_get_folders_of_their_own(tmp_path, monkeypatch):
    clock = mock.Mock(wraps=datetime, **{"now.return_value": datetime(2026, 1, 2, 3, 4, 5)})
    monkeypatch.setattr(run_folder, "datetime", clock)
    monkeypatch.chdir(tmp_path)
    names = []
    for _ in range(12):
        folder = RunFolder.default("wall", "coliags")
        folder.create("name: coliags\n", {}, overwrite=False)
        names.append(folder.path.name)
    assert names[:2] == ["20260102-030405", "20260102-030405-02"]
    assert names == sorted(set(names))
    assert RunFolder.newest("wall", "coliags") == folder


@pytest.mark.parametrize("written", [{}, {"format": 1}])
def test_a_run_of_another_version_is_refused_by_name(tmp_path, written):
    folder = RunFolder(tmp_path / "run")
    folder.create("name: coliags\n", {"method": "coliags"}, overwrite=False)
    assert folder.provenance()["method"] == "coliags"
    folder.provenance_file.write_text(json.dumps({**written, "package_version": "0.1.0"}))
    for read in (folder.provenance, folder.identity):
        with pytest.raises(InputError, match=r"provenance\.json is of coliags_plugin 0\.1\.0.*Train again, or use"):
            read()


def test_the_log_is_read_to_a_step_without_its_damaged_lines(tmp_path):
    run = RunFolder(tmp_path)
    assert run.logged_step == 0 and run.log_rows(3) == []
    rows = [{"step": step, "psnr": 20.0, "seconds": 1.0 * step} for step in range(1, 1000)]
    run.log_file.write_text("".join(json.dumps(row) + "\n" for row in rows) + '{"step": 5}\n[]\n3\n{"step": 1000, "ps')
    assert run.log_rows(3) == rows[:3] and run.log_rows(2000) == rows
    run.log_file.write_text("".join(json.dumps(row) + "\n" for row in rows) + '{"step": 1000, "ps')
    assert run.logged_step == 999
