"""Random clouds of Gaussians."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from coliags_plugin.export.splats.cloud import SplatCloud

PARTS = ("means", "quats_wxyz", "scales", "opacities", "harmonics")


def random_cloud(count: int = 50, degree: int = 3, scales: int = 3, seed: int = 0) -> SplatCloud:
    """Gaussians within 50 units of (20, -30, 60), of 0.05 to 2 units, with unit quaternions and colours about 0.5."""
    random = np.random.default_rng(seed)
    quats = random.normal(size=(count, 4))
    values = {
        "means": random.uniform(-50, 50, (count, 3)) + np.array([20.0, -30.0, 60.0]),
        "quats_wxyz": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": np.exp(random.uniform(-3, 0.7, (count, scales))),
        "opacities": random.uniform(0.02, 0.98, count),
        "harmonics": random.normal(0, 0.2, (count, (degree + 1) ** 2, 3)),
    }
    return SplatCloud(**{name: value.astype(np.float32) for name, value in values.items()})


def covariances(cloud: SplatCloud) -> np.ndarray:
    """Covariance of each Gaussian. [N, 3, 3]"""
    rotations = Rotation.from_quat(cloud.quats_wxyz, scalar_first=True).as_matrix()
    stretched = rotations * cloud.scales[:, None].astype(np.float64)
    return stretched @ stretched.transpose(0, 2, 1)


def read_glb(path: Path) -> tuple[dict, dict[str, np.ndarray], dict]:
    """The document of a GLB file, the attributes of its one primitive, and its extension of Gaussians."""
    data = path.read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    document, body = json.loads(data[20 : 20 + size]), data[28 + size :]
    (primitive,) = document["meshes"][0]["primitives"]
    values = {}
    for name, index in primitive["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        rows = np.frombuffer(body, kind, accessor["count"] * width, view["byteOffset"])
        assert view["byteLength"] == rows.nbytes
        values[name] = rows.reshape(-1, width)
    return document, values, primitive["extensions"]["KHR_gaussian_splatting"]
