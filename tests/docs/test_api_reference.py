"""`docs/api.md` says what the docstrings say, and nothing that is offered lacks one."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

import sharpfield as sf

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def made() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_api", DOCS / "make_api.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_is_up_to_date(made: ModuleType) -> None:
    if made.page() != (DOCS / "api.md").read_text():
        pytest.fail("docstrings have changed: run `python docs/make_api.py`")


def test_all_that_is_offered_is_on_the_page(made: ModuleType) -> None:
    text = made.page()
    missing = [f"sf.{name}" for name in made.FUNCTIONS if f"### `sf.{name}`" not in text]
    for room in made.ROOMS:
        offered = getattr(sf, room)
        missing += [
            f"sf.{room}.{name}" for name in dir(offered) if f"`sf.{room}.{name}`" not in text
        ]
    assert not missing
    functions = {name for name in dir(sf) if name[0].islower()} - {*made.ROOMS, "core", "recipes"}
    assert functions == {*made.FUNCTIONS}


def test_a_signature_is_as_it_is_called(made: ModuleType) -> None:
    def draw(self: object, at: int = 3, *, name: str = "x=y") -> None:
        """Draw."""

    assert made.signature(draw, "run.draw") == 'run.draw(at: int = 3, *, name: str = "x=y") -> None'


def test_a_docstring_becomes_lists(made: ModuleType) -> None:
    def draw() -> None:
        """Draw it.

        Args:
            at: Where, over
                two lines.

        Returns:
            Nothing
            at all.
        """

    assert list(made.docstring(draw)) == [
        "Draw it.",
        "**Arguments**",
        "- `at`: Where, over two lines.",
        "**Returns**",
        "Nothing at all.",
    ]
