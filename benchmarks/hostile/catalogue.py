"""All kinds, and those that nobody looks at while the tests of a certificate are built."""

from __future__ import annotations

import numpy as np

from benchmarks.hostile import memories, mixtures, sensors, shapes, signals
from benchmarks.hostile.kinds import KINDS

__all__ = ["FAMILIES", "HELD_OUT", "KINDS", "KNOWN"]

FAMILIES = {
    name: module.__name__.rsplit(".", 1)[-1]
    for module in (mixtures, memories, sensors, shapes, signals)
    for name in vars(module)
    if name in KINDS
}
"""Which module a kind is from."""

# These were known, and tried, before any test was built: they cannot be held out.
KNOWN = {
    "two_offsets", "joined_levels", "swinging_tilt", "hidden_slow_variable", "gate", "force_with_memory",
    "force_no_polynomial", "noise_no_polynomial",
}  # fmt: skip
DRAWN_WITH = 34  # the seed of the draw

_free = sorted(KINDS.keys() - KNOWN)
HELD_OUT = frozenset(np.random.default_rng(DRAWN_WITH).choice(_free, round(len(KINDS) / 5), replace=False))
"""A fifth of the kinds, drawn once: they are run at the end, and reported apart."""
