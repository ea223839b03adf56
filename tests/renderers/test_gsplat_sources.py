"""gsplat as it is installed, read and not imported: signatures, constants, and its own reference in PyTorch on a CPU.

Nothing here needs a GPU or compiles anything: `pip install --no-deps gsplat` is enough.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import re
import sys
import types
from pathlib import Path

import pytest
import torch

from coliags_plugin.renderers import gsplat_library
from coliags_plugin.renderers.gsplat_renderer import render_with_gsplat
from coliags_plugin.renderers.projection import project_gaussians
from coliags_plugin.renderers.torch_renderer import render_gaussians
from tests.renderers import fake_gsplat, test_gsplat_renderer
from tests.renderers.test_gsplat_renderer import check_within_the_table, single
from tests.renderers.test_torch_renderer import OUTPUTS, SCENES, make, pinhole, scene

calls, device = test_gsplat_renderer.calls, test_gsplat_renderer.device
FOUND = importlib.util.find_spec("gsplat")
pytestmark = pytest.mark.skipif(FOUND is None, reason="gsplat is not installed")
FOLDER = Path("." if FOUND is None else FOUND.submodule_search_locations[0])

#: What the package passes, in order, by the names that it means.
PASSED = {
    "fully_fused_projection": (
        *("means", "covars", "quats", "scales", "viewmats", "Ks", "width", "height"),
        *("eps2d", "near_plane", "opacities"),
    ),
    "isect_tiles": ("means2d", "radii", "depths", "tile_size", "tile_width", "tile_height"),
    "isect_offset_encode": ("isect_ids", "n_(images|cameras)", "tile_width", "tile_height"),
    "rasterize_to_pixels": (
        *("means2d", "conics", "colors", "opacities", "image_width", "image_height", "tile_size"),
        *("isect_offsets", "flatten_ids", "backgrounds"),
    ),
}
#: Defaults of options that are left alone.
LEFT = {
    "fully_fused_projection": {
        **{"far_plane": 1e10, "radius_clip": 0.0, "packed": False, "calc_compensations": False},
        "camera_model": "pinhole",
    },
    "isect_tiles": {"sort": True, "packed": False},
    "isect_offset_encode": {},
    "rasterize_to_pixels": {"masks": None, "packed": False, "absgrad": False},
}
#: Habits of the kernels that docs/rendering.md lists, as they are written in the sources.
WRITTEN = {
    "csrc/RasterizeToPixels3DGSFwd.cu": (
        r"min\(0\.999f, opac \* __expf\(-sigma\)\)",
        r"sigma < 0\.f \|\| alpha < ALPHA_THRESHOLD",
        r"if \(next_T <= 1e-4f\)",
        r"\+ 0\.5f",
    ),
    "csrc/RasterizeToPixels3DGSBwd.cu": (r"if \(opac \* vis <= 0\.999f\)",),
    "csrc/ProjectionEWA3DGSFused.cu": (
        r"mean_c\.z < near_plane \|\| mean_c\.z > far_plane",
        r"if \(det <= 0\.f\)",
        r"float extend = 3\.33f;",
        r"if \(opacity < ALPHA_THRESHOLD\)",
        r"extend = min\(extend, sqrt\(2\.0f \* __logf\(opacity / ALPHA_THRESHOLD\)\)\)",
        r"mean2d\.x \+ radius_x <= 0 \|\| mean2d\.x - radius_x >= image_width",
    ),
    "include/Common.h": (r"#define ALPHA_THRESHOLD \(1\.f / 255\.f\)",),
    "include/Utils.cuh": (
        r"float inv_norm = rsqrt\(x \* x \+ y \* y \+ z \* z \+ w \* w\)",
        r"float tan_fovx = 0\.5f \* width / fx;",
        r"\(width - cx\) / fx \+ 0\.3f \* tan_fovx",
    ),
    "_backend.py": ('"-use_fast_math"',),
}


def signature(name):
    """The signature of a function of gsplat, with its defaults."""
    module = ast.parse((FOLDER / "cuda" / "_wrapper.py").read_text())
    (found,) = (node for node in module.body if isinstance(node, ast.FunctionDef) and node.name == name)
    assert not (found.args.posonlyargs or found.args.vararg or found.args.kwonlyargs or found.args.kwarg)
    names = [argument.arg for argument in found.args.args]
    defaults = [inspect.Parameter.empty] * (len(names) - len(found.args.defaults))
    defaults += [ast.literal_eval(default) for default in found.args.defaults]
    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    return inspect.Signature([inspect.Parameter(n, kind, default=d) for n, d in zip(names, defaults, strict=True)])


@pytest.fixture(scope="module")
def reference():
    """gsplat's reference in PyTorch, of which compositing is given what it takes from CUDA and from nerfacc."""
    files = {"gsplat": FOLDER, "gsplat.cuda": FOLDER / "cuda"}
    stubs = {name: types.ModuleType(name) for name in ("gsplat", "gsplat.cuda", "gsplat.cuda._wrapper", "nerfacc")}
    for name, path in files.items():
        stubs[name].__path__ = [str(path)]
    stubs["gsplat.cuda._wrapper"].rasterize_to_indices_in_range = hits
    stubs["nerfacc"].render_weight_from_alpha = weights_of_alphas
    stubs["nerfacc"].accumulate_along_rays = sums_along_rays
    with pytest.MonkeyPatch.context() as patched:
        for name, stub in stubs.items():
            patched.setitem(sys.modules, name, stub)
        found = importlib.import_module("gsplat.cuda._torch_impl")
        del sys.modules["gsplat.cuda._torch_impl"]
        yield found


@torch.no_grad()
def hits(first, last, light, means2d, conics, opacities, width, height, tile_size, offsets, lists):
    """Pairs of Gaussian and pixel that the kernels composite, front to back: all of them in the first range."""
    assert first == 0 and (light == 1).all()
    starts = [*offsets.flatten().tolist(), len(lists)]
    gaussians, pixels = [], []
    for tile in range(offsets.numel()):
        row, column = divmod(tile, offsets.shape[-1])
        ids = lists[starts[tile] : starts[tile + 1]].long()
        across = torch.arange(column * tile_size, min((column + 1) * tile_size, width))
        down = torch.arange(row * tile_size, min((row + 1) * tile_size, height))
        place = (down[:, None] * width + across).flatten()
        centers = torch.stack([place % width, place // width], dim=1) + 0.5
        dx, dy = (centers - means2d[0, ids, None]).unbind(-1)
        a, b, c = conics[0, ids].unbind(-1)
        sigma = 0.5 * (a[:, None] * dx * dx + c[:, None] * dy * dy) + b[:, None] * dx * dy
        alpha = (opacities[0, ids, None] * (-sigma).exp()).clamp_max(0.999)
        alpha = torch.where((sigma < 0) | (alpha < 1 / 255), 0.0, alpha)
        kept = (alpha > 0) & ((1 - alpha).cumprod(0) > 1e-4)
        at, which = kept.T.nonzero().unbind(1)  # by pixel, and front to back
        gaussians.append(ids[which])
        pixels.append(place[at])
    return torch.cat(gaussians), torch.cat(pixels), torch.zeros(len(torch.cat(pixels)), dtype=torch.int64)


def weights_of_alphas(alphas, ray_indices, n_rays):
    """What each sample contributes, and the light that reaches it; samples are in order along their rays."""
    order = torch.argsort(ray_indices, stable=True)
    logs = torch.log1p(-alphas[order].double())
    before = logs.cumsum(0) - logs
    rays = ray_indices[order]
    first = torch.searchsorted(rays, rays)
    light = torch.exp(before - before[first]).to(alphas.dtype)[torch.argsort(order)]
    return alphas * light, light


def sums_along_rays(weights, values, ray_indices, n_rays):
    """Sums of weight times value by ray."""
    terms = weights[:, None] if values is None else weights[:, None] * values
    return terms.new_zeros(n_rays, terms.shape[1]).index_add(0, ray_indices, terms)


def projected(reference, gaussians, camera, **options):
    """What gsplat's reference projects, of float64 Gaussians."""
    covars, _ = reference._quat_scale_to_covar_preci(gaussians.quats_wxyz, gaussians.scales, compute_preci=False)
    view, matrix = camera.world_to_camera[None], camera.intrinsics_matrix[None]
    size = (camera.width, camera.height)
    return reference._fully_fused_projection(gaussians.means, covars, view, matrix, *size, **options)


# --- as it is called --------------------------------------------------------------------------------------------------


def test_every_argument_is_there_with_its_meaning(calls):
    render_with_gsplat(*single("random"), OUTPUTS)
    assert {name for name, _, _ in calls} == set(PASSED)
    exported = {
        alias.name
        for node in ast.parse((FOLDER / "__init__.py").read_text()).body
        if isinstance(node, ast.ImportFrom) and node.module == "cuda._wrapper"
        for alias in node.names
    }
    assert set(PASSED) <= exported
    for name, args, kwargs in calls:
        of_gsplat = signature(name)
        given = of_gsplat.bind(*args, **kwargs).arguments
        assert len(given) == len(PASSED[name])
        for found, meant in zip(given, PASSED[name], strict=True):
            assert re.fullmatch(meant, found), (name, found, meant)
        for option, value in LEFT[name].items():
            assert of_gsplat.parameters[option].default == value, (name, option)


@pytest.mark.parametrize("file", WRITTEN)
def test_the_kernels_are_written_as_documented(file):
    text = " ".join((FOLDER / "cuda" / file).read_text().split())
    for pattern in WRITTEN[file]:
        assert re.search(pattern, text), pattern


def test_the_version_is_accepted_and_has_what_it_is_compiled_from():
    version = re.search(r'"(.*)"', (FOLDER / "version.py").read_text())[1]
    assert gsplat_library._release(version) >= gsplat_library.OLDEST
    if any(list(FOLDER.glob(f"csrc*.{ending}")) for ending in ("so", "pyd")):
        return  # compiled beforehand
    needed = ("ext.cpp", "csrc/third_party/glm/glm/glm.hpp")
    missing = [name for name in needed if not (FOLDER / "cuda" / name).is_file()]
    assert not missing, f"gsplat {version} cannot compile its kernels: {missing}"


# --- its reference ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
def test_its_reference_projects_as_the_definition(reference, name):
    gaussians, camera = scene(name)
    radii, means2d, depths, conics, _ = projected(reference, gaussians, camera, near_plane=camera.near_plane)
    ours = project_gaussians(gaussians, camera, 0.3)
    front = ours.in_front
    assert front.any()
    torch.testing.assert_close(means2d[0][front], ours.means2d[front], rtol=1e-11, atol=1e-9)
    torch.testing.assert_close(depths[0][front], ours.depths[front], rtol=1e-12, atol=1e-12)
    u_xx, u_yx, u_yy = ours.whitenings[front].unbind(-1)
    inverses = torch.stack([u_xx**2 + u_yx**2, u_yx * u_yy, u_yy**2], dim=-1)
    scale = conics[0][front].abs().amax(-1, keepdim=True)  # of needles, by a determinant that cancels
    torch.testing.assert_close(conics[0][front] / scale, inverses / scale, rtol=0, atol=1e-7)
    # Gaussians are at most 3.33 deviations large; whatever is drawn is visible.
    xx, yy = ours.covariances[front][:, 0], ours.covariances[front][:, 2]
    visible = (radii[0] > 0).all(-1)
    reach = (3.33 * torch.stack([xx, yy], dim=-1).sqrt()).ceil().int()
    assert torch.equal(radii[0][front], torch.where(visible[front, None], reach, 0))
    assert not visible[~front].any()
    drawn = render_gaussians(gaussians, camera).splats.radii > 0
    assert visible[drawn].all()


@pytest.mark.parametrize("name", SCENES)
def test_the_stand_in_is_its_reference(reference, name):
    gaussians, camera = single(name)
    wide = (gaussians.means.double(), gaussians.quats_wxyz.double(), gaussians.scales.double())
    view, matrix = camera.world_to_camera[None], camera.intrinsics_matrix[None]
    size = (camera.width, camera.height)
    covars, _ = reference._quat_scale_to_covar_preci(*wide[1:], compute_preci=False)
    theirs = reference._fully_fused_projection(wide[0], covars, view.double(), matrix.double(), *size, near_plane=0.1)
    ours = fake_gsplat.fully_fused_projection(
        gaussians.means, None, gaussians.quats_wxyz, gaussians.scales, view, matrix, *size, near_plane=0.1
    )
    assert torch.equal(ours[0], theirs[0])
    drawn = (ours[0] > 0).all(-1)
    for found, expected in zip(ours[1:4], theirs[1:4], strict=True):
        torch.testing.assert_close(found[drawn].double(), expected[drawn], rtol=1e-6, atol=1e-6)
    tiles = (16, -(-camera.width // 16), -(-camera.height // 16))
    given = (torch.where(drawn[..., None], ours[1], 0.0), ours[0], torch.where(drawn, ours[2], 1.0))
    found, expected = fake_gsplat.isect_tiles(*given, *tiles), reference._isect_tiles(*given, *tiles)
    assert torch.equal(found[0], expected[0])
    offsets = fake_gsplat.isect_offset_encode(found[1], 1, *tiles[1:])
    assert torch.equal(offsets, reference._isect_offset_encode(expected[1], 1, *tiles[1:]))
    assert torch.equal(found[1], expected[1]) and torch.equal(found[2].sort()[0], expected[2].sort()[0])


@pytest.fixture
def by_reference(reference, device, monkeypatch):
    """The renderer draws by gsplat's reference."""
    library = fake_gsplat.module()

    def project(means, covars, quats, scales, view, matrix, width, height, eps2d=0.3, near_plane=0.01, opacities=None):
        covars, _ = reference._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        return reference._fully_fused_projection(means, covars, view, matrix, width, height, eps2d, near_plane)

    library.fully_fused_projection = project
    library.isect_tiles = reference._isect_tiles
    library.isect_offset_encode = reference._isect_offset_encode

    def rasterize(*args, backgrounds=None):
        return reference._rasterize_to_pixels(*args, backgrounds=backgrounds, batch_per_iter=10**6)

    library.rasterize_to_pixels = rasterize
    monkeypatch.setitem(sys.modules, "gsplat", library)


@pytest.mark.parametrize("name", SCENES)
def test_its_reference_draws_the_definition(by_reference, name):
    check_within_the_table(name, "cpu", radii=False)  # it knows nothing of opacities


def test_near_and_far_in_its_reference(reference):
    gaussians, camera = make([[0, 0, 2.0], [0, 0, 2.5], [0, 0, 9.0]], 0.2, 0.9), pinhole()
    radii, *_ = projected(reference, gaussians, camera, near_plane=2.0, far_plane=9.0)
    assert (radii[0] > 0).all(-1).tolist() == [False, True, False]  # the kernels draw what is exactly at these
