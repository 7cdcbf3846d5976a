"""Checkpoints of a run, from which training resumes exactly as if it had never stopped.

A checkpoint is one safetensors file: the model's and the optimizer's tensors, and in the header a
JSON record with a checksum over everything. Nothing in it can execute code. In
`RUN/checkpoints/` there are up to three:

- `last`: written every minute or every so many steps;
- `previous`: the one before, should `last` be damaged;
- `best`: weights alone, of the step with the best validation score.

Files are written under another name and then moved, so a killed process leaves `last` as it was.
They hold no times and no paths: two runs that did the same have the same bytes.
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.optim import Optimizer

from sharpfield.core.errors import RunError
from sharpfield.core.files import replacing
from sharpfield.core.protocols import Model, PointSet
from sharpfield.training.optim import module_of, replace_parameters, resize

Settings = dict[str, Any]
"""What a run was started with, as JSON."""

HEADER = "sharpfield"
SUFFIX = ".safetensors"
START_AGAIN = "train again, into another folder"


@dataclass(frozen=True)
class TrainingProgress:
    """How far a run is."""

    step: int
    """Steps done, which is also the index of the next one."""
    planned_steps: int
    """Length of the whole run, and of its schedules."""
    micro_batches: int = 1
    """Micro-batches of each step."""
    best: float | None = None
    """Best validation score so far."""
    settings: Settings = field(default_factory=dict)
    """What the run was started with."""


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint as read, on the CPU."""

    progress: TrainingProgress
    tensors: dict[str, Tensor]


def file_of(run: Path, name: str) -> Path:
    """Path of the checkpoint `last`, `previous` or `best` of a run."""
    return run / "checkpoints" / f"{name}{SUFFIX}"


def save_last(run: Path, model: Model, optimizer: Optimizer, progress: TrainingProgress) -> None:
    """Save everything needed to resume; the checkpoint before is kept as `previous`.

    Raises:
        RunError: A tensor is not finite; nothing has been written.
    """
    tensors = _model_tensors(model) | _optimizer_tensors(model, optimizer)
    last = file_of(run, "last")
    with replacing(last) as temporary:
        _write(temporary, tensors, progress)
        if last.exists():
            last.replace(file_of(run, "previous"))


def save_best(run: Path, model: Model, progress: TrainingProgress) -> None:
    """Save the weights alone."""
    with replacing(file_of(run, "best")) as temporary:
        _write(temporary, _model_tensors(model), progress)


def load(path: Path) -> Checkpoint:
    """Read one checkpoint.

    Raises:
        RunError: The file is missing, truncated, damaged or not ours.
    """
    if not path.is_file():
        raise RunError("there is no such checkpoint", where=path)
    try:
        with safe_open(path, framework="pt") as file:
            header = (file.metadata() or {}).get(HEADER)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise RunError(
            "a checkpoint cannot be read",
            where=path,
            got=f"{path.stat().st_size} bytes; {error}",
            do=START_AGAIN,
        ) from None
    checksum, progress = _unpacked(header, path)
    if checksum != _checksum(tensors, dataclasses.asdict(progress)):
        raise RunError(
            "a checkpoint is damaged", where=path, got="a wrong checksum", do=START_AGAIN
        )
    return Checkpoint(progress, tensors)


def recover(run: Path) -> tuple[Checkpoint | None, str]:
    """The newest complete checkpoint of a run, which becomes `last`.

    Partial files of a killed process are removed.

    Returns:
        The checkpoint, None if there is none yet; and a warning, empty if nothing was wrong.

    Raises:
        RunError: There are checkpoints, and none can be read.
    """
    for leftover in (run / "checkpoints").glob(f".*{SUFFIX}"):
        leftover.unlink()
    last, previous = file_of(run, "last"), file_of(run, "previous")
    if previous.exists() and not last.exists():
        previous.replace(last)  # killed between the two moves of `save_last`
    if not last.exists():
        return None, ""
    try:
        return load(last), ""
    except RunError as damaged:
        if not previous.exists():
            raise
        checkpoint = load(previous)
        previous.replace(last)
        step = checkpoint.progress.step
        return checkpoint, f"{damaged.what} ({last.name}): going back to step {step}"


def restore(checkpoint: Checkpoint, model: Model, optimizer: Optimizer) -> None:
    """Give model and optimizer the state of a checkpoint.

    Raises:
        RunError: It belongs to another model.
    """
    built = dict(module_of(model).named_parameters())
    restore_weights(checkpoint, model)
    parameters = dict(module_of(model).named_parameters())
    replace_parameters(optimizer, {old: parameters[name] for name, old in built.items()})
    optimizer.state.clear()
    for key, tensor in checkpoint.tensors.items():
        kind, _, rest = key.partition(".")
        if kind == "optimizer":
            moment, _, name = rest.partition(".")
            optimizer.state[parameters[name]][moment] = _like(parameters[name], tensor, optimizer)


def restore_weights(checkpoint: Checkpoint, model: Model) -> None:
    """Give a model the weights of a checkpoint, and as many points as it has.

    Raises:
        RunError: It belongs to another model.
    """
    prefix = "model."
    saved = {
        key.removeprefix(prefix): tensor
        for key, tensor in checkpoint.tensors.items()
        if key.startswith(prefix)
    }
    module = module_of(model)
    _resize_points(saved, module)
    state = _state(module)
    wrong = sorted(saved.keys() ^ state.keys()) + [
        f"{name} {list(saved[name].shape)} for {list(tensor.shape)}"
        for name, tensor in state.items()
        if name in saved and saved[name].shape != tensor.shape
    ]
    if wrong:
        raise RunError(
            "the checkpoint belongs to another model",
            got=", ".join(wrong[:4]) + (f" and {len(wrong) - 4} more" if len(wrong) > 4 else ""),
            do="use the recipe, the settings and the capture that the run was started with",
        )
    module.load_state_dict(saved, strict=False)  # what has two names was saved under one


def check_settings(saved: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuse to resume a run with other settings than it was started with.

    Raises:
        RunError: Names the settings that differ.
    """
    saved, now = _dotted(_as_json(saved)), _dotted(_as_json(now))
    differing = [key for key in sorted(saved.keys() | now.keys()) if saved.get(key) != now.get(key)]
    if differing:
        changes = [f"{key}: {saved.get(key)!r} before, {now.get(key)!r} now" for key in differing]
        raise RunError(
            "the settings differ from those the run was started with",
            got="; ".join(changes[:4]),
            do="resume with the same options, or train anew into another folder",
        )


def _dotted(nested: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Nested settings by dotted name, so that differences can be listed one by one."""
    found: dict[str, Any] = {}
    for name, value in nested.items():
        within = isinstance(value, Mapping)
        found |= _dotted(value, f"{before}{name}.") if within else {before + name: value}
    return found


def _unpacked(header: str | None, path: Path) -> tuple[str, TrainingProgress]:
    """Checksum and progress of a file's header."""
    try:
        written = json.loads(header or "")
        return written["checksum"], TrainingProgress(**written["progress"])
    except (ValueError, TypeError, KeyError):
        raise RunError(
            "not a checkpoint of sharpfield, or one of another version",
            where=path,
            do=f"name a run's own folder, or {START_AGAIN}",
        ) from None


def _write(path: Path, tensors: dict[str, Tensor], progress: TrainingProgress) -> None:
    ill = [name for name, tensor in tensors.items() if not torch.isfinite(tensor).all()]
    if ill:
        raise RunError(
            "not saving a state that is not finite",
            where=f"step {progress.step}",
            got=", ".join(ill[:4]),
            do="resume from the last good checkpoint with a lower learning rate",
        )
    written = _as_json(dataclasses.asdict(progress))
    header = {"checksum": _checksum(tensors, written), "progress": written}
    save_file(tensors, path, metadata={HEADER: json.dumps(header)})


def _model_tensors(model: Model) -> dict[str, Tensor]:
    state = _state(module_of(model))
    return {f"model.{name}": tensor.detach().cpu().contiguous() for name, tensor in state.items()}


def _state(module: nn.Module) -> dict[str, Tensor]:
    """What a module would save, each tensor under the first of its names."""
    first = {name for name, _ in [*module.named_parameters(), *module.named_buffers()]}
    return {name: tensor for name, tensor in module.state_dict().items() if name in first}


def _optimizer_tensors(model: Model, optimizer: Optimizer) -> dict[str, Tensor]:
    return {
        f"optimizer.{moment}.{name}": tensor.detach().cpu().contiguous()
        for name, parameter in module_of(model).named_parameters()
        for moment, tensor in optimizer.state.get(parameter, {}).items()
    }


def _resize_points(saved: Mapping[str, Tensor], module: nn.Module) -> None:
    """Resize each point set to the number of points that was saved."""
    for path, part in module.named_modules():
        if isinstance(part, PointSet):
            place = f"{path}." if path else ""
            rows = [saved.get(place + name) for name in part.points()]
            counts = {len(tensor) for tensor in rows if tensor is not None and tensor.ndim}
            if len(counts) == 1:  # otherwise the checkpoint is of another model: see the caller
                resize(part, counts.pop())


def _like(parameter: Tensor, saved: Tensor, optimizer: Optimizer) -> Tensor:
    """A saved moment on the device and in the memory layout that the optimizer expects."""
    if saved.ndim == parameter.ndim and saved.shape == parameter.shape:
        return torch.empty_like(parameter).copy_(saved)
    counted_on_device = optimizer.defaults["fused"] or optimizer.defaults["capturable"]
    return saved.to(parameter.device if counted_on_device else "cpu")


def _checksum(tensors: dict[str, Tensor], progress: Mapping[str, Any]) -> str:
    digest = hashlib.sha256(json.dumps(progress, sort_keys=True).encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {list(tensor.shape)}".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _as_json(settings: Mapping[str, Any]) -> dict[str, Any]:
    """As it is read back from JSON: tuples become lists."""
    return json.loads(json.dumps(settings))
