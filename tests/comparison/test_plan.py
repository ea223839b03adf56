"""Plans: which cells there are, what they are called, and what their keys depend on."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

import pytest

from coliags_plugin.comparison.compare import plan_cells
from coliags_plugin.comparison.folder import ComparisonFolder
from coliags_plugin.comparison.named_files import Variant
from coliags_plugin.comparison.plan import make_cells
from coliags_plugin.comparison.scenes import SceneSource
from coliags_plugin.config.options import CompareOptions
from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.c3vd import C3VDDataManager
from coliags_plugin.phantom.settings import PhantomSettings
from tests.scenes import write_wall


def chosen(wall, *, steps=5, overrides=(), **options):
    return CompareOptions((wall,), Path("unused"), steps=steps, settings=tuple(overrides), **options)


def cells(wall, methods=("coliags",), **options):
    return plan_cells(methods, chosen(wall, **options))


def planned(wall, **options):
    (cell,) = cells(wall, **options)
    return cell.planned


def test_one_cell_for_each_method_split_and_seed_the_seeds_together(wall):
    every = cells(wall, ["coliags", "3dgs"], seeds=2, splits=["every-8th", "block"])
    assert [(cell.seed, cell.scene_label, cell.variant.name) for cell in every] == [
        (seed, label, method) for seed in (0, 1) for label in ("wall", "wall-block") for method in ("coliags", "3dgs")
    ]
    assert {cell.config.datamanager.settings.split for cell in every if cell.scene_label == "wall"} == {"every-8th"}
    assert len({cell.planned.key for cell in every}) == len(every)
    assert {cell.config.schedule.steps for cell in every} == {5}
    (cell,) = cells(wall, overrides=["datamanager.split=block"])
    assert cell.scene_label == "wall-block"


def test_a_key_depends_on_what_changes_a_result_and_on_nothing_else(wall, tmp_path):
    plain = planned(wall)
    assert planned(wall, overrides=["schedule.log_every=1", "schedule.checkpoint_every=2"]) == plain
    others = [
        planned(wall, steps=6),
        planned(wall, overrides=["field.features=8"]),
        planned(write_wall(tmp_path / "wall", frames=10)),
    ]
    assert len({each.run for each in [plain, *others]}) == len({each.key for each in [plain, *others]}) == 4
    authors = planned(wall, protocol="authors-code")
    assert authors.run == plain.run and authors.key != plain.key


def test_a_method_under_another_name_has_the_same_key(wall):
    ours, same, other = cells(
        wall, ["coliags", Variant("whole", "ablations/depth-imve-imia"), Variant("no-lamp", "ablations/depth-imve")]
    )
    assert ours.planned.key == same.planned.key != other.planned.key and ours.planned.run != same.planned.run
    (cell,) = cells(wall, ["ablations/depth"])
    assert cell.planned.run.startswith("runs/wall/ablations-depth/s0-")
    assert cell.planned.result == f"results/wall/ablations-depth/s0-{cell.planned.key[:8]}.json"


def test_the_fingerprint_is_that_of_the_loaded_scene(wall):
    manager = C3VDDataManager(C3VDDataManager.Settings())
    (cell,) = cells(wall)
    assert cell.fingerprint == manager.fingerprint(wall) == manager.load(wall).provenance.fingerprint


@pytest.mark.parametrize("layout", ["c3vd", "colmap"])
def test_a_phantom_to_be_made_has_a_cell_without_a_key(tmp_path, layout):
    source = SceneSource("planned", tmp_path / "planned", phantom=PhantomSettings(layout=layout, frames=9))
    (cell,) = make_cells([Variant("coliags", "coliags")], [source], chosen(tmp_path))
    assert cell.fingerprint is None and cell.config.schedule.steps == 5
    with pytest.raises(ValueError, match="planned coliags seed 0: the scene is not there"):
        _ = cell.planned


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"methods": []}, "no method"),
        ({"methods": ["colias"]}, "no method 'colias'.*Did you mean 'coliags'"),
        ({"methods": ["coliags", "coliags"]}, "more than one method is named coliags"),
        ({"seeds": 0}, "`seeds=0`"),
        ({"steps": 0}, "`steps=0`"),
        ({"splits": ["blok"]}, "no split 'blok'.*Did you mean 'block'"),
        ({"reference": "coliags"}, "`reference` without `primary`"),
        ({"primary": ["psnr"]}, "`primary` without `reference`"),
        ({"reference": "3dgs", "primary": ["psnr"]}, "no method '3dgs'"),
        ({"reference": "coliags", "primary": ["psnrs"]}, "no metric 'psnrs'.*Did you mean 'psnr'"),
        ({"protocol": "papre"}, "no protocol 'papre'.*Did you mean 'paper'"),
        ({"overrides": ["field.featurs=8"]}, "`field.featurs=8`.*Did you mean 'features'"),
    ],
)
def test_what_cannot_be_compared_is_refused(wall, options, message):
    with pytest.raises(InputError, match=message):
        cells(wall, **options)


def test_a_decision_is_recorded_when_the_plan_is_first_written(wall, tmp_path):
    folder = ComparisonFolder(tmp_path / "comparison")
    first = chosen(wall, reference="coliags", primary=["psnr", "depth_mse_inner"])
    folder.check_extends(first)
    folder.path.mkdir()
    folder.record(first, cells(wall))
    decided = folder.plan().decided
    assert (decided.reference, decided.primary) == ("coliags", ("psnr", "depth_mse_inner"))
    assert decided.date == datetime.now(timezone.utc).date().isoformat()
    folder.check_extends(first)
    with pytest.raises(InputError, match="had decided coliags by psnr, depth_mse_inner when it was begun"):
        folder.check_extends(chosen(wall, reference="coliags", primary=["psnr"]))
    more, both = chosen(wall), cells(wall, ["coliags", "3dgs"])
    folder.check_extends(more)
    folder.record(more, both)
    assert folder.plan().decided is not None
    assert [cell.method for cell in folder.plan().cells] == ["coliags", "3dgs"]
    changed = cells(wall, [Variant("coliags", "coliags", ("field.features=8",))])
    folder.record(first, changed)
    assert folder.plan().cells[0].key == changed[0].planned.key
    (tmp_path / "late" / "results").mkdir(parents=True)
    late = ComparisonFolder(tmp_path / "late")
    for _ in range(2):  # results alone, and a plan
        with pytest.raises(InputError, match="had decided nothing when it was begun"):
            late.check_extends(first)
        late.record(more, both)
