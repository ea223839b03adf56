"""The path that agrees best with all edges, by open3d's pose-graph optimisation.

Choi, Zhou and Koltun, "Robust reconstruction of indoor scenes" (CVPR 2015): edges that may be wrong carry a weight
that the optimiser may take from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from coliags_plugin.poses.rigid import inverse
from coliags_plugin.reconstruction.odometry.chain import Bridge
from coliags_plugin.reconstruction.odometry.registration import DEPTH_TRUNCATION, Edge

#: Information of a guess, against some 1e4 of an edge: it holds the graph together and gives way to anything.
_GUESSED = 1e-2

InformedEdge = tuple[Edge, Float[np.ndarray, "6 6"]]


def optimise(
    open3d: Any,
    placed: Sequence[int],
    camera_to_world: Float[np.ndarray, "P 4 4"],
    certain: Sequence[InformedEdge],
    uncertain: Sequence[InformedEdge],
    bridges: Sequence[Bridge],
    prune: float,
) -> tuple[Float[np.ndarray, "P 4 4"], tuple[Edge, ...]]:
    """Correct a path.

    Args:
        open3d: The library.
        placed: The frames of the path, in order.
        camera_to_world: Where they were found to be; world: the first of them. [P, 4, 4]
        certain: Edges between neighbours, with their information.
        uncertain: Edges of which some may be wrong.
        bridges: Guesses.
        prune: Weight below which an uncertain edge is dropped.

    Returns:
        The corrected path in the same world, and the uncertain edges that were dropped. [P, 4, 4]
    """
    registration = open3d.pipelines.registration
    place = {frame: index for index, frame in enumerate(placed)}
    graph = registration.PoseGraph()
    for pose in camera_to_world:
        graph.nodes.append(registration.PoseGraphNode(pose))

    def add(edge: Edge | Bridge, information: np.ndarray, doubted: bool) -> None:
        graph.edges.append(
            registration.PoseGraphEdge(
                place[edge.source], place[edge.target], edge.source_to_target, information, uncertain=doubted
            )
        )

    for edge, information in certain:
        add(edge, information, False)
    for bridge in bridges:
        add(bridge, _GUESSED * np.eye(6), False)
    for edge, information in uncertain:
        add(edge, information, True)
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
    poses = np.stack([np.asarray(node.pose) for node in graph.nodes])
    # open3d leaves out what it dropped.
    kept = {(edge.source_node_id, edge.target_node_id) for edge in graph.edges}
    dropped = tuple(edge for edge, _ in uncertain if (place[edge.source], place[edge.target]) not in kept)
    poses = inverse(poses[:1])[0] @ poses
    poses[0] = np.eye(4)
    return poses, dropped


def further_pairs(placed: Sequence[int], skips: Sequence[int]) -> list[tuple[int, int]]:
    """(source, target) of edges that span several frames, later frame first."""
    known = set(placed)
    return [(frame, frame - skip) for skip in sorted(set(skips)) for frame in placed if frame - skip in known]


def revisited_pairs(
    placed: Sequence[int],
    camera_to_world: Float[np.ndarray, "P 4 4"],
    apart: int,
    distance: float,
    angle_deg: float,
    every: int,
) -> list[tuple[int, int]]:
    """(source, target) of frames far apart in time that stand close together and look the same way.

    Args:
        placed: Frames with a pose, in order.
        camera_to_world: Their poses. [P, 4, 4]
        apart: Frames that have to lie between.
        distance: Largest distance of their centres.
        angle_deg: Largest angle between their optical axes, degrees.
        every: Look for one for every so-many-th frame: the nearest.
    """
    frames, centers, axes = np.asarray(placed), camera_to_world[:, :3, 3], camera_to_world[:, :3, 2]
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
