"""Random numbers: one seed in the yaml, split per node by its name, so that a new node changes no other's."""

import zlib

import numpy as np


def generator(seed: int, node: str) -> np.random.Generator:
    """The generator of `node` in a flow with `seed` (>= 0)."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(zlib.crc32(node.encode()),)))
