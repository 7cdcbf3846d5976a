"""What a run was started with, as JSON beside it: recipe, options, capture, seed."""

import dataclasses
import json
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sharpfield.core.errors import RunError
from sharpfield.core.files import write_json
from sharpfield.recipes import recipe_named

FILE = "recipe.json"


@dataclass(frozen=True)
class RunConfig:
    """Everything needed to build a run's model again."""

    name: str
    """Of the recipe."""
    recipe: Any
    """With all its numbers."""
    capture: str
    """Folder it was trained on."""
    seed: int
    use: tuple[str, ...] = ("frames", "events")
    """Which streams of the capture were used."""
    reading: dict[str, Any] = field(default_factory=dict)
    """How the capture was read, where its layout was not believed: options of `captures.read`."""
    block: str = ""
    """Which part of a long capture it was trained on, "2/4"; "" for all of it."""

    def settings(self) -> dict[str, Any]:
        """As JSON; the length of the schedule is the run's own."""
        return {
            "recipe": self.name,
            "capture": self.capture,
            "seed": self.seed,
            "use": list(self.use),
            "reading": self.reading,
            **({"block": self.block} if self.block else {}),
            "options": dataclasses.asdict(self.recipe),
        }


def write_run_config(run: Path, started: RunConfig) -> None:
    """Write `RUN/recipe.json`."""
    write_json(run / FILE, started.settings())


def read_run_config(run: Path) -> RunConfig:
    """Read `RUN/recipe.json`.

    Raises:
        RunError: It is missing or damaged, or names an option this version does not know.
    """
    path = run / FILE
    try:
        table = json.loads(path.read_text())
        recipe = from_table(recipe_named(table["recipe"]), table["options"])
        return RunConfig(
            table["recipe"],
            recipe,
            table["capture"],
            int(table["seed"]),
            tuple(table["use"]),
            dict(table.get("reading", {})),
            table.get("block", ""),
        )
    except FileNotFoundError:
        raise RunError(
            "this is not a run", where=run, got=f"no {FILE}", do="name a folder that `train` made"
        ) from None
    except (ValueError, TypeError, KeyError) as error:
        said = error.args[0] if error.args else error
        raise RunError("cannot be read", where=path, got=said, do="train anew") from None


def from_table(kind: type, table: Any) -> Any:
    """A dataclass from nested plain values; unknown keys are errors.

    Raises:
        KeyError: The table names something the dataclass does not have.
        TypeError: It is not a table.
    """
    if not isinstance(table, dict):
        raise TypeError(f"{kind.__name__} needs a table of options, not {table!r}")
    hints = typing.get_type_hints(kind)
    fields = {f.name for f in dataclasses.fields(kind)}
    if unknown := table.keys() - fields:
        raise KeyError(f"{kind.__name__} has no option {', '.join(sorted(unknown))}")
    return kind(**{name: _value(hints[name], value) for name, value in table.items()})


def _value(hint: Any, value: Any) -> Any:
    if dataclasses.is_dataclass(hint):
        return from_table(typing.cast(type, hint), value)
    if isinstance(value, list):
        return tuple(value)
    if typing.get_origin(hint) in (types.UnionType, typing.Union) and isinstance(value, dict):
        kinds = [k for k in typing.get_args(hint) if dataclasses.is_dataclass(k)]
        return from_table(typing.cast(type, kinds[0]), value)
    return value
