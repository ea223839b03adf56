"""Pose-graph optimisation by open3d, and selection of frame pairs for its edges.

Choi, Zhou and Koltun, "Robust reconstruction of indoor scenes" (CVPR 2015): uncertain edges have line-process weights,
by which the optimiser disables outliers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from coliags_plugin.geometry.poses.rigid import inverse
from coliags_plugin.reconstruction.odometry.chain import Bridge
from coliags_plugin.reconstruction.odometry.registration import DEPTH_TRUNCATION, Edge

#: Information of a bridge, small against some 1e4 of an edge: it only keeps the graph connected.
_BRIDGE_INFORMATION = 1e-2

InformedEdge = tuple[Edge, Float[np.ndarray, "6 6"]]


def optimise(
    open3d: Any,
    posed: Sequence[int],
    camera_to_world: Float[np.ndarray, "P 4 4"],
    certain: Sequence[InformedEdge],
    uncertain: Sequence[InformedEdge],
    bridges: Sequence[Bridge],
    prune: float,
) -> tuple[Float[np.ndarray, "P 4 4"], tuple[Edge, ...]]:
    """Optimise a pose graph; the poses in the world of the first, and the uncertain edges that were dropped.

    Edges come with their information matrices; an uncertain one of a weight below ``prune`` is dropped as an outlier.
    """
    registration = open3d.pipelines.registration
    node = {frame: index for index, frame in enumerate(posed)}
    graph = registration.PoseGraph()
    for pose in camera_to_world:
        graph.nodes.append(registration.PoseGraphNode(pose))

    links: list[tuple[Edge | Bridge, np.ndarray, bool]] = [(*informed, False) for informed in certain]
    links += [(bridge, _BRIDGE_INFORMATION * np.eye(6), False) for bridge in bridges]
    links += [(*informed, True) for informed in uncertain]
    for link, information, is_uncertain in links:
        ends, motion = (node[link.source], node[link.target]), link.source_to_target
        graph.edges.append(registration.PoseGraphEdge(*ends, motion, information, uncertain=is_uncertain))
    registration.global_optimization(
        graph,
        registration.GlobalOptimizationLevenbergMarquardt(),
        registration.GlobalOptimizationConvergenceCriteria(),
        registration.GlobalOptimizationOption(
            max_correspondence_distance=DEPTH_TRUNCATION,
            edge_prune_threshold=prune,
            preference_loop_closure=1.0,
            reference_node=0,
        ),
    )
    poses = np.stack([np.asarray(entry.pose) for entry in graph.nodes])
    # open3d removes dropped edges from the graph.
    kept = {(edge.source_node_id, edge.target_node_id) for edge in graph.edges}
    dropped = tuple(edge for edge, _ in uncertain if (node[edge.source], node[edge.target]) not in kept)
    poses = inverse(poses[:1])[0] @ poses
    poses[0] = np.eye(4)
    return poses, dropped


def skip_pairs(posed: Sequence[int], skips: Sequence[int]) -> list[tuple[int, int]]:
    """Frame pairs (source, target) a fixed number of frames apart, later frame first."""
    known = set(posed)
    return [(frame, frame - skip) for skip in sorted(set(skips)) for frame in posed if frame - skip in known]


def revisit_pairs(
    posed: Sequence[int],
    camera_to_world: Float[np.ndarray, "P 4 4"],
    apart: int,
    distance: float,
    angle_deg: float,
    every: int,
) -> list[tuple[int, int]]:
    """Loop-closure candidates (source, target): frames far apart in time with similar poses.

    Every ``every``-th frame is paired with its nearest candidate among those more than ``apart`` frames earlier, whose
    centre is within ``distance`` and whose optical axis within ``angle_deg`` degrees.
    """
    frames, centers, axes = np.asarray(posed), camera_to_world[:, :3, 3], camera_to_world[:, :3, 2]
    pairs = []
    for index in range(0, len(frames), every):
        earlier = np.flatnonzero(frames[index] - frames > apart)
        away = np.linalg.norm(centers[earlier] - centers[index], axis=1) / distance
        cosine = np.clip(axes[earlier] @ axes[index], -1.0, 1.0)
        turned = np.rad2deg(np.arccos(cosine)) / angle_deg
        score = np.maximum(away, turned)
        if len(score) and score.min() < 1.0:
            pairs.append((int(frames[index]), int(frames[earlier[int(np.argmin(score))]])))
    return pairs
