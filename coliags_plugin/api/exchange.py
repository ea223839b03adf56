"""Files of Gaussians as runs."""

from __future__ import annotations

from pathlib import Path

from coliags_plugin.api.runs import Run


def import_splats(
    file: str | Path,
    data: str | Path,
    output: str | Path | None = None,
    *,
    data_format: str | None = None,
    device: str = "auto",
    overwrite: bool = False,
    anonymous: bool = False,
) -> Run:
    """Make a run of a file of 3D Gaussians on a scene, at step 0, to evaluate, render and mesh.

    Args:
        file: PLY, SPZ or ``.splat``, in the world frame and unit of the scene.
        data: The scene's folder.
        output: Run folder; None: ``runs/SCENE/imported/STAMP``.
        data_format: Name of a data manager; None: the one that recognises the folder.
        device: ``auto``, ``cpu`` or ``cuda``.
        overwrite: Replace an existing run folder.
        anonymous: Keep absolute paths out of the run's files; what reads the run then has to be given ``data``.

    Raises:
        InputError: The file is damaged, compressed or of another lineage, the scene cannot be read, or the folder
            exists or cannot be written.
    """
    from coliags_plugin.engine.devices import choose_device
    from coliags_plugin.engine.run_folder import RunFolder
    from coliags_plugin.export.baking.importing import import_run

    scene = Path(data)
    folder = RunFolder.default(scene.resolve().name, "imported") if output is None else RunFolder(Path(output))
    import_run(Path(file), scene, folder, choose_device(device), data_format, overwrite, anonymous)
    return Run(folder.path, data=scene, device=device)
