"""Random generators keyed by (seed, step, stream): the only source of randomness.

Nothing in the project counts steps or uses the global generator, so what is drawn at step 700 does
not depend on how step 700 was reached, and a resumed run equals an uninterrupted one.
"""

import hashlib

import numpy as np
import torch
from jaxtyping import Shaped


def number(seed: int, step: int, stream: str) -> int:
    """A 63-bit number that depends on all three, and on nothing else."""
    digest = hashlib.blake2b(f"{seed}/{step}/{stream}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


def generator(
    seed: int, step: int, stream: str, device: torch.device | str = "cpu"
) -> torch.Generator:
    """A torch generator for one purpose at one step.

    Args:
        seed: The run's seed.
        step: The training step; 0 for what happens before training.
        stream: What it is for, e.g. "pixels"; different streams are independent.
        device: Where the random tensors will be made.
    """
    made = torch.Generator(device)
    made.manual_seed(number(seed, step, stream))
    return made


def numpy_generator(seed: int, step: int, stream: str) -> np.random.Generator:
    """The same for numpy."""
    return np.random.default_rng(number(seed, step, stream))


def evenly_spread(rows: Shaped[np.ndarray, "n *_"], most: int) -> Shaped[np.ndarray, "m *_"]:
    """At most `most` rows in their order, evenly spread: all, or the first, the last, and between.

    Args:
        rows: Of any kind.
        most: How many; a single one is the first.
    """
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).round().astype(np.int64)]
