"""The documents say nothing that is not there: commands, options, links, imports, folders.

Commands are parsed by the command line itself, with functions in place of the commands that only
note what they were called with.
"""

import ast
import functools
import importlib
import inspect
import re
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sharpfield.cli import commands as command_line
from sharpfield.core.errors import OptionError
from sharpfield.recipes import RECIPES, recipe_named
from sharpfield.recipes.settings.options import changed
from sharpfield.recipes.settings.presets import presets_of

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "notebook.md"]
PAGES += sorted((ROOT / "docs").rglob("*.md"))

FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"^ {4,}(sharpfield [a-z].*)$", re.MULTILINE)
INLINE = re.compile(r"`(sharpfield [^`]+)`")
CHANGES = re.compile(r"`--change ([^`]+)`")
LINK = re.compile(r"\]\(([^)\s]+)\)|<img[^>]* src=\"([^\"]+)\"")
COMMAND = re.compile(r"^(sharpfield [a-z].*)$", re.MULTILINE)

Call = tuple[str, dict[str, Any]]


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(page: Path, language: str) -> Iterator[str]:
    for match in FENCE.finditer(page.read_text()):
        if match[1] == language:
            yield match[2]


def commands() -> list[tuple[str, str]]:
    """Every whole command of the documents, and where it is."""
    found = []
    for page in PAGES:
        text = FENCE.sub("", page.read_text())
        fenced = [line for block in blocks(page, "") for line in COMMAND.findall(block)]
        found += [(name(page), line) for line in fenced + INDENTED.findall(text)]
    return found


@pytest.fixture
def parse(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Call]:
    """What a command line would be called with."""
    calls: list[Call] = []

    def noting(command: str, function: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(function)
        def note(*args: Any, **options: Any) -> None:
            calls.append((command, inspect.signature(function).bind(*args, **options).arguments))

        return note

    load = command_line.load
    monkeypatch.setattr(command_line, "load", lambda command: noting(command, load(command)))

    def parsed(line: str) -> Call:
        command_line.main(shlex.split(line, comments=True)[1:])
        return calls[-1]

    return parsed


@pytest.mark.parametrize(("page", "line"), commands())
def test_commands_are_understood(page: str, line: str, parse: Callable[[str], Call]) -> None:
    command, given = parse(line)
    if command == "train":
        recipe, choice = given["recipe"], given.get("selection")
        made = recipe_named(recipe)()
        if choice is not None:
            presets = [preset for preset in choice.preset.split(",") if preset]
            assert set(presets) <= presets_of(made).all.keys(), page
            changed(made, choice.change)


def test_a_command_with_a_wrong_option_is_noticed(parse: Callable[[str], Call]) -> None:
    with pytest.raises(SystemExit):
        parse("sharpfield simulate --out garden --sized 20x20")


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_inline_commands_name_options_that_exist(
    page: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    for line in INLINE.findall(page.read_text()):
        words = line.split()
        if words[1] not in command_line.COMMANDS:
            assert not words[1].islower(), line  # COMMAND and the like stand for any
            continue
        with pytest.raises(SystemExit):
            command_line.main([words[1], "--help"])
        known = set(re.findall(r"--[a-z-]+", capsys.readouterr().out))
        assert {word for word in words if word.startswith("--")} <= known, line


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_changes_name_numbers_of_a_recipe(page: Path) -> None:
    for change in CHANGES.findall(page.read_text()):
        if "NAME" not in change:
            assert any(can_be_changed(kind(), change) for kind in RECIPES.values()), change


def can_be_changed(recipe: object, change: str) -> bool:
    try:
        changed(recipe, tuple(change.split()))
    except OptionError:
        return False
    return True


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in (a or b for a, b in LINK.findall(FENCE.sub("", page.read_text()))):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        linked = (page.parent / path).resolve() if path else page
        assert linked.exists(), f"{name(page)} links to {target}"
        assert not anchor or anchor in anchors(linked), f"{name(page)} links to {target}"


def anchors(page: Path) -> set[str]:
    """Headings as links name them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_python_imports_what_there_is(page: Path) -> None:
    for block in blocks(page, "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sharpfield"):
                module = importlib.import_module(node.module or "")
                missing = [alias.name for alias in node.names if not hasattr(module, alias.name)]
                assert not missing, f"{name(page)}: {node.module} has no {', '.join(missing)}"


def test_the_tree_of_the_readme_exists() -> None:
    tree = next(block for block in blocks(ROOT / "README.md", "") if "src/sharpfield/" in block)
    above = ROOT
    shown = set()
    for line in tree.splitlines():
        inside, entry = line.startswith("  "), line.split()[0]
        path = (above if inside else ROOT) / entry
        above = above if inside else path
        assert path.is_dir(), line
        shown.add(path)
    folders = {path for path in (ROOT / "src" / "sharpfield").iterdir() if path.is_dir()}
    unshown = {path for path in folders - shown if any(path.glob("*.py"))}
    assert not unshown, f"not in the README: {', '.join(path.name for path in unshown)}"


def test_files_named_in_tables_exist() -> None:
    """Paths such as `formation/mixing.py` in backticks, from the package, or from the top."""
    places = (ROOT, ROOT / "src" / "sharpfield", ROOT / "src" / "sharpfield" / "recipes")
    for page in PAGES:
        for path in re.findall(r"`([a-z_]+(?:/[a-z_0-9]+)*\.py)\b", page.read_text()):
            beside = (*places, *(ROOT / "src" / "sharpfield").iterdir())
            assert any((place / path).exists() for place in beside), f"{name(page)}: {path}"
