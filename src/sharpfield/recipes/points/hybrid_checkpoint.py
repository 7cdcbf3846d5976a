"""Checkpoints of the released code of Hybrid Neural Rendering, read as tensors only.

A `*_net_ray_marching.pth` holds the points (`neural_points.*`) and the networks (`aggregator.*`).
It is opened without running anything it may contain. A head that the code keeps but never uses
(`color_branch`) is ignored; the network of learned kernels is there only if it was trained.
"""

import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from sharpfield.core.errors import RunError
from sharpfield.fields.neural_points import ColourHead, NeuralPoints, PointField
from sharpfield.formation.patch_kernel import ChosenKernel, LearnedKernel
from sharpfield.recipes.points.images import ImageBranch

POINTS = {
    "positions": "xyz",
    "descriptors": "points_embeding",
    "confidence": "points_conf",
    "colours": "points_color",
    "directions": "points_dir",
}
"""Our names, and theirs under `neural_points.`, spelled as released."""

STAGES = ("aux_block_s1", "aux_block_s2", "aux_block_s3")


def read_released(path: Path) -> dict[str, Tensor]:
    """The tensors of a checkpoint by their names in the released code.

    Raises:
        RunError: The file is missing, holds something else, or more than tensors.
    """
    if not path.is_file():
        raise RunError("there is no such checkpoint", where=path)
    try:
        table = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, zipfile.BadZipFile, ValueError) as why:
        raise RunError(
            "a checkpoint cannot be read as tensors alone",
            where=path,
            got=str(why).splitlines()[0],
            do="give a `*_net_ray_marching.pth` as the released code saves it",
        ) from None
    if not isinstance(table, Mapping) or not recognised(table):
        raise RunError(
            "this is not a checkpoint of Hybrid Neural Rendering",
            where=path,
            got=", ".join(map(str, list(table)[:4])) if isinstance(table, Mapping) else table,
            do="give a `*_net_ray_marching.pth`; those of `*_states.pth` hold no networks",
        )
    return {str(name): rows for name, rows in table.items() if isinstance(rows, Tensor)}


def recognised(table: Mapping[str, object]) -> bool:
    """Whether names are those of the released code, with its images' branch."""
    wanted = [f"neural_points.{theirs}" for theirs in POINTS.values()]
    wanted += ["aggregator.block1.0.weight", "aggregator.color_final_block.0.weight"]
    return all(name in table for name in wanted)


def load_released(
    path: Path,
    field: PointField,
    head: ColourHead,
    images: ImageBranch | None,
    blur: ChosenKernel | LearnedKernel | None,
) -> None:
    """Load a released checkpoint into points and networks.

    Args:
        path: Path of the checkpoint.
        field: Its points become those of the checkpoint.
        head: Colour head.
        images: Image branch, if there is one.
        blur: Gets the kernel network, if both have one.

    Raises:
        RunError: The file is no such checkpoint, or the networks have other sizes.
    """
    table = read_released(path)
    parts: list[tuple[nn.Module, str]] = [
        (field.reading.layers, "block1"),
        (field.seeing.layers, "block3"),
        (field.to_density.layers, "alpha_branch"),
        (field.to_feature.layers, "color_feature_branch"),
        (head.layer.layers, "color_final_block"),
    ]
    if images is not None:
        parts += [
            (images.merging.network.layers, "aux_merge_weight_block"),
            (images.mixing.network.layers, "color_mixup_block"),
        ]
        parts += list(zip(images.extractor.stages, STAGES, strict=True))
    if isinstance(blur, LearnedKernel) and "aggregator.learn_blur_kernel_block.0.weight" in table:
        parts.append((blur.network.layers, "learn_blur_kernel_block"))
    for layers, name in parts:
        assert isinstance(layers, nn.ModuleList)
        _fill(layers, table, f"aggregator.{name}", path)
    _replace(field.points, table, path)


def _fill(layers: nn.ModuleList, table: Mapping[str, Tensor], name: str, path: Path) -> None:
    """Layers of a sequence, in which every second entry is an activation."""
    for index, layer in enumerate(layers):
        assert isinstance(layer, nn.Linear | nn.Conv2d)
        for kind, own in (("weight", layer.weight), ("bias", layer.bias)):
            theirs = f"{name}.{2 * index}.{kind}"
            assert own is not None
            _check(theirs, table.get(theirs), tuple(own.shape), path)
            with torch.no_grad():
                own.copy_(table[theirs])


def _replace(points: NeuralPoints, table: Mapping[str, Tensor], path: Path) -> None:
    values = {}
    count = len(table["neural_points.xyz"])
    for name, own in points.points().items():
        theirs = f"neural_points.{POINTS[name]}"
        rows = table[theirs]
        rows = rows[0] if rows.ndim == 3 and len(rows) == 1 else rows
        _check(theirs, rows, (count, own.shape[1]), path)
        values[name] = rows.float().contiguous()
    points.replace(values)


def _check(name: str, found: Tensor | None, wanted: tuple[int, ...], path: Path) -> None:
    if found is not None and tuple(found.shape) == wanted:
        return
    raise RunError(
        "the released checkpoint has other sizes than the recipe",
        where=f"{path}, {name}",
        got=f"{'nothing' if found is None else list(found.shape)} for {list(wanted)}",
        do="use --preset paper, and a capture in colour",
    )
