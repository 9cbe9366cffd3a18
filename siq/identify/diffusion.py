"""Which D? As given; else as the noise of the recordings shows it; else the unit matrix, and it is said.

Recordings fix only the product εD, and without noise nothing of it. D is a matter of units: if the unit of
one state is changed and D is not, another problem is posed. So the unit matrix is no answer for states of
different units.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

import numpy as np

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure
from siq.identify.identified_field import IdentifiedField


class DiffusionSource(StrEnum):
    """Where D is from, and what has to be said of it."""

    GIVEN = "given"
    ESTIMATED = "estimated"
    OF_VELOCITIES = "estimated of velocities"
    UNIT = "unit"
    UNIT_OF_VELOCITIES = "unit of velocities"

    @property
    def note(self) -> str | None:
        """What a reader of U has to know; nothing where D was given."""
        return {
            DiffusionSource.GIVEN: None,
            DiffusionSource.ESTIMATED: "D is estimated from the noise of the recordings, since none was"
            " given, and scaled to the determinant 1: ε has the size of the noise, and U is in the unit of ε",
            DiffusionSource.OF_VELOCITIES: "D is estimated from the recorded positions, and its part that"
            " acts on the velocities, the only one there is, scaled to the determinant 1: ε has the size of"
            " the random forces, and U is in the unit of ε",
            DiffusionSource.UNIT: "D is taken as the unit matrix, since none was given and the recordings do"
            " not show it: U, barriers and times follow from it",
            DiffusionSource.UNIT_OF_VELOCITIES: "D is taken as the unit matrix of the velocities, since the"
            " recordings show no random forces: U and barriers follow from it, and times need the strength of"
            " the noise",
        }[self]


UNLIKE_GIVEN = (
    "the noise is stronger at some states than at others, and the D that was given is the same everywhere:"
    " leave it out, or give formulas of the states"
)
STANDARD_ERRORS = 4.0  # derived: chance passes it once in 16 000 pairs of states


def estimated_diffusion(found: IdentifiedField, *, pairs: int) -> Diffusion | None:
    """D as the residuals show it, of determinant 1; None where there is none to be shown.

    States whose noises show no significant correlation have none: an entry of D from chance alone would bring
    a term into g that nothing else asks for.

    The scale of D is a matter of convention, since a factor goes into ε. The determinant, unlike the trace
    or the largest eigenvalue, changes by a mere factor when the unit of one state does. Noise that is alike
    in all directions has the unit matrix, but for the error of the diagonal.

    Parameters
    ----------
    found
        f with the covariance of its residuals.
    pairs
        Number of independent residuals behind it: a correlation of none has the standard error 1/√pairs.

    Returns
    -------
    Diffusion or None
        None without noise, where noise does not reach every state, and where a state is but the derivative
        of another: what its residuals show is the noise of the other, and depends on the step of the pairs.
    """
    if found.noise_free or defined_states(found.dynamics):
        return None
    # To the last bit symmetric, as sums over the pairs are not.
    rate = (found.noise_rate + found.noise_rate.T) / 2
    size = np.sqrt(np.diag(rate))
    correlated = np.abs(rate) > STANDARD_ERRORS / np.sqrt(pairs) * np.outer(size, size)
    rate = np.where(correlated | np.eye(len(rate), dtype=bool), rate, 0.0)
    try:
        whole = Diffusion(rate)
    except ValueError:
        return None
    if not whole.regular:
        return None
    logarithm = float(np.linalg.slogdet(rate)[1])
    return Diffusion(rate / np.exp(logarithm / len(rate)))


def check_units(states: Sequence[str], units: Sequence[str | None]) -> None:
    """Refuse the unit matrix where states are known to have different units.

    Parameters
    ----------
    states
        Their names.
    units
        The unit of each, None where nobody said.

    Raises
    ------
    NumericalFailure
        With both states, and how D is given.
    """
    known = [(name, unit.strip()) for name, unit in zip(states, units, strict=True) if unit]
    other = next(((name, unit) for name, unit in known if unit != known[0][1]), None)
    if other is None:
        return
    (first, one), (second, two) = known[0], other
    raise NumericalFailure(
        f"D is not known: {first} is in {one} and {second} is in {two}, so that no unit matrix can stand for"
        " it, and the recordings carry no white noise that shows it; give D, up to a factor, as"
        " 'recordings.diffusion' of the study, or in Python as StateSpace(diffusion=...)"
    )


def defined_states(dynamics: Dynamics) -> list[str]:
    """States whose equation is another state, but for a factor: ``dx/dt = v``, which no noise drives."""
    return [
        name
        for name, own, formula in zip(dynamics.states, dynamics.symbols, dynamics.formulas, strict=True)
        if formula.as_coeff_Mul()[1] in set(dynamics.symbols) - {own}
    ]
