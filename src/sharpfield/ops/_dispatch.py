"""One name per operation; the plain torch version is the reference that all others must match.

An *op* is a function of tensors with a *reference* in plain torch. `ops/fast/<file>.py` may
register a *fast* version per device for the ops of `ops/<file>.py`; it is imported on the first
call, so that importing the package compiles nothing. `SHARPFIELD_OPS` (or `using`) chooses:

- `auto`: the fast version where there is one for the device, else the reference;
- `reference`: always the reference;
- `fast`: the fast version; an op without one fails.

There is no silent fallback: `versions` lists which version each op ran, for the run's log.
"""

import contextlib
import contextvars
import functools
import importlib
import importlib.util
import os
from collections.abc import Callable, Generator
from typing import Any, Generic, ParamSpec, TypeVar

import torch

from sharpfield.core.errors import OptionError

P = ParamSpec("P")
R = TypeVar("R")
Example = Callable[[torch.Generator, int], tuple[Any, ...]]

CHOICES = ("auto", "reference", "fast")

_choice = contextvars.ContextVar("ops", default=str(os.environ.get("SHARPFIELD_OPS", "auto")))
_ops: "dict[str, Op[..., Any]]" = {}


class Op(Generic[P, R]):
    """A reference function, and faster versions by device type and needed package.

    The device of the first argument, a tensor, decides which version runs.
    """

    def __init__(self, reference: Callable[P, R]) -> None:
        functools.update_wrapper(self, reference)
        folder, _, file = reference.__module__.rpartition(".")
        self.name = f"{file}.{reference.__name__}"
        self.reference = reference
        self.example: Example | None = None
        self.used: set[str] = set()
        self._fast: dict[str, tuple[str, Callable[P, R]]] = {}
        self._fast_folder, self._file = f"{folder}.fast", file
        _ops[self.name] = self

    def accelerate(self, device: str, *, needs: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
        """Register a version for `device` that runs when package `needs` is installed."""

        def register(version: Callable[P, R]) -> Callable[P, R]:
            self._fast[device] = (needs, version)
            return version

        return register

    def exemplify(self, make: Example) -> Example:
        """Register what makes arguments for the parity test and the benchmark.

        `make(generator, size)` returns the positional arguments, `size` saying how large they are
        (1 for a test). Its floating-point tensors are those whose gradients are compared.
        """
        self.example = make
        return make

    def fast(self) -> dict[str, tuple[str, Callable[P, R]]]:
        """The fast versions: by device, the package each one needs and the function."""
        _import_once(self._fast_folder, self._file)
        return self._fast

    def pick(self, device: str) -> Callable[P, R]:
        """The version that runs on `device`.

        Raises:
            OptionError: The choice is unknown, or `fast` and there is no fast version.
        """
        choice = _choice.get()
        if choice not in CHOICES:
            raise OptionError(
                "unknown choice of kernels",
                where="SHARPFIELD_OPS",
                got=choice,
                do=f"use one of {', '.join(CHOICES)}",
            )
        if choice != "reference":
            needs, version = self.fast().get(device, ("", None))
            if version is not None and _installed(needs):
                self.used.add(f"fast ({device}, {needs})")
                return version
            if choice == "fast":
                raise OptionError(
                    f"the op {self.name} has no fast version for {device!r}",
                    where="SHARPFIELD_OPS",
                    got=choice,
                    do=f"install {needs!r}" if version else "use auto",
                )
        self.used.add(f"reference ({device})")
        return self.reference

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Run the version for the device of the first argument."""
        first = args[0]
        assert isinstance(first, torch.Tensor), f"{self.name}: the first argument is a tensor"
        return self.pick(first.device.type)(*args, **kwargs)


@contextlib.contextmanager
def using(choice: str) -> Generator[None]:
    """Choose `auto`, `reference` or `fast` for the ops called inside."""
    token = _choice.set(choice)
    try:
        yield
    finally:
        _choice.reset(token)


def registered() -> "dict[str, Op[..., Any]]":
    """All ops that were imported, by `file.name`."""
    return dict(sorted(_ops.items()))


def versions() -> dict[str, str]:
    """Which version each op ran so far, e.g. `{"composite.weigh": "fast (cpu, numba)"}`."""
    return {name: ", ".join(sorted(op.used)) for name, op in registered().items() if op.used}


@functools.cache
def _import_once(folder: str, file: str) -> None:
    """Import a file of fast versions, if there is one."""
    if not folder.startswith(".") and importlib.util.find_spec(folder) is not None:
        module = f"{folder}.{file}"
        if importlib.util.find_spec(module) is not None:
            importlib.import_module(module)


@functools.cache
def _installed(package: str) -> bool:
    return importlib.util.find_spec(package) is not None
