"""Adding and removing rows of parameters together with their gradients and Adam moments."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

#: What belongs to a row beside its value.
_GRADIENT, _MOMENTUM, _MEAN_SQUARE = "grad", "exp_avg", "exp_avg_sq"


def append_rows(
    field: nn.Module, optimizers: Mapping[str, torch.optim.Optimizer], rows: Mapping[str, Tensor], parents: Tensor
) -> None:
    """Append rows to parameters; their first Adam steps are as small as their parents'.

    A new row has no gradient and no momentum, but its parent's mean squared gradient. Were that zero too, beside a step
    count long past its bias correction, the first steps would be three times the learning rate however small the
    gradient.

    Args:
        field: Owns the parameters, by the names of ``rows``.
        optimizers: By the same names; a parameter without one is not trained.
        rows: What to append, by parameter name. [B, ...]
        parents: For each new row, the row it takes after. [B]
    """
    for name, extra in rows.items():

        def appended(kind: str, old: Tensor, extra: Tensor = extra) -> Tensor:
            if kind == _MEAN_SQUARE:
                return torch.cat([old, old[parents]])
            return torch.cat([old, torch.zeros_like(extra) if kind in (_GRADIENT, _MOMENTUM) else extra])

        _change(field, optimizers, name, appended)


def keep_rows(
    field: nn.Module, optimizers: Mapping[str, torch.optim.Optimizer], names: tuple[str, ...], keep: Tensor
) -> None:
    """Keep only some rows of parameters, of their gradients and of their Adam moments.

    Args:
        field: Owns the parameters.
        optimizers: By parameter name.
        names: The parameters.
        keep: True for rows that stay. [M]
    """
    for name in names:
        _change(field, optimizers, name, lambda _, old: old[keep])


def _change(
    field: nn.Module,
    optimizers: Mapping[str, torch.optim.Optimizer],
    name: str,
    change: Callable[[str, Tensor], Tensor],
) -> None:
    """Put ``change(kind, old)`` in the place of a parameter and of all that has its shape."""
    old = getattr(field, name)
    new = nn.Parameter(change("value", old.detach()), requires_grad=old.requires_grad)
    if old.grad is not None:
        new.grad = change(_GRADIENT, old.grad)
    setattr(field, name, new)
    optimizer = optimizers.get(name)
    if optimizer is None:
        return
    (group,) = optimizer.param_groups
    group["params"] = [new]
    state = optimizer.state.pop(old, None)
    if state is not None:
        optimizer.state[new] = {
            key: change(key, value) if isinstance(value, Tensor) and value.shape == old.shape else value
            for key, value in state.items()
        }
