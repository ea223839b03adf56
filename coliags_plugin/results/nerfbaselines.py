"""Results in the form of nerfbaselines' results files (version 1.2.12, MIT)."""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.results.record import Result

#: Names where theirs and ours clash: their ``lpips`` is AlexNet's. Others are kept, ``psnr`` and ``ssim`` being theirs.
NAMES = {"lpips": "lpips_vgg"}


def nerfbaselines_result(result: Result) -> dict[str, Any]:
    """A result in their form: the main test set, and of it the metrics that every frame has.

    Not in it are further test sets, metrics that a frame lacks, and profiles. The hashes of predictions and truth are
    ours, of the numbers that were compared; theirs are of image files.
    """
    part = result.sets[result.main_set]
    known = {name: [value for value in values if value is not None] for name, values in part.values.items()}
    raw = {NAMES.get(name, name): values for name, values in known.items() if len(values) == len(part.frames) > 0}
    protocol = f"coliags-{result.protocol.name}-{result.protocol.version}"
    return {
        "nb_info": {
            "method": result.method,
            "num_iterations": result.steps,
            **_cost(result),
            "config_overrides": {},
            "dataset_metadata": {
                "id": result.provenance.get("scene", {}).get("dataset", result.scene.name),
                "scene": result.scene.name,
            },
            "evaluation_protocol": protocol,
            "hparams": result.config,
        },
        "evaluate_version": f"coliags_plugin {result.software.get('package_version')}",
        "metrics": {name: round(sum(values) / len(values), 5) for name, values in raw.items()},
        "metrics_raw": {name: _encoded(values) for name, values in raw.items()},
        "metrics_sha256": _metrics_sha256(raw),
        "predictions_sha256": part.predictions_sha256,
        "ground_truth_sha256": part.truth_sha256,
        "evaluation_protocol": protocol,
    }


def write_nerfbaselines(output: Path, results: Sequence[Result]) -> list[Path]:
    """Write one file per result in their form, and return the files.

    In a folder, each is named by its method, scene, seed, protocol and key; a path ending in ``.json`` is the file of a
    single result.
    """
    if output.suffix == ".json" and not output.is_dir():
        if len(results) != 1:
            raise InputError(f"one file {output} for {len(results)} results", "a folder", "Name one with --output")
        files = [output]
    else:
        files = [output / f"{_name(result)}.json" for result in results]
    for file, result in zip(files, results, strict=True):
        write_json(file, nerfbaselines_result(result))
    return files


def _name(result: Result) -> str:
    parts = (result.method, result.scene.name, f"seed{result.seed}", result.protocol.name, result.key)
    return "_".join(parts).replace("/", "-")


def _cost(result: Result) -> dict[str, Any]:
    cost = result.cost
    values: dict[str, Any] = {}
    if cost.train_seconds is not None:
        values["total_train_time"] = round(cost.train_seconds, 5)
    if cost.peak_memory_mib is not None:
        memory = math.ceil(cost.peak_memory_mib)
        on_gpu = str(result.provenance.get("training", {}).get("device")).startswith("cuda")
        values["resources_utilization"] = (
            {"gpu_memory": memory, "gpu_name": cost.device} if on_gpu else {"memory": memory}
        )
    return values


def _encoded(values: Sequence[float]) -> str:
    """Base64 of the values as little-endian float32."""
    return base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode("ascii")


def _metrics_sha256(raw: Mapping[str, Sequence[float]]) -> str:
    """Their hash: of names and sorted values, in the order of the names."""
    sha = hashlib.sha256()
    for name in sorted(raw):
        sha.update(f"{name.lower()}{_encoded(sorted(raw[name]))}\n".encode())
    return sha.hexdigest()
