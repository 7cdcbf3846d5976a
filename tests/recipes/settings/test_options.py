"""Options of recipes by name: their meanings, changes, old names."""

from dataclasses import dataclass, field, replace
from typing import ClassVar

import pytest

from sharpfield.core.errors import Hint, OptionError
from sharpfield.recipes import RECIPES, names_in_source, recipe_named
from sharpfield.recipes.settings.options import changed, current_name, options_of, with_options
from sharpfield.recipes.settings.presets import Presets


@dataclass(frozen=True)
class Sampling:
    views: int = 3
    """Views in each step."""
    crop: bool = True


def many(recipe: "Toy") -> "Toy":
    """Many views."""
    return replace(recipe, sampling=replace(recipe.sampling, views=9))


@dataclass(frozen=True)
class Toy:
    presets: ClassVar[Presets] = Presets(sizes={"many": many}, renamed={"lots": "many"})
    renamed: ClassVar[dict[str, str]] = {"looks": "sampling", "sampling.few": "sampling.views"}
    steps: int = 5
    """Length of the
    schedule."""
    sampling: Sampling = field(default_factory=Sampling)


def test_options_have_names_values_and_meanings() -> None:
    found = options_of(Toy())
    assert list(found) == ["steps", "sampling.views", "sampling.crop"]
    assert found["steps"].meaning == "Length of the schedule."
    assert found["sampling.views"].value == 3 and found["sampling.views"].kind is int


def test_options_are_changed_by_name() -> None:
    toy = with_options(Toy(), {"steps": 2, "sampling.views": 7})
    assert toy == Toy(2, Sampling(7))
    assert changed(Toy(), ("sampling.crop=False", "steps=4")) == Toy(4, Sampling(crop=False))


def test_old_names_give_a_hint() -> None:
    with pytest.warns(Hint, match="looks.views is now sampling.views"):
        assert with_options(Toy(), {"looks.views": 8}).sampling.views == 8
    with pytest.warns(Hint, match="sampling.few is now sampling.views"):
        assert current_name(Toy(), "sampling.few") == "sampling.views"
    with pytest.warns(Hint, match="lots is now many"):
        assert Toy.presets.named("lots", "toy") == ["many"]


def test_unknown_names_are_answered_with_similar_ones() -> None:
    with pytest.raises(OptionError, match=r"did you mean sampling\.views"):
        with_options(Toy(), {"sampling.view": 8})
    with pytest.raises(OptionError, match="did you mean many"):
        Toy.presets.named("man", "toy")
    with pytest.raises(OptionError, match="did you mean hybrid"):
        recipe_named("hybird")


@pytest.mark.parametrize("name", list(RECIPES))
def test_every_option_of_every_recipe_has_a_meaning(name: str) -> None:
    recipe = recipe_named(name)()
    silent = [one.name for one in options_of(recipe).values() if not one.meaning]
    assert not silent
    for preset, change in recipe.presets.all.items():
        assert (change.__doc__ or "").strip(), preset
        assert options_of(change(recipe)).keys()
    found = names_in_source(name)
    assert found is not None and {*recipe.presets.all, *recipe.presets.renamed} <= found.presets
    assert found is not None and options_of(recipe).keys() <= found.options
    assert {*getattr(recipe, "renamed", {})} <= found.old
    assert set(getattr(recipe, "renamed", {}).values()) <= {
        *options_of(recipe),
        *(one.rpartition(".")[0] for one in options_of(recipe)),
    }
