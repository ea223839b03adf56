"""Bytes of tensors that are alive at once, counted on the CPU."""

import weakref

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


class LiveStorages(TorchDispatchMode):
    """While entered, counts the storages that operations make until they are freed.

    Attributes:
        peak: Most bytes at once, of storages made in the block.
    """

    def __init__(self):
        super().__init__()
        self.peak = self._now = 0
        self._alive = {}

    def __torch_dispatch__(self, function, kinds, args=(), kwargs=None):
        made = function(*args, **(kwargs or {}))
        known = self._alive.keys() | {storage._cdata for storage in storages((args, kwargs))}
        for storage in storages(made):
            key, size = storage._cdata, storage.nbytes()
            if key not in known | self._alive.keys():
                self._alive[key] = weakref.ref(storage, lambda _, key=key, size=size: self._freed(key, size))
                self._now += size
                self.peak = max(self.peak, self._now)
        return made

    def _freed(self, key, size):
        self._now -= size
        del self._alive[key]


def storages(tree):
    """Those of the tensors in nested tuples and dictionaries."""
    return [leaf.untyped_storage() for leaf in tree_leaves(tree) if isinstance(leaf, torch.Tensor)]
