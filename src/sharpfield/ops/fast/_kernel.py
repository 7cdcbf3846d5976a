# pyright: basic
"""Compilation of CPU kernels by numba, and their execution on several threads.

Vocabulary: a *kernel* is a function of numpy arrays that numba compiles, once per set of types and
machine; the result is cached beside the source, or in the user's cache folder if that is not
writable. Kernels work on the memory of torch tensors, without copies. A kernel that is *spread*
runs once per *worker* (thread), each processing its share.

Every kernel gives the same bits on every run: the terms of each sum and their order do not depend
on the number of workers or on their speed.
"""

import functools
import inspect
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

Kernel = Callable[..., Any]


def kernel(function: Kernel) -> Kernel:
    """Compile a function of arrays; it runs without Python's lock.

    A multiplication and an addition may become one instruction; sums keep their order.
    """
    return numba.njit(cache=True, nogil=True, fastmath={"contract"})(inspect.unwrap(function))


def spread(spread_kernel: Kernel, *arguments: Any) -> None:
    """Run `spread_kernel(worker, workers, *arguments)` on as many threads as torch uses.

    Plain threads rather than numba's own parallel loops: those drop writes to arrays inside tuples
    (0.68), compile slowly, and keep a second pool of spinning threads beside torch's.
    """
    workers = torch.get_num_threads()
    others = [
        _threads().submit(spread_kernel, worker, workers, *arguments)
        for worker in range(1, workers)
    ]
    spread_kernel(0, workers, *arguments)
    for other in others:
        other.result()


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="kernel")


# A forked process has none of its parent's threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_threads.cache_clear)


@kernel
def share(worker, workers, count):
    """First and one-past-last index of a worker's share of `count` items."""
    return count * worker // workers, count * (worker + 1) // workers


def memory(tensor: Tensor) -> np.ndarray:
    """The tensor's values as an array that shares its memory; it must be contiguous."""
    assert tensor.is_contiguous(), "a kernel walks over memory in order"
    return tensor.detach().numpy()


def empty(like: Tensor, *shape: int) -> Tensor:
    """An uninitialised tensor of the type of `like`, for a large result.

    Large results come from numpy, because it asks for huge pages: they are filled several times
    faster.
    """
    return torch.from_numpy(np.empty(shape, memory(like).dtype))
