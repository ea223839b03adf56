"""Layers and the cosine embedding gamma of the fields' multilayer perceptrons."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import pairwise
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from coliags_plugin.contracts import HeadNetworks

#: auto: bfloat16 on CPUs that have instructions for it, otherwise float32.
Precision = Literal["auto", "float32", "bfloat16"]


def reduced_dtype(precision: Precision, inputs: Tensor) -> torch.dtype:
    """The type of the factors of products; that of the inputs where these are not float32."""
    if inputs.dtype != torch.float32 or precision == "float32":
        return inputs.dtype
    fast = precision == "bfloat16" or (inputs.device.type == "cpu" and _cpu_multiplies_bfloat16())
    return torch.bfloat16 if fast else inputs.dtype


@cache
def _cpu_multiplies_bfloat16() -> bool:
    """True if the CPU has instructions for products of bfloat16; others take longer for them than for float32."""
    capabilities: Mapping[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))


def mlp(inputs: int, hidden: int, outputs: int, generator: torch.Generator) -> nn.Sequential:
    """Linear -> ReLU -> Linear, initialised by :func:`linear_layers`."""
    first, last = linear_layers((inputs, hidden, outputs), generator)
    return nn.Sequential(first, nn.ReLU(), last)


def linear_layers(widths: Sequence[int], generator: torch.Generator) -> list[nn.Linear]:
    """Linear layers from each width to the next, initialised as torch does by default but from an explicit generator.

    Weights and biases are uniform within 1/sqrt(inputs) (docs/methods.md 3.4).
    """
    layers = [nn.Linear(inputs, outputs) for inputs, outputs in pairwise(widths)]
    with torch.no_grad():
        for layer in layers:
            bound = 1.0 / math.sqrt(layer.in_features)
            layer.weight.uniform_(-bound, bound, generator=generator)
            layer.bias.uniform_(-bound, bound, generator=generator)
    return layers


def glorot_linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """Linear layer with Glorot's uniform weights, within sqrt(6 / (inputs + outputs)), and biases of 0."""
    layer = nn.Linear(inputs, outputs)
    bound = math.sqrt(6.0 / (inputs + outputs))
    with torch.no_grad():
        layer.weight.uniform_(-bound, bound, generator=generator)
        layer.bias.zero_()
    return layer


def first_layer(
    features: Float[Tensor, "V F"],
    embedded: Float[Tensor, "V E"],
    weight: Float[Tensor, "H F+E"],
    bias: Float[Tensor, "H"],
) -> Float[Tensor, "V H"]:
    """Linear layer of two concatenated inputs, without concatenating them.

    What is embedded (directions, distances) has no gradient; joined with the features it would be given one.
    """
    split = features.shape[1]
    return torch.addmm(nn.functional.linear(embedded, weight[:, split:], bias), features, weight[:, :split].t())


def embedded_inputs(networks: HeadNetworks) -> Float[Tensor, "V E"]:
    """Inputs of the MLPs after the features, the last ones embedded by gamma."""
    plain = networks.inputs.shape[1] - networks.embedded
    waves = cosine_embedding(networks.inputs[:, plain:], networks.frequencies)
    return torch.cat([networks.inputs[:, :plain], waves], dim=1)


def outputs(features: Float[Tensor, "V F"], networks: HeadNetworks) -> list[Tensor]:
    """Outputs of the MLPs of a head, with one product for all first layers."""
    weight, bias = (torch.cat([mlp.get_parameter(name) for mlp in networks.mlps]) for name in ("0.weight", "0.bias"))
    hidden = first_layer(features, embedded_inputs(networks), weight, bias).relu()
    parts: Any = torch.split(hidden, [len(mlp.get_parameter("0.bias")) for mlp in networks.mlps], dim=1)
    return [mlp[2](part) for mlp, part in zip(networks.mlps, parts, strict=True)]


def cosine_embedding(x: Float[Tensor, "... D"], frequencies: int) -> Float[Tensor, "... E"]:
    """``[x, sin(x), cos(x), sin(2x), cos(2x), ..., sin(2^(L-1) x), cos(2^(L-1) x)]``.

    Frequency-major, sine before cosine, no factor pi: the paper's "dimension" is the number of frequencies L
    (docs/methods.md 3.2), so ten on a direction make 63 numbers and five on an angle make 11. 0 leaves ``x`` as it is.
    """
    octaves = 2.0 ** torch.arange(frequencies, device=x.device, dtype=x.dtype)
    phases = octaves[:, None] * x[..., None, :]
    waves = torch.stack([phases.sin(), phases.cos()], dim=-2)
    return torch.cat([x, waves.flatten(start_dim=-3)], dim=-1)
