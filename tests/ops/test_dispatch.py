"""One name, several versions: the right one runs, and says so."""

import subprocess
import sys

import pytest
import torch
from torch import Tensor

from sharpfield.core.errors import OptionError
from sharpfield.ops import _dispatch
from sharpfield.ops._dispatch import Op, registered, using, versions


@pytest.fixture
def double(monkeypatch: pytest.MonkeyPatch) -> Op[[Tensor], Tensor]:
    """An op whose fast version is off by one, so that a test sees which one ran."""
    monkeypatch.setattr(_dispatch, "_ops", {})

    @Op
    def double(x: Tensor) -> Tensor:
        """Twice x."""
        return 2 * x

    @double.accelerate("cpu", needs="numpy")
    def _(x: Tensor) -> Tensor:
        return 2 * x + 1

    return double


def test_the_choice_decides_which_version_runs(double: Op[[Tensor], Tensor]) -> None:
    one = torch.ones(())
    assert double(one) == 3
    with using("reference"):
        assert double(one) == 2
        with using("fast"):
            assert double(one) == 3
        assert double(one) == 2
    assert double(one) == 3


def test_an_op_looks_like_its_reference(double: Op[[Tensor], Tensor]) -> None:
    assert double.__doc__ == "Twice x."
    assert double.__name__ == "double"
    assert list(registered()) == ["test_dispatch.double"]


def test_versions_says_what_ran(double: Op[[Tensor], Tensor]) -> None:
    assert versions() == {}
    with using("reference"):
        double(torch.ones(()))
    assert versions() == {"test_dispatch.double": "reference (cpu)"}
    double(torch.ones(()))
    assert versions() == {"test_dispatch.double": "fast (cpu, numpy), reference (cpu)"}


def test_without_the_package_auto_runs_the_reference(double: Op[[Tensor], Tensor]) -> None:
    double.accelerate("cpu", needs="no_such_package")(lambda x: x)
    assert double(torch.ones(())) == 2


def test_fast_never_falls_back(double: Op[[Tensor], Tensor]) -> None:
    double.accelerate("cpu", needs="no_such_package")(lambda x: x)
    with using("fast"), pytest.raises(OptionError) as error:
        double(torch.ones(()))
    assert str(error.value) == (
        "OptionError: the op test_dispatch.double has no fast version for 'cpu'\n"
        "  where  SHARPFIELD_OPS\n"
        "  got    fast\n"
        "  do     install 'no_such_package'"
    )
    with using("fast"), pytest.raises(OptionError, match="for 'meta'"):
        double(torch.ones((), device="meta"))


def test_an_unknown_choice_is_refused(double: Op[[Tensor], Tensor]) -> None:
    with using("fastest"), pytest.raises(OptionError, match="one of auto, reference, fast"):
        double(torch.ones(()))


def test_importing_an_op_does_not_import_the_compiler() -> None:
    code = "import sys, sharpfield.ops.grid; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
