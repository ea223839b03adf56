"""A CUDA device that is not there: tensors that compute on the CPU, say they are on `cuda`, and refuse to meet others.

Two modes of PyTorch work together. The function mode sees what Python asks for: it takes `cuda` out of the arguments,
tells what device a tensor is on, and refuses numpy and random numbers of a generator of the CPU. The dispatch mode sees
every operation, those of the autograd engine too: it marks the storages of results, and refuses what CUDA refuses.
Both count what would make the host wait. Triton's kernels, which its interpreter runs, are seen as one operation each.
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
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_flatten, tree_map

CUDA = torch.device("cuda", 0)
#: Operations at which a CUDA program waits for the device, since sizes or checks of results depend on values.
WAITS = {
    *("aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select", "aten::equal", "aten::bincount"),
    *("aten::_unique2", "aten::unique_dim", "aten::unique_consecutive", "aten::unique_dim_consecutive"),
    *("aten::repeat_interleave.Tensor", "aten::linalg_matrix_exp", "aten::_linalg_check_errors", "aten::nanmedian"),
}
#: Operations with indices, which may be on the CPU: their copy is waited for.
INDEXING = ("aten::index.Tensor", "aten::index_put_", "aten::_index_put_impl_", "aten::_unsafe_index")
#: Operations on both devices, or on one number of the CPU though they are not pointwise.
ACROSS = ("aten::copy_", "aten::set_.source_Storage", "aten::masked_fill", "aten::fill_", *INDEXING)
#: What CUDA lacks: operations, and products of matrices of integers.
LACKING = {"aten::histogram.bin_ct", "aten::histogram.bins_tensor", "aten::_histogramdd_from_bin_cts"}
PRODUCTS = {"aten::mm", "aten::bmm", "aten::addmm", "aten::baddbmm", "aten::mv", "aten::dot"}


#: Where the storages of tensors are, and which are pinned, by address: constants outlive the device that made them.
_ON_CUDA: dict[int, tuple[StorageWeakRef, bool | None]] = {}
_PINNED: dict[int, StorageWeakRef] = {}


class MixedDevicesError(RuntimeError):
    """Operands on two devices."""


class PretendedCuda(contextlib.AbstractContextManager):
    """While entered, `cuda` can be computed on.

    Attributes:
        waits: How often the host would have waited, by what for and line of the package.
        made_current: Devices that were made a thread's current one, in order.
    """

    def __init__(self):
        self.waits = Counter()
        self.made_current = []
        self.in_engine = False
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
            "get_device_capability": lambda *_: (9, 0),
            "synchronize": lambda *_: self.waited("synchronize"),
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
        with contextlib.suppress(ImportError):
            self._interpret_kernels()
        return self

    def __exit__(self, *exception):
        self._stack.close()
        for address in [address for address, (storage, _) in _ON_CUDA.items() if storage.expired()]:
            del _ON_CUDA[address]
            _PINNED.pop(address, None)

    def _interpret_kernels(self):
        """Let kernels read and write tensors on the device alone."""
        from triton.runtime.interpreter import GridExecutor

        launch = GridExecutor.__call__

        def on_device(executor, *args, **kwargs):
            for name, value in (*zip(executor.arg_names, args, strict=False), *kwargs.items()):
                if isinstance(value, torch.Tensor) and self.holds(value) is False:
                    raise MixedDevicesError(f"argument {name} of kernel {executor.fn.__name__} is on the cpu")
            with _disable_current_modes(), torch._C.DisableTorchFunction():
                launch(executor, *args, **kwargs)

        self._stack.enter_context(mock.patch.object(GridExecutor, "__call__", on_device))

    def holds(self, tensor):
        """True for a tensor on the device; None of zeros by the autograd engine, which are where they should be."""
        return _ON_CUDA.get(tensor.untyped_storage()._cdata, (None, False))[1]

    def mark(self, tensor, on_cuda):
        """Say where a tensor is."""
        storage = tensor.untyped_storage()
        # While there is a weak reference, no other storage gets this address.
        _ON_CUDA[storage._cdata] = StorageWeakRef(storage), on_cuda
        _PINNED.pop(storage._cdata, None)

    def pinned(self, tensor):
        """The tensor in memory of the host that the device reads without a wait."""
        copy = tensor.clone()
        self.mark(copy, False)
        _PINNED[copy.untyped_storage()._cdata] = StorageWeakRef(copy.untyped_storage())
        return copy

    def is_pinned(self, tensor):
        """True for a tensor in such memory."""
        return tensor.untyped_storage()._cdata in _PINNED

    def copied(self, source, to_cuda, non_blocking):
        """Count the wait of a copy from one device to the other."""
        if not (to_cuda and non_blocking and self.is_pinned(source)):
            self.waited("a copy to the device" if to_cuda else "a copy to the host")

    def waited(self, name):
        """Count a wait of the host."""
        for frame in reversed(traceback.extract_stack()):
            if "/coliags_plugin/" in frame.filename:
                place = f"{frame.filename.rsplit('/coliags_plugin/')[-1]}:{frame.lineno}"
                break
        else:
            place = "elsewhere"
        self.waits[f"{name} {place}"] += 1


def _is_cuda(device):
    return device is not None and not isinstance(device, int) and torch.device(device).type == "cuda"


class _Functions(TorchFunctionMode):
    def __init__(self, pretended):
        super().__init__()
        self.pretended = pretended

    def __torch_function__(self, function, kinds, args=(), kwargs=None):
        kwargs, pretended = dict(kwargs or {}), self.pretended
        name = getattr(function, "__name__", "")
        first = args[0] if args and isinstance(args[0], torch.Tensor) else None
        if first is not None:
            answer = self._of_tensor(function, name, first, args, kwargs)
            if answer is not NotImplemented:
                return answer
        asked = kwargs.get("device")
        if asked is not None:
            kwargs["device"] = "cpu"
        on_cuda = _is_cuda(asked) if asked is not None else first is not None and pretended.holds(first)
        generators = [value for value in (*args, *kwargs.values()) if isinstance(value, torch.Generator)]
        if on_cuda and generators:
            raise MixedDevicesError(f"{name} on cuda with a generator of the cpu")
        with mock.patch.object(pretended, "in_engine", name in ("backward", "grad")):
            made = function(*args, **kwargs)
        if not isinstance(made, torch.Tensor):
            return made
        from_data = name in ("new_tensor", "tensor", "as_tensor", "asarray")
        if from_data and name != "new_tensor" and first is not None and asked is None:
            return made
        if asked is not None or from_data:
            if from_data and on_cuda and not (first is not None and name != "new_tensor" and pretended.holds(first)):
                pretended.waited("a copy to the device")
            if made is first and pretended.holds(first) != on_cuda:
                made = made.clone()
            pretended.mark(made, on_cuda)
        return made

    def _of_tensor(self, function, name, tensor, args, kwargs):
        pretended = self.pretended
        on_cuda = pretended.holds(tensor)
        if name == "__get__":
            place = CUDA if on_cuda in (True, None) else torch.device("cpu")
            attributes = {torch.Tensor.device: place, torch.Tensor.is_cuda: on_cuda}
            return attributes.get(getattr(function, "__self__", None), NotImplemented)
        if on_cuda and name in ("numpy", "__array__", "__dlpack__", "pin_memory"):
            raise TypeError(f"{name} of a tensor on cuda: copy it to the host first")
        if name == "tolist" and on_cuda:
            pretended.waited("tolist")
        answers = {
            "get_device": lambda: 0 if on_cuda else -1,
            "is_pinned": lambda: pretended.is_pinned(tensor),
            "pin_memory": lambda: pretended.pinned(tensor),
            "cuda": lambda: self._moved(tensor, True, kwargs.get("non_blocking", False)),
            "cpu": lambda: self._moved(tensor, False, False),
            "to": lambda: self._to(tensor, *args[1:], **kwargs),
        }
        return answers[name]() if name in answers else NotImplemented

    def _to(self, tensor, *rest, device=None, dtype=None, non_blocking=False, copy=False, memory_format=None):
        rest = list(rest)
        if rest and isinstance(rest[0], torch.Tensor):
            other = rest.pop(0)
            device, dtype = ("cuda" if self.pretended.holds(other) else "cpu"), other.dtype
        elif rest and isinstance(rest[0], (torch.device, str)):
            device = rest.pop(0)
        dtype = next((part for part in rest if isinstance(part, torch.dtype)), dtype)
        non_blocking = next((part for part in rest if isinstance(part, bool)), non_blocking)
        cast = tensor if dtype is None and not copy else tensor.to(dtype or tensor.dtype, copy=copy)
        return cast if device is None else self._moved(cast, _is_cuda(device), non_blocking, tensor)

    def _moved(self, tensor, to_cuda, non_blocking, source=None):
        pretended = self.pretended
        if pretended.holds(tensor) == to_cuda:
            return tensor
        pretended.copied(tensor if source is None else source, to_cuda, non_blocking)
        moved = _Move.apply(tensor, pretended) if tensor.requires_grad else tensor.clone()
        pretended.mark(moved, to_cuda)
        return moved


class _Move(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tensor, pretended):
        ctx.pretended, ctx.came_from_cuda = pretended, pretended.holds(tensor)
        return tensor.clone()

    @staticmethod
    def backward(ctx, gradient):
        ctx.pretended.copied(gradient, ctx.came_from_cuda, False)
        copy = gradient.clone()
        ctx.pretended.mark(copy, ctx.came_from_cuda)
        return copy, None


class _Dispatch(TorchDispatchMode):
    def __init__(self, pretended):
        super().__init__()
        self.pretended = pretended

    def __torch_dispatch__(self, function, kinds, args=(), kwargs=None):
        kwargs, name = kwargs or {}, function.name()
        tensors = [value for value in tree_flatten((args, kwargs))[0] if isinstance(value, torch.Tensor)]
        made_by = self.pretended.holds(tensors[0]) if tensors else None
        places = self._places(function, name, tensors)
        if True in places:
            self._check(name, tensors)
            self._count(name, args, kwargs)
        made = function(*args, **kwargs)
        on_cuda = made_by if len(places) > 1 else True in places
        if not places and self.pretended.in_engine:
            on_cuda = None
        sources = {tensor.untyped_storage()._cdata for tensor in tensors}

        def mark(value):
            if isinstance(value, torch.Tensor) and value.untyped_storage()._cdata not in sources:
                self.pretended.mark(value, on_cuda)
            return value

        return tree_map(mark, made)

    def _places(self, function, name, tensors):
        """Places of the operands, as far as known; refuses two devices where CUDA does."""
        holds, across = self.pretended.holds, name.startswith(ACROSS)
        # A single number of the CPU is an argument of a pointwise kernel.
        numbers = across or torch.Tag.pointwise in function.tags
        places = {holds(tensor) for tensor in tensors if not numbers or tensor.ndim > 0 or holds(tensor)} - {None}
        if len(places) < 2:
            return places
        of_self, others = holds(tensors[0]), tensors[1:]
        if name.startswith(INDEXING):
            # Of values that are put, too: the last operand.
            index = others[:-1] if "put" in name else others
            across = of_self and ("put" not in name or tensors[-1].ndim == 0 or holds(tensors[-1]))
            if across and any(holds(part) is False for part in index):
                self.pretended.waited("an index of the host")
        if not across:
            raise MixedDevicesError(f"{name} of tensors on cuda and on the cpu")
        if name.startswith("aten::copy_"):
            self.pretended.copied(tensors[1], of_self, False)
        return places

    def _check(self, name, tensors):
        whole = not (tensors[0].is_floating_point() or tensors[0].is_complex())
        if name in LACKING or (name in PRODUCTS and whole):
            raise NotImplementedError(f"{name} of {tensors[0].dtype} is not implemented for CUDA")

    def _count(self, name, args, kwargs):
        if name in WAITS and kwargs.get("output_size") is None:
            self.pretended.waited(name.removeprefix("aten::").split(".")[0].strip("_"))
        if not name.startswith(INDEXING):
            return
        masks = [part.dtype in (torch.bool, torch.uint8) for part in args[1] if part is not None]
        filled = "put" in name and all(masks) and args[2].numel() == 1 and not self.pretended.holds(args[2])
        if any(masks) and not filled:
            self.pretended.waited("a mask as index")
