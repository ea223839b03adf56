"""Surfels by the book: every ray meets every disc by solving three equations. Shares no code with the package."""

from __future__ import annotations

import torch


def splat_surfels(
    gaussians, camera, background=(0.0, 0.0, 0.0), near_plane=0.2, surfel_filter=0.70710678, far=100.0, shifts=None
):
    """All outputs of one view, by name, and the projected centres; float64 and differentiable throughout.

    ``shifts`` moves the projected centres that the intersections, not the low-pass filter, depend on. [N, 2] The
    additional map ``farthest`` is the largest depth composited at a pixel.
    """
    means, quats, scales, opacities, colors = (
        getattr(gaussians, name).double() for name in ("means", "quats_wxyz", "scales", "opacities", "colors")
    )
    pose = camera.camera_to_world.double()
    world_to_camera = torch.cat([pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3:]], dim=1)
    height, width = camera.height, camera.width
    row, column = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([column, row], dim=-1).double()
    focal = torch.tensor([camera.fx, camera.fy], dtype=torch.float64)
    principal = torch.tensor([camera.cx, camera.cy], dtype=torch.float64)
    rays = torch.cat([(pixels - principal) / focal, torch.ones(height, width, 1, dtype=torch.float64)], dim=-1)
    transmittance = torch.ones(height, width, dtype=torch.float64)
    running = torch.ones(height, width, dtype=torch.bool)
    zeros = torch.zeros(height, width, dtype=torch.float64)
    sums = {name: zeros for name in ("alpha", "depth_accumulated", "inverse_depth_accumulated", "depth_median")}
    sums |= {name: zeros[..., None].expand(-1, -1, 3) for name in ("rgb", "normals")}
    farthest = zeros
    composited = []

    homogeneous = torch.cat([means, torch.ones(len(means), 1, dtype=torch.float64)], dim=1)
    in_camera = homogeneous @ world_to_camera.T
    centers = {}
    for i in sorted(range(len(means)), key=lambda i: in_camera[i, 2].item()):
        place = in_camera[i]
        if place[2].item() <= near_plane:
            continue
        w, axis = (quats[i] / quats[i].norm()).split([1, 3])
        identity = torch.eye(3, dtype=torch.float64)
        skew = torch.linalg.cross(identity, axis.expand(3, 3))
        rotation = world_to_camera[:, :3] @ (identity + 2 * w * skew + 2 * skew @ skew)
        first, second, normal = rotation[:, 0] * scales[i, 0], rotation[:, 1] * scales[i, 1], rotation[:, 2]
        if torch.linalg.det(torch.stack([first, second, place], dim=1)) == 0:
            continue
        center = focal * place[:2] / place[2] + principal
        centers[i] = center
        shifted = center if shifts is None else center + shifts[i]
        place = torch.cat([(shifted - principal) / focal, place.new_ones(1)]) * place[2]
        # z r - u a - v b = p
        columns = [-first.expand_as(rays), -second.expand_as(rays), rays]
        solvable = torch.linalg.det(torch.stack(columns, dim=-1)) != 0
        columns[2] = torch.where(solvable[..., None], rays, torch.linalg.cross(first, second, dim=0))
        u, v, z = torch.linalg.solve(torch.stack(columns, dim=-1), place.expand_as(rays)).unbind(-1)
        met = solvable & (z >= near_plane)
        z = torch.where(met, z, 1.0)
        squared = torch.minimum(u**2 + v**2, ((pixels - center) ** 2).sum(-1) / surfel_filter**2)
        alpha = (opacities[i] * torch.exp(-0.5 * torch.where(met, squared, 1e4))).clamp(max=0.99)
        alpha = torch.where(alpha < 1 / 255, 0.0, alpha)
        behind = transmittance * (1 - alpha)
        running = running & (behind >= 1e-4)
        weight = torch.where(running, alpha * transmittance, 0.0)
        normal = -normal if (normal @ in_camera[i]).item() > 0 else normal
        terms = {
            "rgb": weight[..., None] * colors[i],
            "alpha": weight,
            "depth_accumulated": weight * z,
            "inverse_depth_accumulated": weight / z,
            "normals": weight[..., None] * normal,
            "depth_median": z * (running & (transmittance > 0.5) & (behind <= 0.5)),
        }
        sums = {name: sums[name] + terms[name] for name in sums}
        farthest = torch.maximum(farthest, torch.where(weight > 0, z, 0.0).detach())
        composited.append((weight, far / (far - near_plane) * (1 - near_plane / z)))
        transmittance = torch.where(running, behind, transmittance)
    sums["rgb"] = sums["rgb"] + transmittance[..., None] * torch.tensor(background, dtype=torch.float64)
    alpha = sums["alpha"]
    sums["depth_expected"] = torch.where(alpha > 0, sums["depth_accumulated"] / alpha.clamp_min(1e-300), 0.0)
    distortion = zeros
    if composited:
        weights, depths = (torch.stack(values) for values in zip(*composited, strict=True))
        for i in range(1, len(weights)):
            distortion = distortion + (weights[i] * weights[:i] * (depths[i] - depths[:i]).square()).sum(0)
    return {**sums, "distortion": distortion, "farthest": farthest}, centers
