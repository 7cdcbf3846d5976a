"""Sampling without replacement and without a table: a keyed permutation of 0 ... n-1.

A Feistel network of four rounds permutes the numbers of an even count of bits; results outside 0
... n-1 are permuted again until they are inside ("cycle walking"). Any position of the shuffled
order is computed by itself, so an epoch over a billion events needs no memory, and position 7
million is as cheap as position 0.

Source: Black and Rogaway, *Ciphers with Arbitrary Finite Domains* (CT-RSA 2002).
"""

import numpy as np
from jaxtyping import Int64, UInt64

from sharpfield.core.seed import number

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
