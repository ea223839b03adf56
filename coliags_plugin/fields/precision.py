"""Precision of the products of networks."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, Literal

import torch
from torch import Tensor

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
    """Whether the CPU has instructions for products of bfloat16; others take longer for them than for float32."""
    capabilities: Mapping[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))
