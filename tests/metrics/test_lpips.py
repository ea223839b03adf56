from functools import partial

import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import UnavailableError
from coliags_plugin.metrics import lpips
from coliags_plugin.metrics.lpips import TAPS, LPIPSNetwork, features
from tests.metrics.made import images, lay_out, make, random_backbone, random_heads

NETS = ["vgg", "alex", "squeeze"]

# --------------------------------------------------------------------------------------------------- the real weights


@pytest.fixture
def squeeze(shared_data, nowhere, monkeypatch):
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(shared_data / "lpips"))
    return partial(make, "lpips", net="squeeze")


def test_the_example_images_score_as_the_lpips_package_scores_them(squeeze, examples):
    """0.7110476 and 0.1479016: lpips 0.1.4 (net="squeeze") on the same weights and images, run once."""
    metric = squeeze(input_range="minus-one-one")
    assert metric(images(examples["p0"], examples["ref"])) == pytest.approx(0.7110476, abs=2e-6)
    assert metric(images(examples["p1"], examples["ref"])) == pytest.approx(0.1479016, abs=2e-6)


def test_unmapped_images_give_other_values_in_the_same_order_and_direction(squeeze, examples):
    blurred, warped, same = (squeeze()(images(examples[name], examples["ref"])) for name in ("p0", "p1", "ref"))
    assert 0 == same < warped < blurred == squeeze()(images(examples["ref"], examples["p0"]))
    mapped = squeeze(input_range="minus-one-one")(images(examples["p0"], examples["ref"]))
    assert abs(blurred - mapped) > 0.001


def test_ignored_pixels_do_not_change_lpips_and_are_left_out_of_its_mean(squeeze, examples):
    left = torch.ones(64, 64, dtype=torch.bool)
    left[:, 32:] = False
    truth, rendered = examples["ref"], torch.where(left[..., None], examples["p0"], examples["ref"])
    hidden, other = (
        torch.where(left[..., None], image, value) for image, value in ((rendered, torch.nan), (truth, 7.0))
    )
    masked = squeeze()(images(rendered, truth, left))
    assert squeeze()(images(hidden, other, left)) == masked
    assert masked > 1.2 * squeeze()(images(rendered, truth))  # only the left half differs


# ------------------------------------------------------------------------------------------------------ architectures


@pytest.mark.parametrize(
    ("net", "sizes"), [("vgg", [96, 48, 24, 12, 6]), ("alex", [23, 11, 5, 5, 5]), ("squeeze", [47, 23, 11, 5, 5, 5, 5])]
)
def test_every_tap_is_a_relu_of_the_right_width_and_size(net, sizes):
    x, taps = torch.rand(1, 3, 96, 96, generator=torch.Generator().manual_seed(0)), []
    with torch.device("meta"):
        layers = features(net)
    layers.load_state_dict(random_backbone(net), assign=True)
    for index, layer in enumerate(layers):
        x = layer(x)
        if index in TAPS[net]:
            taps.append((x.shape[1], x.shape[2]))
            assert x.min() == 0
    assert taps == list(zip(TAPS[net].values(), sizes, strict=True))


def test_the_first_tap_against_numpy():
    """Standardise, convolve with stride 2, rectify, normalise, square, weigh, average: by hand."""
    state, heads = random_backbone("squeeze"), [head * 0 for head in random_heads("squeeze").values()]
    heads[0] = random_heads("squeeze")["lin0.model.1.weight"]
    network = LPIPSNetwork("squeeze", state, heads)
    generator = torch.Generator().manual_seed(2)
    a, b = torch.rand(1, 3, 33, 37, generator=generator), torch.rand(1, 3, 33, 37, generator=generator)

    def tap(image):
        x = (image[0].double().numpy() - np.array([-0.030, -0.088, -0.188])[:, None, None]) / np.array(
            [0.458, 0.448, 0.450]
        )[:, None, None]
        patches = np.lib.stride_tricks.sliding_window_view(x, (3, 3), axis=(1, 2))[:, ::2, ::2]
        y = np.maximum(np.einsum("chwij,ocij->ohw", patches, state["0.weight"].double().numpy()), 0)
        return y / (np.sqrt((y * y).sum(0)) + 1e-10)

    squared = (tap(a) - tap(b)) ** 2
    expected = (heads[0].double().numpy()[0] * squared).sum(0).mean()
    distance = network(a, b, torch.ones(33, 37, dtype=torch.bool))
    assert distance.item() == pytest.approx(expected, rel=1e-5)


def test_building_a_network_draws_no_random_numbers(pair):
    state = torch.random.get_rng_state()
    network = LPIPSNetwork("vgg", random_backbone("vgg"), list(random_heads("vgg").values()))
    assert torch.equal(torch.random.get_rng_state(), state)
    image, truth = (x.permute(2, 0, 1)[None] for x in (pair.rgb, pair.true_rgb))
    assert 0 < network(image, truth, pair.valid).item() < 100


# ------------------------------------------------------------------------------------------------- finding the weights


@pytest.mark.parametrize("heads", ["{}.pth", "v0.1/{}.pth"])
def test_a_named_folder_comes_before_the_environment_s(heads, nowhere, monkeypatch):
    lay_out(nowhere / "first", "alex", heads)
    lay_out(nowhere / "second", "alex", heads)
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(nowhere / "second"))
    assert {file.parents[heads.count("/")] for file in lpips.find_weights("alex")[1:]} == {nowhere / "second"}
    backbone, linear = lpips.find_weights("alex", nowhere / "first")
    assert backbone.parent == nowhere / "first"
    assert linear == nowhere / "first" / heads.format("alex")


def test_missing_weights_say_what_and_how_to_get_it(nowhere, pair, monkeypatch):
    with pytest.raises(UnavailableError) as caught:
        make("lpips", net="vgg")(pair)
    text = str(caught.value)
    for part in ("vgg16-397923af.pth", "v0.1/vgg.pth", "run `coliags weights lpips`"):
        assert part in text
    assert str(nowhere) not in text, "results are to be the same on every machine"
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(nowhere))
    torch.save(random_heads("vgg"), nowhere / "vgg.pth")
    with pytest.raises(UnavailableError, match="backbone") as caught:
        make("lpips", net="vgg")(pair)
    assert "linear heads" not in str(caught.value)


@pytest.mark.parametrize("damage", ["truncated", "other net", "not tensors", "wrong heads", "negative heads"])
def test_weights_that_do_not_fit_name_the_file(damage, nowhere, pair, monkeypatch):
    folder = nowhere / damage.replace(" ", "-")
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(folder))
    lay_out(folder, "squeeze")
    backbone, heads = folder / lpips.BACKBONE_FILES["squeeze"], folder / "v0.1" / "squeeze.pth"
    culprit = heads if "heads" in damage else backbone
    if damage == "truncated":
        backbone.write_bytes(backbone.read_bytes()[:1000])
    elif damage == "other net":
        torch.save(random_backbone("alex"), backbone)
    elif damage == "not tensors":
        torch.save([1, 2], backbone)
    elif damage == "wrong heads":
        torch.save(random_heads("alex"), heads)
    else:
        torch.save({key: -value for key, value in random_heads("squeeze").items()}, heads)
    with pytest.raises(UnavailableError) as caught:
        make("lpips", net="squeeze")(pair)
    assert str(culprit) in str(caught.value)


def test_too_small_images():
    with pytest.raises(UnavailableError, match="40x31"):
        make("lpips")(images(torch.zeros(31, 40, 3), torch.ones(31, 40, 3)))


def test_the_network_is_read_once(nowhere, pair, monkeypatch):
    lay_out(nowhere / "kept", "alex")
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(nowhere / "kept"))
    metric = make("lpips", net="alex")
    with torch.inference_mode():
        first = metric(pair)
    (nowhere / "kept" / "v0.1" / "alex.pth").write_bytes(b"no longer read")
    assert metric(pair) == first
