import platform
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coliags_plugin.core import registry
from coliags_plugin.core.errors import UnavailableError
from coliags_plugin.core.render_output import OUTPUTS
from coliags_plugin.metrics.protocols import through_8_bit, through_16_bit
from tests.losses.terms import make_output
from tests.metrics.made import make
from tests.scenes import plain_frame as make_frame

HEIGHT, WIDTH = 12, 15
NAMES = ["paper", "expected-depth", "median-depth", "authors-code"]


def protocol(name):
    return registry.protocols.get(name)()


def score(name, metric, comparison):
    kind, options = protocol(name).metrics[metric]
    return make(kind, **options)(comparison)


@pytest.fixture
def scene():
    """A render and a frame: true depth 20 mm all over, drawn 1 mm too far; one pixel unknown, one masked."""
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=generator, dtype=torch.uint8)
    depth = torch.full((HEIGHT, WIDTH), 20.0)
    depth[2, 3] = torch.nan
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[5, 6] = False
    rgb = torch.rand(HEIGHT, WIDTH, 3, generator=generator).requires_grad_()
    drawn = torch.full((HEIGHT, WIDTH), 21.0)
    kinds = {"depth_accumulated": drawn, "depth_expected": drawn, "depth_median": drawn}
    output = make_output(rgb, **kinds, inverse_depth_accumulated=1 / drawn)
    return output, make_frame(image, depth, mask)


@pytest.mark.parametrize("name", NAMES)
def test_what_a_protocol_promises(name):
    made = protocol(name)
    assert made.name == name
    assert made.version == {"authors-code": 2}.get(name, 1)
    assert made.description
    assert made.wants <= set(OUTPUTS)
    for metric, options in (made.metrics | made.optional_metrics).values():
        make(metric, **options)
    if name in ("paper", "authors-code"):
        assert {"psnr", "ssim", "lpips", "depth_mse"} <= made.metrics.keys()
        assert made.metrics["lpips"] == ("lpips", {"net": "vgg", "input_range": "zero-one"})


@pytest.mark.parametrize(("name", "kind"), [("expected-depth", "depth_expected"), ("median-depth", "depth_median")])
def test_each_kind_of_depth_has_its_protocol(name, kind, scene):
    output, frame = scene
    others = {other: torch.full((HEIGHT, WIDTH), 99.0) for other in output.maps if other != kind}
    kept = replace(output, maps={**others, kind: torch.full((HEIGHT, WIDTH), 22.0)})
    comparison = protocol(name).compare(kept, frame)
    assert score(name, "depth_mse", comparison) == pytest.approx(4.0)
    assert torch.equal(comparison.depth_valid, protocol("paper").compare(output, frame).depth_valid)


@pytest.mark.parametrize("name", NAMES)
def test_nothing_compared_carries_a_graph_and_a_frame_without_depth_has_images_only(name, scene):
    output, frame = scene
    values = vars(protocol(name).compare(output, frame)).values()
    assert not any(value.requires_grad for value in values if isinstance(value, torch.Tensor))
    comparison = protocol(name).compare(output, frame.with_maps(depth=None))
    assert comparison.depth is comparison.true_depth is comparison.depth_valid is None
    assert score(name, "psnr", comparison) > 0
    with pytest.raises(UnavailableError, match="no ground-truth depth"):
        score(name, "depth_mse", comparison)


# -------------------------------------------------------------------------------------------------------------- paper


def test_paper_compares_floats_where_truth_is_known(scene):
    output, frame = scene
    comparison = protocol("paper").compare(output, frame)
    assert torch.equal(comparison.rgb, output.rgb.detach())
    assert torch.equal(comparison.valid, frame.mask)
    assert protocol("paper").compare(output, frame.with_maps(mask=None)).valid.all()
    assert torch.equal(comparison.depth, output["depth_accumulated"])
    assert (~comparison.depth_valid).nonzero().tolist() == [[2, 3], [5, 6]]
    assert score("paper", "depth_mse", comparison) == 1.0
    assert score("paper", "depth_mse_inner", comparison) == 1.0
    assert score("paper", "depth_abs_rel", comparison) == pytest.approx(0.05)


def test_paper_clamps_the_render(scene):
    _, frame = scene
    rgb = torch.full((HEIGHT, WIDTH, 3), 1.5)
    rgb[0] = -0.5
    output = make_output(rgb, depth_accumulated=torch.zeros(HEIGHT, WIDTH))
    assert protocol("paper").compare(output, frame).rgb.unique().tolist() == [0.0, 1.0]


# ------------------------------------------------------------------------------------------------------- authors' code


def test_authors_code_ignores_the_mask_and_scores_unknown_depth_against_zero(scene):
    comparison = protocol("authors-code").compare(*scene)
    assert comparison.valid.all()
    assert comparison.depth_valid.all()
    assert comparison.true_depth[2, 3] == 0.0
    # 21 mm over 150 is level 9174 (20.998 mm), 20 mm over 100 is level 13107 (20 mm) or, truncated in float32, one less
    drawn, truth = 9174 / 65535 * 150, comparison.true_depth[0, 0].item()
    assert truth == pytest.approx(20.0, abs=0.0016)
    pixels = HEIGHT * WIDTH
    expected = ((pixels - 1) * (drawn - truth) ** 2 + drawn**2) / pixels
    assert score("authors-code", "depth_mse", comparison) == pytest.approx(expected, rel=1e-5)


def test_authors_code_scores_clipped_depth_against_the_sensors_limit(scene):
    output, frame = scene
    bound = torch.full((HEIGHT, WIDTH), torch.nan)
    bound[2, 3] = 100.0
    comparison = protocol("authors-code").compare(output, frame.with_maps(depth_at_least=bound))
    assert comparison.true_depth[2, 3] == 100.0
    assert comparison.true_depth[0, 0] == pytest.approx(20.0, abs=0.0016)


def test_authors_code_rounds_images_to_eight_bits(scene):
    output, frame = scene
    comparison = protocol("authors-code").compare(output, frame)
    levels = comparison.rgb.numpy() * 255
    np.testing.assert_allclose(levels, np.round(output.rgb.detach().numpy() * 255), atol=1e-4)
    assert torch.equal(comparison.true_rgb, frame.rgb)


def test_authors_code_scores_pixels_nothing_was_drawn_on_at_zero(scene):
    """The upper 3 of 12 rows are empty, one of their pixels without truth: 1/0 is infinite and its cast 0."""
    _, frame = scene
    inverse = torch.full((HEIGHT, WIDTH), 1 / 20.0)
    inverse[:3] = 0.0
    output = make_output(torch.zeros(HEIGHT, WIDTH, 3), inverse_depth_accumulated=inverse)
    comparison = protocol("authors-code").compare(output, frame)
    assert not comparison.depth[:3].any()
    # 20 mm over 150 is level 8738 (20 mm) or, truncated in float32, one less
    assert comparison.depth[3, 0].item() == pytest.approx(20.0, abs=0.0023) and comparison.depth_valid.all()


# -------------------------------------------------------------------------------------------------------- quantisation


def one(value):
    return torch.tensor([[value]], dtype=torch.float32)


@pytest.mark.parametrize(
    ("value", "level"),
    [(0.0, 0), (1.0, 255), (-0.2, 0), (1.7, 255), (0.4 / 255, 0), (0.6 / 255, 1), (99.4 / 255, 99), (99.6 / 255, 100)],
)
def test_eight_bits_round_to_the_nearest_level_and_clamp(value, level):
    assert through_8_bit(one(value)).item() == pytest.approx(level / 255, abs=1e-7)
    levels = torch.arange(256) / 255
    assert torch.equal(through_8_bit(levels), levels)
    assert through_8_bit(one(torch.nan)).isnan().all()  # left for the metrics to refuse


@pytest.mark.parametrize("scale", [100.0, 150.0])
@pytest.mark.parametrize(
    ("level", "stored"),
    [
        *((1000.9, 1000), (65535, 65535), (0, 0)),
        *((65971.9, 65971 - 65536), (144177.5, 144177 - 2 * 65536)),  # beyond full scale it wraps around
        *((value, 0) for value in (torch.inf, -torch.inf, torch.nan, 1e15)),  # what no integer holds
    ],
)
def test_sixteen_bits_truncate(level, stored, scale):
    step = scale / 65535
    assert through_16_bit(one(level * step), scale).item() == pytest.approx(stored * step, rel=1e-6)


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the cast is undefined in C; x86-64 is meant")
@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0, 1e7, width=32), min_size=1, max_size=40))
def test_the_cast_is_numpy_s(depths):
    depth = np.array(depths, np.float32)
    with np.errstate(invalid="ignore"):
        stored = (depth / np.float32(150) * np.float32(65535)).astype(np.uint16)
    expected = stored.astype(np.float32) / np.float32(65535) * np.float32(150)
    np.testing.assert_array_equal(through_16_bit(torch.from_numpy(depth), 150.0).numpy(), expected)
