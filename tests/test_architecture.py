"""The floors of the house. A file may import from lower floors and from its own folder."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "src" / "sharpfield"
FLOORS = [
    ["core"],
    ["geometry", "ops"],
    ["events"],
    ["storage"],
    (
        "recordings captures sampling formation fields rendering losses metrics simulation report"
    ).split(),
    ["initialisation"],
    "recipes training preparation evaluation twin".split(),
    ["runs"],
    ["cli"],
]
FLOOR = {name: floor for floor, names in enumerate(FLOORS) for name in names}
LINES, FUNCTION, ARGUMENTS = 400, 60, 8


def modules(root: Path = ROOT) -> list[Path]:
    return [p for p in sorted(root.rglob("*.py")) if p.parent != root]


def folder(path: Path, root: Path = ROOT) -> str:
    return path.relative_to(root).parts[0]


def imported_folders(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and top folder of each of our own imports, those inside functions too."""
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            parts = name.split(".")
            if parts[0] == "sharpfield" and len(parts) > 1 and parts[1] in FLOOR:
                yield node.lineno, parts[1]


def climbing_imports(root: Path = ROOT) -> list[str]:
    return [
        f"{path.relative_to(root)}:{line} {folder(path, root)} imports {other}"
        for path in modules(root)
        for line, other in imported_folders(ast.parse(path.read_text()))
        if other != folder(path, root) and FLOOR[other] >= FLOOR[folder(path, root)]
    ]


def oversized(root: Path = ROOT) -> list[str]:
    wrong = []
    for path in modules(root):
        text = path.read_text()
        where = str(path.relative_to(root))
        if (lines := text.count("\n")) > LINES:
            wrong.append(f"{where}: {lines} lines > {LINES}")
        for function in ast.walk(ast.parse(text)):
            if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            name = f"{where}:{function.lineno} {function.name}"
            doc = ast.get_docstring(function, clean=False) or ""
            body = function.end_lineno - function.lineno + 1 - doc.count("\n") - bool(doc)
            if body > FUNCTION:
                wrong.append(f"{name}: {body} lines > {FUNCTION}")
            arguments = function.args.posonlyargs + function.args.args + function.args.kwonlyargs
            count = len([a for a in arguments if a.arg not in ("self", "cls")])
            if count > ARGUMENTS:
                wrong.append(f"{name}: {count} arguments > {ARGUMENTS}")
    return wrong


def test_every_folder_has_a_floor():
    assert {folder(path) for path in modules()} <= FLOOR.keys()


def test_no_one_looks_up_or_sideways():
    wrong = climbing_imports()
    assert not wrong, "\n".join(wrong)


def test_files_and_functions_stay_small():
    wrong = oversized()
    assert not wrong, "\n".join(wrong)


def test_postponed_annotations_are_absent():
    """They would turn shapes into strings, which jaxtyping does not check."""
    wrong = [p for p in modules() if "from __future__ import annotations" in p.read_text()]
    assert not wrong


@pytest.mark.parametrize(
    ("file", "line"),
    [
        ("core/camera.py", "from sharpfield.geometry import cast"),
        ("fields/mlp.py", "import sharpfield.rendering.volume"),
        ("losses/edi.py", "def late():\n    from sharpfield import captures"),
        ("training/loop.py", "from sharpfield.recipes import RECIPES"),
    ],
)
def test_a_planted_climb_is_found(tmp_path: Path, file: str, line: str):
    planted = tmp_path / file
    planted.parent.mkdir()
    planted.write_text(line + "\n")
    assert len(climbing_imports(tmp_path)) == 1


def test_planted_sizes_are_found(tmp_path: Path):
    planted = tmp_path / "core" / "big.py"
    planted.parent.mkdir()
    body = "    pass\n" * FUNCTION
    planted.write_text(f"def f(a, b, c, d, e, *, g, h, i, j):\n{body}" + "\n" * LINES)
    assert [message.split(" > ")[1] for message in oversized(tmp_path)] == ["400", "60", "8"]
