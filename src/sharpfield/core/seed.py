"""Random generators keyed by (seed, step, stream): the only source of randomness.

Nothing in the project counts steps or uses the global generator, so what is drawn at step 700 does
not depend on how step 700 was reached, and a resumed run equals an uninterrupted one.

Sampling without replacement and without a table: a keyed permutation of 0 ... n-1.

A Feistel network of four rounds permutes the numbers of an even count of bits; results outside 0
... n-1 are permuted again until they are inside ("cycle walking"). Any position of the shuffled
order is computed by itself, so an epoch over a billion events needs no memory, and position 7
million is as cheap as position 0.

Source: Black and Rogaway, *Ciphers with Arbitrary Finite Domains* (CT-RSA 2002).
"""

import hashlib

import numpy as np
import torch
from jaxtyping import Int64, Shaped, UInt64


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


ROUNDS = 4


def shuffled(
    position: Int64[np.ndarray, "*b"], n: int, *, seed: int, epoch: int
) -> Int64[np.ndarray, "*b"]:
    """The numbers at some positions of 0 ... n-1, shuffled for this seed and epoch.

    Args:
        position: 0 to n-1.
        n: Count of the numbers; at most 2^62.
        seed: The run's seed.
        epoch: Every epoch has its own order.

    Raises:
        ValueError: A position is outside 0 ... n-1.
    """
    if position.size and not (0 <= position.min() and position.max() < n):
        raise ValueError(f"shuffled: positions must be 0 to {n - 1}")
    half = np.uint64(max((n - 1).bit_length() + 1, 2) // 2)
    keys = [np.uint64(number(seed, epoch, f"shuffled/{turn}")) for turn in range(ROUNDS)]
    drawn = _feistel(position.astype(np.uint64).ravel(), half, keys)
    outside = np.flatnonzero(drawn >= n)
    while outside.size:
        drawn[outside] = _feistel(drawn[outside], half, keys)
        outside = outside[drawn[outside] >= n]
    return drawn.astype(np.int64).reshape(position.shape)


def _feistel(
    value: UInt64[np.ndarray, " b"], half: np.uint64, keys: list[np.uint64]
) -> UInt64[np.ndarray, " b"]:
    mask = (np.uint64(1) << half) - np.uint64(1)
    left, right = value >> half, value & mask
    for key in keys:
        left, right = right, left ^ (_mixed(right ^ key) & mask)
    return (left << half) | right


def _mixed(x: UInt64[np.ndarray, " b"]) -> UInt64[np.ndarray, " b"]:
    """Spread every input bit over all output bits (the finaliser of splitmix64)."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
