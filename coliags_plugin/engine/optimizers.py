"""Adam per parameter group, with learning-rate schedules and changes of parameter rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches

import torch
from torch import Tensor, nn

from coliags_plugin.config.method_config import OptimizerSettings
from coliags_plugin.config.yaml_tree import dump_inline
from coliags_plugin.contracts import log_linear
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.registry import REGISTRIES
from coliags_plugin.engine.model import Model

#: What belongs to a row beside its value.
_GRADIENT, _MOMENTUM, _MEAN_SQUARE = "grad", "exp_avg", "exp_avg_sq"
#: Of a parameter in the state of Adam, beside its moments.
_COUNT = "step"
#: Adam's decay of mean gradients.
_BETA1 = 0.9


class Optimizers:
    """One Adam optimizer per parameter group of the model, with consistent changes of rows and moments.

    Implements :class:`coliags_plugin.contracts.ParameterRows`. Settings, by group, name exactly the model's groups;
    scheduled rates fall over so many steps; the scene's extent, scene units, is for rates that scale with it.
    """

    def __init__(self, model: Model, settings: Mapping[str, OptimizerSettings], steps: int, extent: float) -> None:
        groups = model.parameter_groups()
        _check_groups(set(groups), set(settings))
        self.model = model
        self.settings = settings
        self.steps = steps
        self.extent = extent
        self.adam: dict[str, torch.optim.Optimizer] = {
            name: torch.optim.Adam(parameters, 0.0, (_BETA1, settings[name].beta2), settings[name].eps, fused=True)
            for name, parameters in groups.items()
        }

    def rate(self, name: str, step: int) -> float:
        """The learning rate of a group at a step, counted from 1."""
        group = self.settings[name]
        rate = group.lr if group.final_lr is None else log_linear(group.lr, group.final_lr, step / self.steps)
        rate *= 0.5 ** sum(step > share * self.steps for share in group.halve_at)
        return rate * self.extent if group.times_extent else rate

    def step(self, step: int) -> None:
        """Take one step with every group and clear the gradients."""
        for name, optimizer in self.adam.items():
            for group in optimizer.param_groups:
                group["lr"] = self.rate(name, step)
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)

    def check_moments(self) -> None:
        """Raise ValueError if a parameter has moments of another shape or type, or lacks some of several."""
        for name, adam in self.adam.items():
            for parameter, state in adam.state.items():
                moment = (tuple(parameter.shape), parameter.dtype)
                expected = {_COUNT: ((), torch.float32), _MOMENTUM: moment, _MEAN_SQUARE: moment}
                stored = {key: (tuple(value.shape), value.dtype) for key, value in state.items()}
                if stored != expected:
                    raise ValueError(f"group {name} has {stored}, expected {expected}")

    def add_rows(self, rows: Mapping[str, Tensor], parents: Tensor | None = None) -> None:
        """Append rows, by group, which have no gradient and no momentum.

        With ``parents``, each new row takes over the mean squared gradient of a row, so that its first Adam steps are
        as small: a mean square of zero beside a step count long past its bias correction would make the first steps
        three times the learning rate, however small the gradient.
        """
        for name, extra in rows.items():

            def appended(kind: str, old: Tensor, extra: Tensor = extra) -> Tensor:
                if kind == _MEAN_SQUARE and parents is not None:
                    return torch.cat([old, old[parents]])
                moments = (_GRADIENT, _MOMENTUM, _MEAN_SQUARE)
                return torch.cat([old, torch.zeros_like(extra) if kind in moments else extra])

            self._change(name, appended)

    def keep_rows(self, groups: Sequence[str], keep: Tensor) -> None:
        """Keep only some rows of parameters, of their gradients and of their moments."""
        for name in groups:
            self._change(name, lambda _, old: old[keep])

    @torch.no_grad()
    def replace_values(self, group: str, values: Tensor) -> None:
        """Replace the values of a group and reset their moments."""
        parameter = self._parameter(group)
        parameter.copy_(values)
        state = self.adam[group].state.get(parameter, {})
        for key in {_MOMENTUM, _MEAN_SQUARE} & state.keys():
            state[key].zero_()

    def _parameter(self, group: str) -> nn.Parameter:
        (parameter,) = self.adam[group].param_groups[0]["params"]
        return parameter

    def _change(self, group: str, change: Callable[[str, Tensor], Tensor]) -> None:
        """Replace a group's parameter, and its gradient and moments, by ``change(kind, old)``."""
        old = self._parameter(group)
        new = nn.Parameter(change("value", old.detach()), requires_grad=old.requires_grad)
        if old.grad is not None:
            new.grad = change(_GRADIENT, old.grad)
        owner, _, attribute = next(n for n, value in self.model.named_parameters() if value is old).rpartition(".")
        setattr(self.model.get_submodule(owner), attribute, new)
        optimizer = self.adam[group]
        optimizer.param_groups[0]["params"] = [new]
        state = optimizer.state.pop(old, None)
        if state is not None:
            optimizer.state[new] = {
                key: change(key, value) if isinstance(value, Tensor) and value.shape == old.shape else value
                for key, value in state.items()
            }


def _rates_like(group: str) -> str:
    """Default rates of groups of built-in components: of those that end in the same word, or of the nearest names."""
    kinds = [REGISTRIES[kind] for kind in ("fields", "geometry_heads", "appearance_heads", "modules")]
    built_in = [kind.get(name) for kind in kinds for name in kind if kind.source(name) == "built in"]
    rates = {known: values for component in built_in for known, values in component.rates.items()}
    name = group.rpartition(".")[2]
    alike = [known for known in rates if known.split("_")[-1] == name.split("_")[-1]]
    return "; ".join(f"{near}: {dump_inline(rates[near])}" for near in alike or get_close_matches(name, rates, 3, 0.0))


def _check_groups(there: set[str], named: set[str]) -> None:
    if missing := sorted(there - named):
        raise InputError(
            f"optimizers lacks the parameter groups {', '.join(missing)}, for which no component declares rates",
            f"rates for each of {', '.join(sorted(there))}",
            f"Shipped methods have, by default, {_rates_like(missing[0])}. Set "
            f'`optimizers."{missing[0]}"={{lr: ...}}`, or declare `rates` in the class (docs/configs.md 5)',
        )
    if unknown := sorted(named - there):
        raise InputError(
            f"optimizers names {', '.join(unknown)}, which the model does not have",
            f"exactly its parameter groups: {', '.join(sorted(there))}",
            f'Remove it with `optimizers."{unknown[0]}"=null`',
        )
