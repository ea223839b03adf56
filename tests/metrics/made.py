"""Hand-made comparisons and renders, and random weights of LPIPS."""

from __future__ import annotations

import torch

from coliags_plugin.contracts import Comparison
from coliags_plugin.core import registry
from coliags_plugin.metrics import lpips
from coliags_plugin.metrics.lpips import TAPS


def make(name, **options):
    """A metric by name and options."""
    metric = registry.metrics.get(name)
    return metric(metric.Settings(**options))


def images(rgb, true_rgb, valid=None):
    """A Comparison of two images."""
    valid = torch.ones(rgb.shape[:2], dtype=torch.bool) if valid is None else valid
    return Comparison(rgb, true_rgb, valid)


def depths(depth, true_depth, valid=None):
    """A Comparison of two depth maps."""
    grey = torch.zeros(*depth.shape, 3)
    everywhere = torch.ones(depth.shape, dtype=torch.bool)
    return Comparison(grey, grey, everywhere, depth, true_depth, torch.isfinite(true_depth) if valid is None else valid)


# Random weights in the files of LPIPS's networks


# Keys and shapes of the convolutions in torchvision's models, from its documentation of the architectures.
TORCHVISION = {
    "vgg": {
        "0": (64, 3, 3), "2": (64, 64, 3), "5": (128, 64, 3), "7": (128, 128, 3), "10": (256, 128, 3),
        "12": (256, 256, 3), "14": (256, 256, 3), "17": (512, 256, 3), "19": (512, 512, 3), "21": (512, 512, 3),
        "24": (512, 512, 3), "26": (512, 512, 3), "28": (512, 512, 3),
    },
    "alex": {"0": (64, 3, 11), "3": (192, 64, 5), "6": (384, 192, 3), "8": (256, 384, 3), "10": (256, 256, 3)},
    "squeeze": {
        "0": (64, 3, 3),
        **{
            f"{layer}.{part}": shape
            for layer, inputs, squeezed, expanded in (
                (3, 64, 16, 64), (4, 128, 16, 64), (6, 128, 32, 128), (7, 256, 32, 128), (9, 256, 48, 192),
                (10, 384, 48, 192), (11, 384, 64, 256), (12, 512, 64, 256),
            )
            for part, shape in (
                ("squeeze", (squeezed, inputs, 1)), ("expand1x1", (expanded, squeezed, 1)),
                ("expand3x3", (expanded, squeezed, 3)),
            )
        },
    },
}  # fmt: skip


def random_backbone(net, prefix=""):
    generator = torch.Generator().manual_seed(0)
    state = {}
    for key, (outputs, inputs, size) in TORCHVISION[net].items():
        spread = (2 / (inputs * size * size)) ** 0.5
        state[f"{prefix}{key}.weight"] = spread * torch.randn(outputs, inputs, size, size, generator=generator)
        state[f"{prefix}{key}.bias"] = torch.zeros(outputs)
    return state


def random_heads(net):
    generator = torch.Generator().manual_seed(1)
    return {
        f"lin{index}.model.1.weight": torch.rand(1, channels, 1, 1, generator=generator)
        for index, channels in enumerate(TAPS[net].values())
    }


def lay_out(folder, net, heads="v0.1/{}.pth"):
    """Lay out weights as torchvision's downloads lie: the classifier too, under its published name."""
    (folder / heads.format(net)).parent.mkdir(parents=True, exist_ok=True)
    state = random_backbone(net, "features.") | {"classifier.0.weight": torch.zeros(2, 2)}
    torch.save(state, folder / lpips.BACKBONE_FILES[net])
    torch.save(random_heads(net), folder / heads.format(net))
