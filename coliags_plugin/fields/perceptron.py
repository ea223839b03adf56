"""The small perceptron every head is made of."""

from __future__ import annotations

import math

import torch
from torch import nn


def perceptron(inputs: int, hidden: int, outputs: int, generator: torch.Generator) -> nn.Sequential:
    """Linear -> ReLU -> Linear, initialised as torch does by default but from an explicit generator.

    Weights and biases are uniform within 1/sqrt(inputs) (docs/methods.md 3.4).
    """
    layers = nn.Linear(inputs, hidden), nn.Linear(hidden, outputs)
    with torch.no_grad():
        for layer in layers:
            bound = 1.0 / math.sqrt(layer.in_features)
            layer.weight.uniform_(-bound, bound, generator=generator)
            layer.bias.uniform_(-bound, bound, generator=generator)
    return nn.Sequential(layers[0], nn.ReLU(), layers[1])
