"""How are velocities told that nobody measured? States (x, v) of which recordings have x alone.

The first half of the states are positions, the other half their velocities. ``dx/dt = v`` holds by
definition, and random forces act on velocities. What is sought is the force, ``dv/dt = f(x, v)``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sympy

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.parametric import symbol
from siq.errors import NumericalFailure
from siq.estimation.estimation import fit_by_filter
from siq.estimation.innovations import Noise
from siq.estimation.measurements import Measurements
from siq.identify.library import CandidateLibrary

FIRST = 0.01  # of what positions move by: a force to begin with; the search goes up and down from it
LEAST_SAMPLES = 20  # of a recording, by which its first velocity is told beside its noise


def velocity_names(positions: Sequence[str]) -> tuple[str, ...]:
    """The names of the velocities: ``v_x`` of x.

    Raises
    ------
    NumericalFailure
        Where a recorded column has that name already.
    """
    names = tuple(f"v_{name}" for name in positions)
    if taken := set(names) & set(positions):
        raise NumericalFailure(
            f"{min(taken)} is recorded and would be the name of a hidden velocity as well; leave"
            " 'hidden_velocities' out if the velocities are recorded, or rename the column"
        )
    return names


def definitions(library: CandidateLibrary) -> np.ndarray:
    """Component and term of each ``dx/dt = v``, shape ``(d/2, 2)``."""
    half = library.dimension // 2
    return np.array([(i, library.terms.index(library.symbols[half + i])) for i in range(half)])


def with_definitions(
    library: CandidateLibrary, support: np.ndarray, values: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Terms of the forces with those of ``dx/dt = v`` before them, whose coefficients are exactly 1.

    Parameters
    ----------
    library
        Of positions and velocities.
    support, values, covariance
        Of the forces: shapes ``(p, 2)``, ``(p,)`` and ``(p, p)``.
    """
    known = definitions(library)
    count = len(known)
    whole = np.zeros((count + len(values),) * 2)
    whole[count:, count:] = covariance
    return np.concatenate([known, support]), np.concatenate([np.ones(count), values]), whole


def without_definitions(
    library: CandidateLibrary, support: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The terms of the forces alone."""
    force = support[:, 0] >= library.dimension // 2
    return support[force], values[force]


def seen_positions(plain: Dynamics) -> Dynamics:
    """Dynamics of forces alone, with ``dx/dt = v`` and with positions for their outputs."""
    half = plain.dimension // 2
    names, symbols = plain.states[:half], [symbol(name) for name in plain.states]
    return Dynamics(
        states=plain.states,
        equations=(*symbols[half:], *plain.equations[half:]),
        diffusion=plain.diffusion,
        parameters=plain.parameters,
        outputs=tuple(zip(names, symbols[:half], strict=True)),
    )


def force_noise(sensor: np.ndarray, rate: np.ndarray) -> Noise:
    """Both noises: variances of the sensors ``(d/2,)``, and what drives the velocities, ``(d/2, d/2)``."""
    half = len(sensor)
    shape, process = np.eye(2 * half), np.zeros(2 * half)
    process[half:] = np.diag(rate)
    if process.any():
        size = np.sqrt(np.diag(rate))
        shape[half:, half:] = rate / np.outer(size, size)
    return Noise(sensor, process, shape[None])


def force_diffusion(rate: np.ndarray) -> tuple[Diffusion, float]:
    """D and ε of forces that noise drives: the part of D that acts on velocities has the determinant 1.

    Without noise it is the unit matrix there, and ε is zero.

    Parameters
    ----------
    rate
        What noise adds to the covariance of the velocities in a unit of time, shape ``(d/2, d/2)``.
    """
    half = len(rate)
    forced = bool(rate.any())
    intensity = float(np.exp(np.linalg.slogdet(rate)[1] / half)) if forced else 0.0
    matrix = np.zeros((2 * half, 2 * half))
    matrix[half:, half:] = (rate + rate.T) / 2 / intensity if forced else np.eye(half)
    return Diffusion(matrix), intensity


def smoothed_motion(data: Measurements, names: Sequence[str]) -> tuple[np.ndarray, Noise]:
    """Positions and velocities to begin with, and both noises, when nothing but noise drives the velocities.

    That model is linear: its smoother is a spline through the measured positions whose stiffness the
    likelihood tells, and no start matters.

    Parameters
    ----------
    data
        Of positions.
    names
        Of positions.

    Returns
    -------
    states, noise
        Shape ``(n, d)``, positions before velocities.

    Raises
    ------
    NumericalFailure
        Where recordings are too short for it, or its likelihood cannot be worked out.
    """
    if np.diff(data.first).min() < LEAST_SAMPLES:
        raise NumericalFailure(
            f"a recording has fewer than {LEAST_SAMPLES} samples, by which its velocity is not told; leave it"
            " out"
        )
    half = len(names)
    states = (*names, *velocity_names(names))
    free = seen_positions(Dynamics(states, (sympy.S.Zero,) * (2 * half), Diffusion.identity(2 * half)))
    begins = data.begins
    rate = (data.outputs[begins + 1] - data.outputs[begins]) / np.diff(data.t)[begins, None]
    velocity = np.zeros_like(data.outputs)
    velocity[begins] = rate
    step = float(np.median(np.diff(data.t)[begins]))
    begin = FIRST * (rate**2).mean(axis=0) / step
    fit = fit_by_filter(
        free, data, x=np.concatenate([data.outputs, velocity], axis=1),
        noise=force_noise(data.with_known_noise(data.roughness), np.diag(begin)), closure=False,
    )  # fmt: skip
    if fit.fault:
        raise NumericalFailure(f"the velocities cannot be worked out: {fit.fault}")
    return fit.x, fit.noise
