"""Designs: which cases there are, as far as that can be said before any simulation.

A design is small, so that cases can be made from their designs in parallel.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.proof.cases import turns
from benchmarks.proof.concealment.catalogue import CATALOGUES
from benchmarks.proof.concealment.strengths import STRONGEST, WEAKEST
from benchmarks.proof.concealment.systems import SYSTEMS

KINDS = ("null", "shift", "mechanism", "process noise", "withheld")
NOISE_LEVELS = (40.0, 30.0, 20.0)
ALWAYS_WITHHELD: Mapping[str, tuple[str, ...]] = {
    "predator_prey": ("Allee effect", "delayed response"),
    # A stop beyond a gap is a backlash beside another stiffness.
    "oscillator": ("backlash",),
    "coupled_masses": ("backlash",),
}
"""Entries of the dictionary that are, or contain, an effect that this generator calls withheld."""
DECOYS = 0.15  # of the mechanical cases say "without hysteresis" though there is none


@dataclass(frozen=True)
class CaseDesign:
    """What is decided of a case before it is simulated.

    Attributes
    ----------
    name
        Its neutral name.
    system
        Name of its system.
    kind
        One of `KINDS`.
    mechanism
        Name of what is concealed; none for nulls and shifts.
    shifted
        Whether the card has wrong parameters.
    strength
        Which strength of the effect is aimed at.
    noise_db
        Signal-to-noise ratio of the measurement, in decibels.
    without
        Dictionary entries that the diagnosis is to do without.
    seed
        Seed of everything else.
    """

    name: str
    system: str
    kind: str
    mechanism: str | None
    shifted: bool
    strength: float | None
    noise_db: float
    without: tuple[str, ...]
    seed: int


def draw_cases(*, count: int, seed: int, shares: Mapping[str, float]) -> list[CaseDesign]:
    """Decide which cases there are.

    Parameters
    ----------
    count
        Their number.
    seed
        The same seed draws the same cases.
    shares
        Share of each kind, as in ``config/proof.yaml``; they are respected to within one case.

    Returns
    -------
    list of CaseDesign
        In an order that says nothing. Systems, and within each system the effects, take turns; half of the
        cases with an effect have wrong parameters as well.
    """
    if set(shares) - set(KINDS) or abs(sum(shares.values()) - 1) > 1e-9:
        raise ValueError(f"shares {dict(shares)} are not shares of {', '.join(KINDS)} that sum to 1")
    rng = np.random.default_rng(seed)
    kinds = np.repeat(list(shares), _whole_numbers(list(shares.values()), count))
    systems = {kind: turns(list(SYSTEMS), rng) for kind in shares}
    effects: dict[tuple[str, str], Iterator[str]] = {}
    noise = turns(list(NOISE_LEVELS), rng)
    shifted = turns([True, False], rng)
    drawn: list[dict[str, Any]] = []
    for kind in map(str, kinds):
        system = next(systems[kind])
        mechanism = None
        if kind not in ("null", "shift"):
            choices = {
                "mechanism": list(CATALOGUES[system].mechanisms),
                "process noise": ["process noise"],
                "withheld": list(CATALOGUES[system].withheld),
            }[kind]
            mechanism = next(effects.setdefault((kind, system), turns(choices, rng)))
        drawn.append(
            {
                "system": system,
                "kind": kind,
                "mechanism": mechanism,
                "shifted": kind == "shift" or (mechanism is not None and next(shifted)),
                "strength": log_uniform(WEAKEST, STRONGEST, rng) if mechanism else None,
                "noise_db": next(noise),
                "without": _without(system, kind, mechanism, rng),
                "seed": int(rng.integers(2**63)),
            }
        )
    order = rng.permutation(count)
    return [CaseDesign(name=f"case-{number:04d}", **drawn[i]) for number, i in enumerate(order, start=1)]


def _whole_numbers(shares: Sequence[float], count: int) -> list[int]:
    """Numbers that sum to `count`, as close to shares as possible: the largest remainders are rounded up."""
    wanted = np.array(shares) * count
    numbers = np.floor(wanted + 1e-9).astype(int)
    largest = np.argsort(numbers - wanted, kind="stable")[: count - numbers.sum()]
    numbers[largest] += 1
    return [int(number) for number in numbers]


def log_uniform(low: float, high: float, rng: np.random.Generator) -> float:
    """A number whose logarithm is uniformly distributed."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _without(system: str, kind: str, mechanism: str | None, rng: np.random.Generator) -> tuple[str, ...]:
    """Entries that the diagnosis has to do without; what is always withheld gives nothing away."""
    always = ALWAYS_WITHHELD.get(system, ())
    decoy = rng.random() < DECOYS
    if mechanism == "hysteresis":
        return (*always, "hysteresis") if kind == "withheld" else always
    # A study that does without hysteresis must not give away that this is what is concealed.
    hidden = decoy and "hysteresis" in CATALOGUES[system].mechanisms
    return (*always, "hysteresis") if hidden else always
