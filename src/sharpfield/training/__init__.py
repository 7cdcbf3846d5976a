"""Training a model: the loop, its optimizer, hooks, checkpoints, logs and memory plan.

Knows `Model`, knows no recipe. `train` is a whole run in a folder; `fit` is the loop alone.
"""

from sharpfield.training.checkpoint import Checkpoint, Progress, file_of, load, restore_weights
from sharpfield.training.fit import Hook, fit
from sharpfield.training.hooks import every, every_seconds, finite
from sharpfield.training.memory import plan_parts
from sharpfield.training.optim import adam, set_rates
from sharpfield.training.plan import Build, Options, Plan
from sharpfield.training.record import Ledger, read_ledger
from sharpfield.training.train import require_unused, train

__all__ = [
    "Build",
    "Checkpoint",
    "Hook",
    "Ledger",
    "Options",
    "Plan",
    "Progress",
    "adam",
    "every",
    "every_seconds",
    "file_of",
    "finite",
    "fit",
    "load",
    "plan_parts",
    "read_ledger",
    "require_unused",
    "restore_weights",
    "set_rates",
    "train",
]
