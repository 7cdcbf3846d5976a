"""The documents say nothing that is not there: commands, options, links, imports, folders.

Commands are parsed by the command line itself, with functions in place of the commands that only
note what they were called with.
"""

import ast
import contextlib
import functools
import importlib
import inspect
import io
import re
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import sharpfield
from sharpfield.captures.read import LAYOUTS
from sharpfield.cli import commands as command_line
from sharpfield.cli.recipe_options import flag_of
from sharpfield.core.lenses import LENSES
from sharpfield.metrics.registry import METRICS
from sharpfield.recipes import RECIPES, recipe_named
from sharpfield.recipes.settings.options import changed, options_of
from sharpfield.recipes.settings.presets import presets_of
from sharpfield.recordings.open import FORMATS
from sharpfield.simulation.sensors.event_pixels import SENSORS

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "sharpfield"
ROOMS = {path.name for path in SOURCE.iterdir() if path.is_dir()}
TOPS = {"src", "docs", "tests", "benchmarks", "examples"}
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "notebook.md"]
PAGES += sorted((ROOT / "docs").rglob("*.md"))

FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"^ {4,}(sharpfield [a-z].*)$", re.MULTILINE)
INLINE = re.compile(r"`(sharpfield [^`]+)`")
SPAN = re.compile(r"`([^`\n]+)`")
FILE = re.compile(r"([\w./-]+\.(?:py|md|ipynb|json))(?:: (.+))?")
FOLDER = re.compile(r"[a-z_]+(?:/[a-z_]+)*/")
DOTTED = re.compile(r"([a-z_]+)((?:\.\w+)+)")
PROGRAM = re.compile(r"python (?:-m ([\w.]+)|([\w/]+\.py))(.*)")
FLAG = re.compile(r"--([a-z][\w.-]*)")
ERROR = re.compile(r"^(?:Capture|Option|Run|Shape)Error: (.*)$", re.MULTILINE)
ARGUMENT = re.compile(r"add_argument\(\s*\"--([\w-]+)\"")
LINK = re.compile(r"\]\(([^)\s]+)\)|<img[^>]* src=\"([^\"]+)\"")
COMMAND = re.compile(r"^(sharpfield [a-z].*)$", re.MULTILINE)

PROGRAMS = [*(ROOT / "benchmarks").glob("*.py"), *(ROOT / "examples").glob("*.py")]
PROGRAMS += [ROOT / "tests" / "recordings" / "fuzz.py", ROOT / "docs" / "make_api.py"]
FILES = {".h5", ".npz", ".npy", ".toml", ".json", ".png", ".html", ".csv", ".txt", ".py", ".ply"}
TOLD = ("runs/",)
"""Folders of examples, where a page names files that commands write."""
OTHERS = {"pip", "pytest", "venv"}
"""Modules of other packages that pages run."""
FIELDS = {"frames.blur_px"}
"""Names after a dot that belong to the data of a capture."""

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
        if words[1] in ("--help", "--version"):
            continue
        if words[1] not in command_line.COMMANDS:
            assert not words[1].islower(), line  # COMMAND and the like stand for any
            continue
        with pytest.raises(SystemExit):
            command_line.main([words[1], "--help"])
        known = set(re.findall(r"--[a-z-]+", capsys.readouterr().out))
        assert {word for word in words if word.startswith("--")} <= known, line


def spans(page: Path) -> list[str]:
    """What stands between single backticks, outside of blocks."""
    return SPAN.findall(FENCE.sub("", page.read_text()))


@functools.cache
def recipe_options() -> frozenset[str]:
    """Options of all recipes, with those that other names have as flags."""
    return frozenset(option for kind in RECIPES.values() for option in options_of(kind()))


@functools.cache
def flags() -> frozenset[str]:
    """Flags of all commands and recipes, with `_` for `-`."""
    found = {flag_of(option).replace("-", "_") for option in recipe_options()}
    for command in command_line.COMMANDS:
        said = io.StringIO()
        with contextlib.redirect_stdout(said), pytest.raises(SystemExit):
            command_line.main([command, "--help"])
        found |= {flag.replace("-", "_").rstrip(".") for flag in FLAG.findall(said.getvalue())}
    for program in PROGRAMS:
        found |= arguments_of(program)
    return frozenset(found)


def arguments_of(program: Path) -> set[str]:
    """Flags that a benchmark or an example takes."""
    return {flag.replace("-", "_") for flag in ARGUMENT.findall(program.read_text())}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_flags_exist(page: Path) -> None:
    """Such as `--sampling.views 5`, of a command or a recipe."""
    for span in spans(page):
        if span.startswith("--"):
            named = {flag for flag in FLAG.findall(span) if flag.islower()}  # NAME stands for any
            unknown = {flag.replace("-", "_") for flag in named} - flags()
            assert not unknown, f"{name(page)}: {span}"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_nothing_is_changed_in_the_old_way(page: Path) -> None:
    assert not re.search(r"--change [a-z]", page.read_text()), "options are flags"


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
        if page.name == "api.md":  # signatures and values, no programs
            continue
        tree = ast.parse(block)
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sharpfield"):
                assert not (node.module or "").startswith("sharpfield.cli"), name(page)
                module = importlib.import_module(node.module or "")
                missing = [alias.name for alias in node.names if not hasattr(module, alias.name)]
                assert not missing, f"{name(page)}: {node.module} has no {', '.join(missing)}"
            if isinstance(node, ast.Attribute) and ast.unparse(node).startswith("sf."):
                assert resolves(ast.unparse(node)), f"{name(page)}: {ast.unparse(node)}"


def resolves(dotted: str) -> bool:
    """Whether `sf.events.edi`, or `events.counts.count` of the package, is there."""
    first, *rest = dotted.split(".")
    found: Any = sharpfield
    for part in rest if first == "sf" else [first, *rest]:
        if not re.fullmatch(r"\w+", part):
            return False
        if not hasattr(found, part):
            try:
                importlib.import_module(f"{found.__name__}.{part}")
            except (ImportError, AttributeError):
                return False
        found = getattr(found, part)
    return True


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


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_quoted_files_exist(page: Path) -> None:
    """`formation/mixing.py: mix, mix_of_few`: from the package or the top, with what it defines."""
    for span in spans(page):
        match = FILE.fullmatch(span)
        if match is None or match[1].startswith(TOLD):
            continue
        file = next((one / match[1] for one in (SOURCE, ROOT) if (one / match[1]).exists()), None)
        if match[1].endswith(".json") and file is None and "/" not in match[1]:
            continue  # a file that a command writes
        assert file is not None, f"{name(page)}: {span}"
        for one in (match[2] or "").split(", "):
            assert not one or one in defined(file), f"{name(page)}: {span}"


@functools.cache
def defined(file: Path) -> frozenset[str]:
    """Names that a module defines at its top, and `Class.name`."""
    found = set()
    for node in ast.parse(file.read_text()).body:
        names = named(node)
        found |= names
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{one}" for inner in node.body for one in named(inner)}
    return frozenset(found)


def named(node: ast.AST) -> set[str]:
    """What a statement gives a name to."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return {node.name}
    if isinstance(node, ast.Assign | ast.AnnAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        return {
            one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)
        }
    return set()


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_quoted_folders_exist(page: Path) -> None:
    """`captures/layouts/`, where the first name is one of our folders."""
    for span in spans(page):
        if FOLDER.fullmatch(span) and span.split("/")[0] in {*ROOMS, *TOPS}:
            assert (SOURCE / span).is_dir() or (ROOT / span).is_dir(), f"{name(page)}: {span}"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_quoted_names_exist(page: Path) -> None:
    """`sf.events.edi`, `geometry.se3.exp`, and options of recipes: `sampling.views`."""
    groups = {option.split(".")[0] for option in recipe_options() if "." in option}
    for span in spans(page):
        match = DOTTED.match(span)
        if match is None or Path(match[0]).suffix in FILES or "/" in span or match[0] in FIELDS:
            continue
        if match[1] in {"sf", *ROOMS, *groups}:
            assert match[0] in recipe_options() or resolves(match[0]), f"{name(page)}: {span}"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_quoted_programs_exist(page: Path) -> None:
    """`python -m benchmarks.decode --runs 7`, with the flags that they take."""
    for module, file, rest in PROGRAM.findall(page.read_text()):
        if module in OTHERS:
            continue
        path = ROOT / (file or module.replace(".", "/") + ".py")
        path = path if path.exists() else path.with_suffix("") / "__main__.py"
        assert path.exists(), f"{name(page)}: {module or file}"
        given = {flag.replace("-", "_") for flag in FLAG.findall(rest.partition("`")[0])}
        assert given <= arguments_of(path), f"{name(page)}: {module or file}{rest}"


def test_nothing_that_can_be_chosen_is_left_out() -> None:
    """Every command, recipe, layout, format, sensor, metric and lens is on a page."""
    text = "".join(page.read_text() for page in PAGES if page.name != "api.md")
    registries = (command_line.COMMANDS, RECIPES, LAYOUTS, FORMATS, SENSORS, METRICS, LENSES)
    names = {name for registry in registries for name in registry} - {"pinhole"}
    assert not (missing := {name for name in names if f"`{name}`" not in text}), missing


def test_quoted_errors_are_as_they_are_raised() -> None:
    code = "".join(file.read_text() for file in SOURCE.rglob("*.py"))
    for page in PAGES:
        for text in ERROR.findall(page.read_text()):
            pattern = re.escape(text).replace("poses", r"(poses|\{known\})")
            assert re.search(pattern, code), f"{name(page)}: {text}"


def test_files_and_names_that_are_missing_are_noticed(tmp_path: Path) -> None:
    assert "mix_with_few_gradients" in defined(SOURCE / "formation" / "mixing.py")
    assert "Capture.depth" in defined(SOURCE / "core" / "capture.py")
    assert not resolves("events.nothing.there") and resolves("events.counts")
    assert "sampling.views" in recipe_options() and "sampling.looks" not in recipe_options()
