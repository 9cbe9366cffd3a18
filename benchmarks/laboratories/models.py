"""Which laboratories are there, and what do they measure?

Each is ``dx = f(x) dt + √q(x) dW`` (Itô) with polynomials f and q, which is ``√ε σ dW`` with ``εD = q·1``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

Monomial = tuple[int, ...]  # exponents, one for each state


@dataclass(frozen=True)
class Laboratory:
    """A system with process noise, and the instrument that records it.

    Attributes
    ----------
    name, title
        In one word, and in a line.
    states
        Their names.
    drift
        For each state its terms: the coefficient of each monomial.
    intensity
        The coefficients of q, by monomial; variance per unit of time, the same for every state.
    attractors, saddles
        Where they are, nearly.
    records, samples, step
        How many records, samples in each, and the time between two.
    within
        Euler–Maruyama steps between two samples.
    sensor_noise
        Standard deviation of what the instrument adds to each state.
    averaged
        Whether a sample is the mean of the state since the sample before (blur), or its value.
    diffusion_given
        Whether the analysis is told that D = 1. Then barriers are those of U, else those of U/ε.
    """

    name: str
    title: str
    states: tuple[str, ...]
    drift: tuple[Mapping[Monomial, float], ...]
    intensity: Mapping[Monomial, float]
    attractors: tuple[tuple[float, ...], ...]
    saddles: tuple[tuple[float, ...], ...]
    records: int
    samples: int
    step: float
    within: int = 10
    sensor_noise: tuple[float, ...] = ()
    averaged: bool = False
    diffusion_given: bool = True

    @property
    def dimension(self) -> int:
        """Number of states, d."""
        return len(self.states)

    @cached_property
    def sensor(self) -> np.ndarray:
        """Standard deviation of the instrument's noise, shape ``(d,)``."""
        return np.array(self.sensor_noise or (0.0,) * self.dimension)

    @cached_property
    def terms(self) -> tuple[tuple[int, Monomial], ...]:
        """State and monomial of each coefficient of f."""
        return tuple((place, each) for place, row in enumerate(self.drift) for each in row)

    @cached_property
    def coefficients(self) -> np.ndarray:
        """Of f, in the order of `terms`."""
        return np.array([self.drift[place][each] for place, each in self.terms])

    @cached_property
    def intensities(self) -> np.ndarray:
        """Coefficients of q."""
        return np.array(list(self.intensity.values()))

    @property
    def parameters(self) -> np.ndarray:
        """Coefficients of f, then those of q."""
        return np.concatenate([self.coefficients, self.intensities])

    def with_parameters(self, values: np.ndarray) -> Laboratory:
        """The same with other coefficients of f and q."""
        rows: list[dict[Monomial, float]] = [{} for _ in self.states]
        for (place, each), value in zip(self.terms, values[: len(self.terms)], strict=True):
            rows[place][each] = float(value)
        noise = dict(zip(self.intensity, map(float, values[len(self.terms) :]), strict=True))
        return replace(self, drift=tuple(rows), intensity=noise)

    def shorter(self, samples: int, records: int = 1) -> Laboratory:
        """The same with fewer samples."""
        return replace(self, samples=samples, records=records)


def maier_stein(name: str, intensity: float, sensor: float) -> Laboratory:
    """The records of the tryouts: eight of 200 s, β = 1, barrier 1/2 on both sides."""
    return Laboratory(
        name=name,
        title=f"Maier–Stein, ε = {intensity}, sensor noise {sensor}",
        states=("x", "y"),
        drift=({(1, 0): 1.0, (3, 0): -1.0, (1, 2): -1.0}, {(0, 1): -1.0, (2, 1): -1.0}),
        intensity={(0, 0): intensity},
        attractors=((1.0, 0.0), (-1.0, 0.0)),
        saddles=((0.0, 0.0),),
        records=8,
        samples=20_000,
        step=0.01,
        sensor_noise=(sensor, sensor),
    )


# The force is that of a symmetric double well; its two barriers differ since the noise grows to the right.
STATE_DEPENDENT = Laboratory(
    name="state-dependent",
    title="double well, noise grows to the right",
    states=("x",),
    drift=({(1,): 1.0, (3,): -1.0},),
    intensity={(0,): 0.15, (1,): 0.045, (2,): 0.045},
    attractors=((1.0,), (-1.0,)),
    saddles=((0.0,),),
    records=4,
    samples=25_000,
    step=0.02,
    diffusion_given=False,
)

# Paper 3.1: U = (x² - 1)² + y² + z², both barriers 1. 20 dB: a tenth of each state's standard deviation,
# which is about 0.9 in x, and √(ε/2) in y and z (U/ε = y²/ε + …).
ARCHETYPE = Laboratory(
    name="archetype",
    title="archetype in three states, sensor noise 20 dB",
    states=("x", "y", "z"),
    drift=(
        {(3, 0, 0): -2.0, (1, 0, 0): 2.0, (0, 1, 0): -1.0, (0, 0, 1): -1.0},
        {(0, 1, 0): -1.0, (3, 0, 0): 2.0, (1, 0, 0): -2.0},
        {(0, 0, 1): -1.0, (3, 0, 0): 2.0, (1, 0, 0): -2.0},
    ),
    intensity={(0, 0, 0): 0.25},
    attractors=((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
    saddles=((0.0, 0.0, 0.0),),
    records=4,
    samples=7_500,
    step=0.02,
    sensor_noise=(0.09, 0.035, 0.035),
)


def resonator() -> Laboratory:
    """Paper 3.2, the card's parameters. 30 dB: 0.032 of the standard deviations, 0.006 and 0.004."""
    drive, damping, cubic, force = 1.0018, 4.5e-4, 33.0, 1.4e-5
    detuning, bend = (1.0 - drive**2) / (2 * drive), 3 * cubic / (8 * drive)
    return Laboratory(
        name="resonator",
        title="the resonator's slow flow, sensor noise 30 dB",
        states=("P", "Q"),
        drift=(
            {(0, 1): detuning, (1, 0): -damping, (2, 1): bend, (0, 3): bend},
            {(1, 0): -detuning, (0, 1): -damping, (3, 0): -bend, (1, 2): -bend, (0, 0): -force / (2 * drive)},
        ),
        intensity={(0, 0): 3.5e-9},
        attractors=((-0.00710, -0.01090), (0.00411, -0.00117)),
        saddles=((0.00769, -0.00667),),
        records=4,
        samples=15_000,
        step=50.0,
        sensor_noise=(1.9e-4, 1.3e-4),
    )


def optical_trap() -> Laboratory:
    """A bead of half a micrometre in two foci; µm and s.

    Its energy is ``U/kT = 4 ((x/a)² - 1)² - 0.3 x/a``, its free diffusion 0.4 µm²/s. The camera's shutter is
    open all the time, and its pixels add 5 nm.
    """
    free, height, tilt, focus = 0.4, 4.0, 0.3, 0.25
    return Laboratory(
        name="trap",
        title="an optical trap with two foci, exposed over the whole step",
        states=("x",),
        drift=(
            {
                (1,): 4 * free * height / focus**2,
                (3,): -4 * free * height / focus**4,
                (0,): free * tilt / focus,
            },
        ),
        intensity={(0,): 2 * free},
        attractors=((focus,), (-focus,)),
        saddles=((0.0,),),
        records=1,
        samples=60_000,
        step=5e-4,
        sensor_noise=(0.005,),
        averaged=True,
        diffusion_given=False,
    )


LABORATORIES = {
    each.name: each
    for each in (
        STATE_DEPENDENT,
        ARCHETYPE,
        resonator(),
        optical_trap(),
        maier_stein("hop", 0.1, 0.0),
        maier_stein("hop-005", 0.1, 0.005),
        maier_stein("hop-02", 0.1, 0.02),
        maier_stein("hop-often", 0.2, 0.0),
        maier_stein("hop-often-005", 0.2, 0.005),
        maier_stein("hop-often-02", 0.2, 0.02),
    )
}
