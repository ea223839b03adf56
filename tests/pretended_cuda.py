"""A CUDA device that is not there: tensors that compute on the CPU, say they are on `cuda`, and refuse to meet others.

Two modes of PyTorch work together. The function mode sees what Python asks for: it takes `cuda` out of the arguments,
tells what device a tensor is on, refuses numpy, and counts what would make the host wait. The dispatch mode sees every
operation, those of the autograd engine too: it marks the storages of results, and refuses operands on two devices, as
CUDA does.
"""

from __future__ import annotations

import contextlib
import traceback
from collections import Counter
from types import SimpleNamespace
from unittest import mock

import torch
from torch.autograd.function import BackwardCFunction
from torch.multiprocessing.reductions import StorageWeakRef
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

CUDA = torch.device("cuda", 0)
#: Operations at which a CUDA program waits for the device, by the names of functions.
WAITS = {
    *("item", "tolist", "__bool__", "__float__", "__int__", "__index__", "nonzero", "unique", "masked_select"),
    *("repeat_interleave", "argwhere", "equal", "allclose", "is_nonzero", "__contains__"),
}
#: Aten operations that copy between devices, or take indices from either.
ACROSS = {"aten::copy_", "aten::_to_copy", "aten::index.Tensor", "aten::index_put_", "aten::set_.source_Storage"}


class MixedDevicesError(RuntimeError):
    """Operands on two devices."""


class PretendedCuda(contextlib.AbstractContextManager):
    """While entered, `cuda` can be computed on.

    Attributes:
        waits: How often the host would have waited, by function and line of the package.
        made_current: Devices that were made a thread's current one, in order.
    """

    def __init__(self):
        self.waits = Counter()
        self.made_current = []
        self.in_engine = False
        self._on_cuda = {}
        self._stack = contextlib.ExitStack()

    def __enter__(self):
        patched = {
            "is_available": lambda: True,
            "device_count": lambda: 1,
            "get_device_name": lambda *_: "a pretended device",
            "get_device_properties": lambda *_: SimpleNamespace(
                name="a pretended device", major=9, minor=0, total_memory=2**34
            ),
            "set_device": self.made_current.append,
            "synchronize": lambda *_: None,
            "reset_peak_memory_stats": lambda *_: None,
            "max_memory_allocated": lambda *_: 0,
            "mem_get_info": lambda *_: (2**34, 2**34),
        }
        for name, function in patched.items():
            self._stack.enter_context(mock.patch.object(torch.cuda, name, function))
        self._stack.enter_context(_Dispatch(self))
        functions = self._stack.enter_context(_Functions(self))
        apply = BackwardCFunction.apply

        def in_function_mode(node, *gradients):  # the autograd engine leaves function modes
            with functions, mock.patch.object(self, "in_engine", False):
                return apply(node, *gradients)

        self._stack.enter_context(mock.patch.object(BackwardCFunction, "apply", in_function_mode))
        return self

    def __exit__(self, *exception):
        self._stack.close()

    def holds(self, tensor):
        """Whether a tensor is on the device; None of zeros by the autograd engine, which are where they should be."""
        return self._on_cuda.get(tensor.untyped_storage()._cdata, (None, False))[1]

    def mark(self, tensor, on_cuda):
        """Say where a tensor is."""
        storage = tensor.untyped_storage()
        # While there is a weak reference, no other storage gets this address.
        self._on_cuda[storage._cdata] = StorageWeakRef(storage), on_cuda

    def waited(self, name):
        """Count a wait of the host."""
        for frame in reversed(traceback.extract_stack()):
            if "/coliags_plugin/" in frame.filename:
                place = f"{frame.filename.rsplit('/coliags_plugin/')[-1]}:{frame.lineno}"
                self.waits[f"{name} {place}"] += 1
                return


def _is_cuda(device):
    return device is not None and not isinstance(device, int) and torch.device(device).type == "cuda"


class _Functions(TorchFunctionMode):
    def __init__(self, pretended):
        super().__init__()
        self.pretended = pretended

    def __torch_function__(self, function, kinds, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        name = getattr(function, "__name__", "")
        first = args[0] if args and isinstance(args[0], torch.Tensor) else None
        if first is not None and name in (
            "__get__",
            "numpy",
            "__array__",
            "to",
            "cuda",
            "cpu",
            "is_cuda",
            "pin_memory",
        ):
            answer = self._of_tensor(function, name, first, args, kwargs)
            if answer is not NotImplemented:
                return answer
        if first is not None and name in WAITS and self.pretended.holds(first):
            self.pretended.waited(name)
        if name == "__getitem__" and self.pretended.holds(first):
            picked = args[1] if isinstance(args[1], tuple) else (args[1],)
            if any(isinstance(part, torch.Tensor) and part.dtype == torch.bool for part in picked):
                self.pretended.waited("a mask as index")
        asked = kwargs.get("device")
        if asked is not None:
            kwargs["device"] = "cpu"
        with mock.patch.object(self.pretended, "in_engine", name in ("backward", "grad")):
            made = function(*args, **kwargs)
        if asked is not None and isinstance(made, torch.Tensor):
            self.pretended.mark(made, _is_cuda(asked))
        elif isinstance(made, torch.Tensor) and name in ("new_tensor", "tensor", "as_tensor", "from_numpy"):
            self.pretended.mark(made, first is not None and self.pretended.holds(first))
        return made

    def _of_tensor(self, function, name, tensor, args, kwargs):
        on_cuda = self.pretended.holds(tensor)
        if name == "__get__":
            asked = getattr(function, "__self__", None)
            if asked is torch.Tensor.device:
                return CUDA if on_cuda in (True, None) else torch.device("cpu")
            return on_cuda if asked is torch.Tensor.is_cuda else NotImplemented
        if name in ("numpy", "__array__"):
            if on_cuda:
                raise TypeError("can't convert cuda:0 device type tensor to numpy")
            return NotImplemented
        if name in ("cuda", "cpu"):
            return self._moved(tensor, name == "cuda")
        if name == "to":
            rest = list(args[1:])
            device = kwargs.pop("device", None)
            if rest and isinstance(rest[0], (torch.device, str)):
                device = rest.pop(0)
            elif rest and isinstance(rest[0], torch.Tensor):
                other = rest.pop(0)
                device, rest = ("cuda" if self.pretended.holds(other) else "cpu"), [other.dtype, *rest]
            dtypes = [part for part in (*rest, kwargs.get("dtype")) if isinstance(part, torch.dtype)]
            cast = function(tensor, *dtypes, copy=bool(kwargs.get("copy"))) if dtypes or "copy" in kwargs else tensor
            return cast if device is None else self._moved(cast, _is_cuda(device))
        return NotImplemented

    def _moved(self, tensor, to_cuda):
        if self.pretended.holds(tensor) == to_cuda:
            return tensor
        if not to_cuda:
            self.pretended.waited("a copy to the host")
        moved = _Move.apply(tensor, self.pretended) if tensor.requires_grad else tensor.clone()
        self.pretended.mark(moved, to_cuda)
        return moved


class _Move(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tensor, pretended):
        ctx.pretended, ctx.came_from_cuda = pretended, pretended.holds(tensor)
        return tensor.clone()

    @staticmethod
    def backward(ctx, gradient):
        copy = gradient.clone()
        ctx.pretended.mark(copy, ctx.came_from_cuda)
        return copy, None


class _Dispatch(TorchDispatchMode):
    def __init__(self, pretended):
        super().__init__()
        self.pretended = pretended

    def __torch_dispatch__(self, function, kinds, args=(), kwargs=None):
        kwargs = kwargs or {}
        tensors = [value for value in tree_flatten((args, kwargs))[0] if isinstance(value, torch.Tensor)]
        places = {self.pretended.holds(tensor) for tensor in tensors if tensor.ndim > 0 or self.pretended.holds(tensor)}
        places.discard(None)
        if len(places) > 1 and not any(function.name().startswith(name) for name in ACROSS):
            raise MixedDevicesError(f"{function.name()} of tensors on cuda and on the cpu")
        if function.name() in ("aten::_local_scalar_dense",) and True in places:
            self.pretended.waited("a number")
        made = function(*args, **kwargs)
        on_cuda = self.pretended.holds(tensors[0]) if len(places) > 1 else True in places
        if not places and self.pretended.in_engine:
            on_cuda = None
        sources = {tensor.untyped_storage()._cdata for tensor in tensors}

        def mark(value):
            if isinstance(value, torch.Tensor) and value.untyped_storage()._cdata not in sources:
                self.pretended.mark(value, on_cuda)
            return value

        return tree_map(mark, made)
