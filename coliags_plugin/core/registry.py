"""Registries of components by name.

One :class:`Registry` per kind. Built-ins are ``"name": "module:Class"`` strings, so listing them imports
nothing. Other packages add components through entry points in the group ``coliags_plugin.<kind>``; uninstalled
work does so through ``COLIAGS_PLUGIN_PATH``, a path list of Python files that each define
``COMPONENTS = {"<kind>": {"<name>": Class or "module:Class"}}``, or by :func:`register`, in one process alone.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from runpy import run_path
from types import ModuleType
from typing import Any

from coliags_plugin.core.errors import InputError, check_name

PLUGIN_PATH_VARIABLE = "COLIAGS_PLUGIN_PATH"
#: Source of components that a process registers (:func:`register`).
REGISTERED = "coliags_plugin.register"


class Resolver:
    """The component that the name ``auto`` stands for; its options, ``"module:Class"``, are common to all."""

    def __init__(self, options: str, description: str) -> None:
        self._options = options
        self.__doc__ = description

    @property
    def Settings(self) -> Any:
        """The class of the options, imported on first use."""
        return _load(self._options)


class Registry:
    """The components of one kind, a plural noun such as ``"renderers"``; the singular ``noun`` is for errors.

    Built-ins are resolvers, or ``"module:Class"``.
    """

    def __init__(self, kind: str, builtins: Mapping[str, object], noun: str) -> None:
        self.kind = kind
        self.noun = noun
        self._targets: dict[str, object] = {}
        self._sources: dict[str, str] = {}
        self._files: dict[str, str] = {}  # of COLIAGS_PLUGIN_PATH
        self._complete = False
        for name, target in builtins.items():
            self.register(name, target, source="built in")

    def register(self, name: str, target: object, source: str = REGISTERED) -> None:
        """Add one component: a class, an object, or ``"module:Class"`` to import when first asked for.

        The source is for listings and errors. InputError where the name is taken, unless a class is registered again.
        """
        is_again = self._sources.get(name) == source == REGISTERED and _path(self._targets[name]) == _path(target)
        if name in self._targets and not is_again:
            raise InputError(
                f"{self.kind}: '{name}' from {source} is already taken by {self._sources[name]}",
                "one component per name",
                "Rename one of the two",
            )
        self._targets[name] = target
        self._sources[name] = source

    def names(self) -> list[str]:
        """All known names, sorted."""
        self._discover()
        return sorted(self._targets)

    def source(self, name: str) -> str:
        """Origin of the component of this name: this package, or the plugin that registers it."""
        self._discover()
        return self._sources[name]

    def origin(self, name: str) -> dict[str, str]:
        """Class and source of a component, and its file with a hash where it has one, for the record of a run."""
        target = self.get(name)
        kind = target if isinstance(target, type) else type(target)
        origin = {"class": _path(kind), "source": PLUGIN_PATH_VARIABLE if name in self._files else self._sources[name]}
        file = self._files.get(name) or getattr(sys.modules.get(kind.__module__), "__file__", None)
        if file is not None:
            origin |= {"file": Path(file).name, "sha256": hashlib.sha256(Path(file).read_bytes()).hexdigest()}
        return origin

    def get(self, name: str) -> Any:
        """The component of a name, imported on first use."""
        self._discover()
        check_name(self.noun, name, self.names())
        target = self._targets[name]
        if isinstance(target, str):
            try:
                target = self._targets[name] = _load(target)
            except (ImportError, AttributeError, ValueError) as error:
                if self._sources[name] == "built in":
                    raise
                raise InputError(
                    f"{self.noun} '{name}' from {self._sources[name]} cannot be imported: {error}",
                    "module:Class",
                    "Correct it, or uninstall the package",
                ) from error
        return target

    def __iter__(self) -> Iterator[str]:
        return iter(self.names())

    def _discover(self) -> None:
        if self._complete:
            return
        self._complete = True
        for entry in installed(f"coliags_plugin.{self.kind}"):
            package = f" of {entry.dist.name} {entry.dist.version}" if entry.dist else ""
            self.register(entry.name, entry.value, source=f"entry point {entry.value}{package}")
        for path, components in _plugin_files(os.environ.get(PLUGIN_PATH_VARIABLE, "")).items():
            for name, target in components.get(self.kind, {}).items():
                self.register(name, target, source=path)
                self._files[name] = path


@cache
def _entry_points() -> Any:
    """Entry points of all installed packages; finding them reads a file of each package."""
    return entry_points()


def installed(group: str) -> tuple[EntryPoint, ...]:
    """Entry points of a group. They are read once per process: packages installed after that are not seen."""
    return tuple(_entry_points().select(group=group))


def _path(target: object) -> str:
    """``module:Class`` of a class, or of the name of one."""
    return f"{target.__module__}:{target.__qualname__}" if isinstance(target, type) else str(target)


def _load(target: str) -> Any:
    module, _, attribute = target.partition(":")
    return getattr(import_module(module), attribute)


@cache
def _plugin_files(path_list: str) -> dict[str, dict[str, dict[str, object]]]:
    files: dict[str, dict[str, dict[str, object]]] = {}
    for path in map(os.path.abspath, map(os.path.expanduser, filter(None, path_list.split(os.pathsep)))):
        if not Path(path).is_file():
            raise InputError(
                f"{PLUGIN_PATH_VARIABLE} names '{path}', which is not a file",
                "a path list of Python files",
                f"Correct or unset {PLUGIN_PATH_VARIABLE}",
            )
        # A module, in which annotations and the source of classes are found.
        module = ModuleType(f"{PLUGIN_PATH_VARIABLE}.{Path(path).stem}")
        vars(module).update(run_path(path, run_name=module.__name__))
        sys.modules[module.__name__] = module
        components: Any = vars(module).get("COMPONENTS")
        is_mapping = isinstance(components, dict) and components.keys() <= REGISTRIES.keys()
        if not is_mapping or not all(isinstance(named, dict) for named in components.values()):
            raise InputError(
                f"{path} defines COMPONENTS = {components!r}",
                f"{{kind: {{name: class}}}}, the kinds being {', '.join(REGISTRIES)}",
            )
        files[path] = components
    return files


#: Built-in components by kind and noun.
_BUILT_INS: dict[tuple[str, str], dict[str, object]] = {
    ("datamanagers", "data manager"): {
        "auto": Resolver(
            "coliags_plugin.datamanagers.recorded:SceneSettings",
            "Reader of any scene, by the one data manager that recognises its folder (docs/data.md 1).",
        ),
        "c3vd": "coliags_plugin.datamanagers.c3vd:C3VDDataManager",
        "c3vd-endogslam": "coliags_plugin.datamanagers.c3vd_endogslam:C3VDEndoGSLAMDataManager",
        "c3vd-v2": "coliags_plugin.datamanagers.c3vd:C3VDv2DataManager",
        "colmap": "coliags_plugin.datamanagers.colmap:ColmapDataManager",
        "endomapper": "coliags_plugin.datamanagers.rgbd:EndoMapperDataManager",
        "nerfstudio": "coliags_plugin.datamanagers.nerfstudio:NerfstudioDataManager",
        "reim-nerf": "coliags_plugin.datamanagers.reim_nerf:ReimNerfDataManager",
        "rgbd": "coliags_plugin.datamanagers.rgbd:RGBDDataManager",
        "rotatecolon": "coliags_plugin.datamanagers.rotatecolon:RotateColonDataManager",
    },
    ("fields", "field"): {
        "anchors": "coliags_plugin.fields.anchors:AnchorField",
        "gaussians": "coliags_plugin.fields.explicit_gaussians:ExplicitGaussians",
        "lit-gaussians": "coliags_plugin.fields.lit_gaussians:LitGaussians",
        "surfels": "coliags_plugin.fields.explicit_gaussians:Surfels",
        "reim-nerf": "coliags_plugin.fields.reim_nerf:ReimNerf",
    },
    ("geometry_heads", "geometry head"): {
        "plain": "coliags_plugin.fields.heads:PlainGeometryHead",
        "imve": "coliags_plugin.fields.heads:IMVEGeometryHead",
    },
    ("appearance_heads", "appearance head"): {
        "plain": "coliags_plugin.fields.heads:PlainAppearanceHead",
        "imia": "coliags_plugin.fields.heads:IMIAAppearanceHead",
        "imia-glints": "coliags_plugin.fields.heads:GlintAppearanceHead",
        "attenuated": "coliags_plugin.fields.attenuation:AttenuatedAppearanceHead",
    },
    ("renderers", "renderer"): {
        "auto": Resolver(
            "coliags_plugin.renderers.splatting:AutoSettings",
            "First renderer of ``prefer`` that can render the field; a run records which it is and why.",
        ),
        "cpu": "coliags_plugin.renderers.cpu_renderer:CpuRenderer",
        "torch": "coliags_plugin.renderers.torch_renderer:TorchRenderer",
        "triton": "coliags_plugin.renderers.triton_renderer:TritonRenderer",
        "volume": "coliags_plugin.renderers.volume_renderer:VolumeRenderer",
    },
    ("modules", "view module"): {
        "gain": "coliags_plugin.modules.exposure:FrameGain",
        "response": "coliags_plugin.modules.exposure:CameraResponse",
        "pose-correction": "coliags_plugin.modules.motion:PoseCorrection",
        "image-warp": "coliags_plugin.modules.motion:ImageWarp",
    },
    ("samplers", "sampler"): {
        "frames": "coliags_plugin.engine.samplers:FrameSampler",
        "pixels": "coliags_plugin.engine.samplers:PixelSampler",
    },
    ("strategies", "strategy"): {
        "adaptive-density": "coliags_plugin.strategies.densification:AdaptiveDensity",
        "none": "coliags_plugin.strategies.densification:NoStrategy",
        "anchor-growth": "coliags_plugin.strategies.densification:AnchorGrowth",
    },
    ("losses", "loss"): {
        "l1": "coliags_plugin.losses.target:L1Loss",
        "d-ssim": "coliags_plugin.losses.target:DSSIMLoss",
        "mse": "coliags_plugin.losses.target:MSELoss",
        "depth-l1": "coliags_plugin.losses.target:DepthL1Loss",
        "anisotropy": "coliags_plugin.losses.regularization:AnisotropyLoss",
        "attribute-variance": "coliags_plugin.losses.regularization:AttributeVarianceLoss",
        "diffuse-factor": "coliags_plugin.losses.regularization:DiffuseFactorLoss",
        "depth-huber": "coliags_plugin.losses.target:DepthHuberLoss",
        "opacity": "coliags_plugin.losses.regularization:OpacityLoss",
        "distance-l1": "coliags_plugin.losses.target:DistanceL1Loss",
        "scene-depth": "coliags_plugin.losses.target:SceneDepthLoss",
        "smooth-gain": "coliags_plugin.losses.regularization:SmoothGainLoss",
        "scale-volume": "coliags_plugin.losses.regularization:ScaleVolumeLoss",
        "surface-normals": "coliags_plugin.losses.regularization:SurfaceNormalsLoss",
        "normal-consistency": "coliags_plugin.losses.regularization:NormalConsistencyLoss",
        "distortion": "coliags_plugin.losses.regularization:DistortionLoss",
    },
    ("loggers", "logger"): {
        "tensorboard": "coliags_plugin.engine.loggers:TensorBoardLogger",
        "wandb": "coliags_plugin.engine.loggers:WandbLogger",
    },
    ("metrics", "metric"): {
        "psnr": "coliags_plugin.metrics.pixels:PSNR",
        "psnr_gain_fitted": "coliags_plugin.metrics.pixels:GainFittedPSNR",
        "ssim": "coliags_plugin.metrics.pixels:SSIM",
        "lpips": "coliags_plugin.metrics.lpips:LPIPS",
        "depth_mse": "coliags_plugin.metrics.pixels:DepthMSE",
        "depth_mse_inner": "coliags_plugin.metrics.pixels:DepthMSEInner",
        "depth_rmse": "coliags_plugin.metrics.pixels:DepthRMSE",
        "depth_mae": "coliags_plugin.metrics.pixels:DepthMAE",
        "depth_median_error": "coliags_plugin.metrics.pixels:DepthMedianError",
        "sparse_depth": "coliags_plugin.metrics.pixels:SparseDepthError",
        "depth_abs_rel": "coliags_plugin.metrics.pixels:DepthAbsRel",
    },
    ("protocols", "protocol"): {
        "paper": "coliags_plugin.metrics.protocols:PaperProtocol",
        "expected-depth": "coliags_plugin.metrics.protocols:ExpectedDepthProtocol",
        "median-depth": "coliags_plugin.metrics.protocols:MedianDepthProtocol",
        "authors-code": "coliags_plugin.metrics.protocols:AuthorsCodeProtocol",
    },
    ("pose_formats", "pose format"): {
        "c3vd": "coliags_plugin.geometry.poses.c3vd:FORMAT",
        "colmap": "coliags_plugin.geometry.poses.colmap:FORMAT",
        "colmap-text": "coliags_plugin.geometry.poses.colmap:TEXT_FORMAT",
        "endogslam": "coliags_plugin.geometry.poses.endogslam:FORMAT",
        "endogslam-truth": "coliags_plugin.geometry.poses.endogslam:TRUTH_FORMAT",
        "nerfstudio": "coliags_plugin.geometry.poses.nerfstudio:FORMAT",
        "tum": "coliags_plugin.geometry.poses.tum:FORMAT",
    },
    ("phantom_layouts", "phantom layout"): {
        "c3vd": "coliags_plugin.phantom.layouts:C3VDLayout",
        "colmap": "coliags_plugin.phantom.layouts:ColmapLayout",
        "nerfstudio": "coliags_plugin.phantom.layouts:NerfstudioLayout",
        "rgbd": "coliags_plugin.phantom.layouts:RGBDLayout",
    },
}
#: All kinds by their names.
REGISTRIES = {kind: Registry(kind, targets, noun) for (kind, noun), targets in _BUILT_INS.items()}
datamanagers = REGISTRIES["datamanagers"]
fields = REGISTRIES["fields"]
renderers = REGISTRIES["renderers"]
modules = REGISTRIES["modules"]
samplers = REGISTRIES["samplers"]
strategies = REGISTRIES["strategies"]
losses = REGISTRIES["losses"]
loggers = REGISTRIES["loggers"]
metrics = REGISTRIES["metrics"]
protocols = REGISTRIES["protocols"]
pose_formats = REGISTRIES["pose_formats"]
phantom_layouts = REGISTRIES["phantom_layouts"]


def register(kind: str, name: str, target: object) -> None:
    """Add a component to this process, for notebooks and scripts: ``register("losses", "edges", EdgesLoss)``.

    Worker processes do not see it: for comparisons, name its file in ``COLIAGS_PLUGIN_PATH``.

    Args:
        kind: A plural noun, as ``coliags list`` prints them.
        name: The component's name in method configs; a class that is defined again replaces itself.
        target: A class that implements the kind's base class, or ``"module:Class"``.

    Raises:
        InputError: There is no such kind, or the name is taken by another component.
    """
    check_name("kind", kind, REGISTRIES)
    REGISTRIES[kind].names()  # which its name must differ from
    REGISTRIES[kind].register(name, target)
