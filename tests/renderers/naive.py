"""Splatting by the book: every pixel, every Gaussian, one after the other. Shares no code with the package."""

from __future__ import annotations

import math

import torch

INPUTS = ("means", "quats_wxyz", "scales", "opacities", "colors")


class View:
    """View of one camera, composited front to back; float64 and differentiable throughout."""

    def __init__(self, gaussians, camera):
        means, self.quats, self.scales, self.opacities, self.colors = (
            getattr(gaussians, name).double() for name in INPUTS
        )
        pose, size = camera.camera_to_world.double(), (camera.height, camera.width)
        self.world_to_camera = torch.cat([pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3:]], dim=1)
        row, column = torch.meshgrid(*(torch.arange(n) + 0.5 for n in size), indexing="ij")
        self.pixels = torch.stack([column, row], dim=-1).double()
        self.focal = torch.tensor([camera.fx, camera.fy], dtype=torch.float64)
        self.principal = torch.tensor([camera.cx, camera.cy], dtype=torch.float64)
        homogeneous = torch.cat([means, torch.ones(len(means), 1, dtype=torch.float64)], dim=1)
        self.in_camera = homogeneous @ self.world_to_camera.T
        self.transmittance = torch.ones(size, dtype=torch.float64)
        self.running = torch.ones(size, dtype=torch.bool)
        zeros = torch.zeros(size, dtype=torch.float64)
        self.sums = dict.fromkeys(("alpha", "depth_accumulated", "inverse_depth_accumulated", "depth_median"), zeros)
        self.sums |= dict.fromkeys(("rgb", "normals"), zeros[..., None].expand(-1, -1, 3))
        self.centers = {}

    def nearest_first(self, near_plane):
        """Gaussians in front of the camera, their places and rotations in its axes; notes their projected centres."""
        for i in sorted(range(len(self.quats)), key=lambda i: self.in_camera[i, 2].item()):
            place = self.in_camera[i]
            if place[2].item() > near_plane:
                w, axis = (self.quats[i] / self.quats[i].norm()).split([1, 3])
                identity = torch.eye(3, dtype=torch.float64)
                skew = torch.linalg.cross(identity, axis.expand(3, 3))
                self.centers[i] = self.focal * place[:2] / place[2] + self.principal
                yield i, place, self.world_to_camera[:, :3] @ (identity + 2 * w * skew + 2 * skew @ skew)

    def add(self, i, power, z, normal):
        """Composite one Gaussian of a depth; its weights."""
        alpha = (self.opacities[i] * power.exp()).clamp(max=0.99)
        alpha = torch.where(alpha < 1 / 255, 0.0, alpha)
        behind = self.transmittance * (1 - alpha)
        self.running = self.running & (behind >= 1e-4)
        weight = torch.where(self.running, alpha * self.transmittance, 0.0)
        terms = {
            "rgb": weight[..., None] * self.colors[i],
            "alpha": weight,
            "depth_accumulated": weight * z,
            "inverse_depth_accumulated": weight / z,
            "normals": weight[..., None] * (-normal if (normal @ self.in_camera[i]).item() > 0 else normal),
            "depth_median": z * (self.running & (self.transmittance > 0.5) & (behind <= 0.5)),
        }
        self.sums = {name: self.sums[name] + terms[name] for name in self.sums}
        self.transmittance = torch.where(self.running, behind, self.transmittance)
        return weight

    def outputs(self, background):
        alpha, rest = self.sums["alpha"], self.transmittance[..., None]
        expected = torch.where(alpha > 0, self.sums["depth_accumulated"] / alpha.clamp_min(1e-300), 0.0)
        rgb = self.sums["rgb"] + rest * torch.tensor(background, dtype=torch.float64)
        return {**self.sums, "rgb": rgb, "depth_expected": expected}


def splat(gaussians, camera, background=(0.0, 0.0, 0.0), near_plane=0.2, eps2d=0.3, shifts=None):
    """All outputs of one view of 3D Gaussians, by name, and the projected centres; ``shifts`` moves these. [N, 2]"""
    view = View(gaussians, camera)
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    low, high = ((end - view.principal + side * size) / view.focal for end, side in ((0, -0.15), (size, 0.15)))
    for i, place, rotation in view.nearest_first(near_plane):
        slopes = (place[:2] / place[2]).maximum(low).minimum(high)
        jacobian = torch.cat([torch.diag(view.focal), -(view.focal * slopes)[:, None]], dim=1) / place[2]
        covariance = rotation @ torch.diag(view.scales[i] ** 2) @ rotation.T
        flat = jacobian @ covariance @ jacobian.T + eps2d * torch.eye(2, dtype=torch.float64)
        offset = view.pixels - view.centers[i] - (0.0 if shifts is None else shifts[i])
        power = -0.5 * torch.einsum("hwi,ij,hwj->hw", offset, torch.linalg.inv(flat), offset)
        view.add(i, power, place[2], rotation[:, int(view.scales[i].argmin())])
    return view.outputs(background), view.centers


def splat_surfels(
    gaussians, camera, background=(0.0, 0.0, 0.0), near_plane=0.2, surfel_filter=0.70710678, far=100.0, shifts=None
):
    """Naive rendering of surfels: every ray meets every disc by solving three equations.

    ``shifts`` moves the projected centres that the intersections, not the low-pass filter, depend on. [N, 2] The
    additional map ``farthest`` is the largest depth composited at a pixel.
    """
    view = View(gaussians, camera)
    rays = torch.nn.functional.pad((view.pixels - view.principal) / view.focal, (0, 1), value=1.0)
    farthest = distortion = torch.zeros_like(view.transmittance)
    composited = []
    for i, place, rotation in view.nearest_first(near_plane):
        first, second = rotation[:, 0] * view.scales[i, 0], rotation[:, 1] * view.scales[i, 1]
        center = view.centers[i]
        if torch.linalg.det(torch.stack([first, second, place], dim=1)) == 0:
            del view.centers[i]
            continue
        shifted = center if shifts is None else center + shifts[i]
        moved = torch.cat([(shifted - view.principal) / view.focal, place.new_ones(1)]) * place[2]
        # z r - u a - v b = p
        columns = [-first.expand_as(rays), -second.expand_as(rays), rays]
        solvable = torch.linalg.det(torch.stack(columns, dim=-1)) != 0
        columns[2] = torch.where(solvable[..., None], rays, torch.linalg.cross(first, second, dim=0))
        u, v, z = torch.linalg.solve(torch.stack(columns, dim=-1), moved.expand_as(rays)).unbind(-1)
        met = solvable & (z >= near_plane)
        z = torch.where(met, z, 1.0)
        squared = torch.minimum(u**2 + v**2, ((view.pixels - center) ** 2).sum(-1) / surfel_filter**2)
        weight = view.add(i, -0.5 * torch.where(met, squared, 1e4), z, rotation[:, 2])
        farthest = torch.maximum(farthest, torch.where(weight > 0, z, 0.0).detach())
        composited.append((weight, far / (far - near_plane) * (1 - near_plane / z)))
    if composited:
        weights, depths = (torch.stack(values) for values in zip(*composited, strict=True))
        for i in range(1, len(weights)):
            distortion = distortion + (weights[i] * weights[:i] * (depths[i] - depths[:i]).square()).sum(0)
    return {**view.outputs(background), "distortion": distortion, "farthest": farthest}, view.centers


def extent(opacity: float, variance: float) -> float:
    """Distance at which the alpha of an isotropic Gaussian falls to 1/255, pixels from its centre."""
    return math.sqrt(2 * math.log(255 * opacity) * variance)
