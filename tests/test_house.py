"""The tree as a stranger reads it: few rooms, small rooms, files that are worth opening."""

import ast
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "src" / "sharpfield"
FILES, IN_A_FOLDER, DEPTH = 300, 18, 2
SMALL = 60
WORTH_IT = {"_shapes.py": "imports numpy, which `_lazy.py` must not"}
"""Small modules with a single importer that are worth a file of their own, and why."""


def modules(root: Path = ROOT) -> list[Path]:
    return sorted(root.rglob("*.py"))


def dotted(path: Path, root: Path) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(["sharpfield", *(part for part in parts if part != "__init__")])


def crowded(root: Path = ROOT) -> list[str]:
    held = Counter(path.parent for path in modules(root))
    return [
        f"{folder.relative_to(root)}: {count} files"
        for folder, count in held.items()
        if count > IN_A_FOLDER
    ]


def deep(root: Path = ROOT) -> list[str]:
    return [
        str(path.relative_to(root))
        for path in modules(root)
        if len(path.relative_to(root).parts) > DEPTH + 1
    ]


def imported(path: Path) -> set[str]:
    """Our modules that a file imports, inside functions too; names in strings count as well."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.add(node.value.split(":")[0])
    return found


def lonely(root: Path = ROOT) -> list[str]:
    """Small modules that only one other module uses."""
    users: Counter[str] = Counter()
    for path in modules(root):
        users.update(imported(path) - {dotted(path, root)})
    return [
        f"{path.relative_to(root)}: {lines} lines, one importer"
        for path in modules(root)
        if not path.name.startswith("__")
        and str(path.relative_to(root)) not in WORTH_IT
        and (lines := path.read_text().count("\n")) < SMALL
        and users[dotted(path, root)] == 1
    ]


def shadowing(root: Path = ROOT) -> list[str]:
    """Public functions and classes that are named as the module they stand in."""
    return [
        f"{path.relative_to(root)}: {node.name}"
        for path in modules(root)
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == path.stem
    ]


def without_a_paper(root: Path = ROOT) -> list[str]:
    """Files of `recipes/` itself in which no class names its paper."""
    return [
        path.name
        for path in sorted((root / "recipes").glob("*.py"))
        if path.name != "__init__.py" and "paper: ClassVar[Paper]" not in path.read_text()
    ]


def test_there_are_not_too_many_files():
    assert len(modules()) <= FILES


@pytest.mark.parametrize("rule", [crowded, deep, lonely, shadowing, without_a_paper])
def test_the_tree_can_be_read(rule):
    wrong = rule()
    assert not wrong, "\n".join(wrong)


def test_every_exception_is_still_needed():
    assert all((ROOT / name).exists() for name in WORTH_IT)


def plant(root: Path, name: str, text: str) -> None:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_planted_faults_are_found(tmp_path: Path):
    for i in range(IN_A_FOLDER + 1):
        plant(tmp_path, f"full/f{i}.py", "")
    plant(tmp_path, "a/b/c/deep.py", "")
    plant(tmp_path, "a/tiny.py", "X = 1\n")
    plant(tmp_path, "a/user.py", "from sharpfield.a.tiny import X\n")
    plant(tmp_path, "a/walk.py", "def walk():\n    pass\n")
    plant(tmp_path, "recipes/helpers.py", "")
    assert crowded(tmp_path) == [f"full: {IN_A_FOLDER + 1} files"]
    assert deep(tmp_path) == ["a/b/c/deep.py"]
    assert lonely(tmp_path) == ["a/tiny.py: 1 lines, one importer"]
    assert shadowing(tmp_path) == ["a/walk.py: walk"]
    assert without_a_paper(tmp_path) == ["helpers.py"]
