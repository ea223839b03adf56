"""Splatting by the book: every pixel, every Gaussian, one after the other. Shares no code with the package."""

from __future__ import annotations

import math

import torch


def splat(gaussians, camera, background=(0.0, 0.0, 0.0), near_plane=0.2, eps2d=0.3):
    """All outputs of one view, by name, and the projected centres; float64 and differentiable throughout."""
    means, quats, scales, opacities, colors = (
        getattr(gaussians, name).double() for name in ("means", "quats_wxyz", "scales", "opacities", "colors")
    )
    pose = camera.camera_to_world.double()
    world_to_camera = torch.cat([pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3:]], dim=1)
    height, width = camera.height, camera.width
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([u, v], dim=-1).double()
    transmittance = torch.ones(height, width, dtype=torch.float64)
    running = torch.ones(height, width, dtype=torch.bool)
    sums = {"rgb": 0, "alpha": 0, "depth_accumulated": 0, "inverse_depth_accumulated": 0, "normals": 0}
    sums = {name: torch.zeros(height, width, dtype=torch.float64) for name in sums}
    sums["rgb"] = torch.zeros(height, width, 3, dtype=torch.float64)
    sums["normals"] = torch.zeros(height, width, 3, dtype=torch.float64)
    median = torch.zeros(height, width, dtype=torch.float64)

    homogeneous = torch.cat([means, torch.ones(len(means), 1, dtype=torch.float64)], dim=1)
    in_camera = homogeneous @ world_to_camera.T
    order = sorted(range(len(means)), key=lambda i: in_camera[i, 2].item())
    centers = {}
    for i in order:
        x, y, z = in_camera[i]
        if z.item() <= near_plane:
            continue
        w, axis = (quats[i] / quats[i].norm()).split([1, 3])
        zero = torch.zeros((), dtype=torch.float64)
        cross = torch.stack(
            [
                torch.stack([zero, -axis[2], axis[1]]),
                torch.stack([axis[2], zero, -axis[0]]),
                torch.stack([-axis[1], axis[0], zero]),
            ]
        )
        rotation = torch.eye(3, dtype=torch.float64) + 2 * w * cross + 2 * cross @ cross
        left = (0 - camera.cx) / camera.fx - 0.15 * width / camera.fx
        right = (width - camera.cx) / camera.fx + 0.15 * width / camera.fx
        top = (0 - camera.cy) / camera.fy - 0.15 * height / camera.fy
        bottom = (height - camera.cy) / camera.fy + 0.15 * height / camera.fy
        slope_x, slope_y = (x / z).clamp(left, right), (y / z).clamp(top, bottom)
        jacobian = torch.stack(
            [
                torch.stack([camera.fx / z, zero, -camera.fx * slope_x / z]),
                torch.stack([zero, camera.fy / z, -camera.fy * slope_y / z]),
            ]
        )
        covariance = rotation @ torch.diag(scales[i] ** 2) @ rotation.T
        linear = jacobian @ world_to_camera[:, :3]
        flat = linear @ covariance @ linear.T + eps2d * torch.eye(2, dtype=torch.float64)
        centers[i] = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
        offset = pixels - centers[i]
        power = -0.5 * torch.einsum("hwi,ij,hwj->hw", offset, torch.linalg.inv(flat), offset)
        alpha = (opacities[i] * power.exp()).clamp(max=0.99)
        alpha = torch.where(alpha < 1 / 255, torch.zeros_like(alpha), alpha)
        behind = transmittance * (1 - alpha)
        running = running & (behind >= 1e-4)
        weight = torch.where(running, alpha * transmittance, torch.zeros_like(alpha))
        normal = world_to_camera[:, :3] @ rotation[:, int(scales[i].argmin())]
        if (normal @ in_camera[i]).item() > 0:
            normal = -normal
        sums["rgb"] = sums["rgb"] + weight[..., None] * colors[i]
        sums["alpha"] = sums["alpha"] + weight
        sums["depth_accumulated"] = sums["depth_accumulated"] + weight * z
        sums["inverse_depth_accumulated"] = sums["inverse_depth_accumulated"] + weight / z
        sums["normals"] = sums["normals"] + weight[..., None] * normal
        median = torch.where(running & (transmittance > 0.5) & (behind <= 0.5), z.detach(), median)
        transmittance = torch.where(running, behind, transmittance)
    sums["rgb"] = sums["rgb"] + transmittance[..., None] * torch.tensor(background, dtype=torch.float64)
    alpha = sums["alpha"]
    sums["depth_expected"] = torch.where(alpha > 0, sums["depth_accumulated"] / alpha.clamp_min(1e-300), alpha * 0)
    sums["depth_median"] = median
    return sums, centers


def extent(opacity: float, variance: float) -> float:
    """Where the alpha of an isotropic Gaussian falls to 1/255, pixels from its centre."""
    return math.sqrt(2 * math.log(255 * opacity) * variance)
