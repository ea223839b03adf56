"""Adding and removing rows of parameters together with their Adam moments."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import torch
from torch import Tensor, nn


def append_rows(field: nn.Module, optimizers: Mapping[str, torch.optim.Optimizer], rows: Mapping[str, Tensor]) -> None:
    """Append rows to parameters; their Adam moments start at zero.

    Args:
        field: Owns the parameters, by the names of ``rows``.
        optimizers: By the same names; a parameter without one is not trained.
        rows: What to append, by parameter name.
    """
    for name, extra in rows.items():
        _change(field, optimizers, name, partial(_appended, extra), partial(_appended, torch.zeros_like(extra)))


def keep_rows(
    field: nn.Module, optimizers: Mapping[str, torch.optim.Optimizer], names: tuple[str, ...], keep: Tensor
) -> None:
    """Keep only some rows of parameters and of their Adam moments.

    Args:
        field: Owns the parameters.
        optimizers: By parameter name.
        names: The parameters.
        keep: True for rows that stay. [M]
    """
    for name in names:
        _change(field, optimizers, name, partial(_kept, keep), partial(_kept, keep))


def _appended(extra: Tensor, old: Tensor) -> Tensor:
    return torch.cat([old, extra])


def _kept(keep: Tensor, old: Tensor) -> Tensor:
    return old[keep]


def _change(
    field: nn.Module,
    optimizers: Mapping[str, torch.optim.Optimizer],
    name: str,
    change_value: Callable[[Tensor], Tensor],
    change_moment: Callable[[Tensor], Tensor],
) -> None:
    old = getattr(field, name)
    new = nn.Parameter(change_value(old.detach()), requires_grad=old.requires_grad)
    setattr(field, name, new)
    optimizer = optimizers.get(name)
    if optimizer is None:
        return
    (group,) = optimizer.param_groups
    group["params"] = [new]
    state = optimizer.state.pop(old, None)
    if state is not None:
        optimizer.state[new] = {
            key: change_moment(value) if isinstance(value, Tensor) and value.shape == old.shape else value
            for key, value in state.items()
        }
