"""The walks of `docs/reading-order.md`: every function named there exists and is entered."""

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import pytest

import sharpfield as sf
from sharpfield.core.protocols import Model
from sharpfield.recipes.settings.presets import prepared

PACKAGE = Path(sf.__file__).parent
PAGE = PACKAGE.parents[1] / "docs" / "reading-order.md"
STEPS = 100
LATE = 90
"""A step in which blur and events are modelled."""


def walks() -> dict[str, list[str]]:
    """The functions of each walk, by the recipe in its heading."""
    sections = re.split(r"^### .*`([\w-]+)`$", PAGE.read_text(), flags=re.MULTILINE)[1:]
    return {
        recipe: re.findall(r"^\|[^|]*\| `([^`]+\.py: [^`]+)`", text.partition("\n## ")[0], re.M)
        for recipe, text in zip(sections[::2], sections[1::2], strict=True)
    }


@contextmanager
def entered() -> Iterator[set[str]]:
    """Our functions that are called inside, as `path.py: name`."""
    names: set[str] = set()

    def note(frame: FrameType, event: str, _: object) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(PACKAGE):
            names.add(f"{path.relative_to(PACKAGE).as_posix()}: {frame.f_code.co_qualname}")

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        yield names
    finally:
        sys.setprofile(before)


def functions_of_a_step(recipe: str, folder: Path) -> set[str]:
    capture = sf.read(folder)
    made = prepared(recipe, "draft", capture=capture, device="cpu").lasting(STEPS)
    model = made.build(capture, 0)
    take_step(model)  # kernels are compiled unwatched, which is faster
    with entered() as names:
        sf.read(folder)
        take_step(model)
    return names


def take_step(model: Model) -> None:
    terms = model.losses(model.draw(LATE), LATE)
    sum(terms.values()).backward()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("walk") / "capture"
    sf.simulate("tiles", size=(24, 16), frames=6, seed=3, out=out)
    return out


def test_both_walks_are_whole():
    assert walks().keys() == {"ev-deblur-nerf", "ev-splat"}
    assert all(len(hops) > 15 for hops in walks().values())


@pytest.mark.parametrize("recipe", walks())
def test_every_function_of_a_walk_is_entered(recipe: str, folder: Path):
    missing = set(walks()[recipe]) - functions_of_a_step(recipe, folder)
    assert not missing, "\n".join(sorted(missing))
