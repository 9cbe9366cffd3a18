"""Designs: which cases there are, as far as that can be said before anything is simulated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.proof.cases import turns
from benchmarks.proof.foreign.effects import LAWS
from benchmarks.proof.foreign.systems import FAMILIES

KINDS = ("null", "shift", "withheld")
NOISE_LEVELS = (40.0, 30.0, 20.0)
STRENGTHS = (0.05, 0.7)  # rms of the effect over that of what it is added to, the rate or the reading
IN_SENSOR = (0.03, 0.3)  # the same where it is a sensor's


@dataclass(frozen=True)
class ForeignDesign:
    """What is decided of a case beforehand.

    Attributes
    ----------
    name
        Its neutral name.
    kind
        One of `KINDS`; ``withheld`` since no dictionary has what is concealed.
    family
        Of systems.
    law
        Kind of the function that is concealed; None for nulls and shifts.
    shifted
        Whether the card has wrong parameters.
    strength
        From 0 to 1, where between the weakest and the strongest effect; on a logarithmic scale.
    noise_db
        Signal-to-noise ratio of the sensors, in decibels.
    seed
        Seed of everything else.
    """

    name: str
    kind: str
    family: str
    law: str | None
    shifted: bool
    strength: float
    noise_db: float
    seed: int


def draw_cases(*, count: int, seed: int, shares: Mapping[str, float]) -> list[ForeignDesign]:
    """Decide which cases there are.

    Parameters
    ----------
    count
        Their number.
    seed
        The same seed draws the same cases.
    shares
        Share of each of `KINDS`; respected to within one case.

    Raises
    ------
    ValueError
        For other kinds, or shares that do not sum to one.
    """
    if set(shares) - set(KINDS) or abs(sum(shares.values()) - 1) > 1e-9:
        raise ValueError(f"shares {dict(shares)} are not shares of {', '.join(KINDS)} that sum to 1")
    rng = np.random.default_rng(seed)
    edges = np.round(count * np.cumsum(list(shares.values()))).astype(int)
    kinds = np.repeat(list(shares), np.diff(edges, prepend=0))
    families = {kind: turns(list(FAMILIES), rng) for kind in shares}
    noise = {kind: turns(list(NOISE_LEVELS), rng) for kind in shares}
    laws, shifted = turns(list(LAWS), rng), turns([True, False], rng)
    drawn: list[dict[str, Any]] = []
    for kind in map(str, kinds):
        concealed = kind == "withheld"
        drawn.append(
            {
                "kind": kind,
                "family": next(families[kind]),
                "law": next(laws) if concealed else None,
                "shifted": kind == "shift" or (concealed and next(shifted)),
                "strength": float(rng.random()),
                "noise_db": next(noise[kind]),
                "seed": int(rng.integers(2**63)),
            }
        )
    order = rng.permutation(len(drawn))
    return [ForeignDesign(name=f"case-{number:04d}", **drawn[i]) for number, i in enumerate(order, start=1)]
