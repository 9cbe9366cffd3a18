"""How uncertain is a prefactor, and does it err together with its barrier?

K follows from f by determinants at both ends of the path and by an integral along it, and the path itself
moves with f. So f is changed by standard deviations along the axes of its covariance, the path found again
from the old one, forwards and back: half of what then differs in ln K and in ΔU, axis by axis, makes their
variances and their covariance. A D that was found as a formula of the state is changed with f.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure
from siq.identify.given_field import AnyField, GivenField
from siq.identify.identified_field import IdentifiedField
from siq.landscape.paths import MinimumActionPath, minimum_action_path
from siq.landscape.rates import escape_rate

MOST_AXES = 6  # of the covariance; of more, as many random ones stand for all: the error is good to 20 %
FEWEST = 0.5  # of the axes, on which the law has to hold: otherwise its error is not known
TOLERANCE = 1e-3  # of the action: both ends of a difference have the same error, and lose it
NODES = 60
NEWTON = 12
SETTLED = 1e-9  # of the distance from attractor to saddle, by which Newton's last step may still move
FARTHEST = 0.5  # of that distance: an equilibrium that moves by more is another one


@dataclass(frozen=True)
class PrefactorError:
    """The uncertainty of ln K from that of f and D.

    Attributes
    ----------
    standard_error
        Of ln K: relative, of K.
    covariance
        Of ln K and ΔU, in the unit of ε.
    """

    standard_error: float
    covariance: float


def prefactor_error(found: AnyField, path: MinimumActionPath, *, seed: int = 0) -> PrefactorError | None:
    """The uncertainty of the prefactor of a way out.

    Parameters
    ----------
    found
        f with the covariance of its coefficients.
    path
        Of least action from the attractor to the saddle.
    seed
        Of the axes, where there are more than `MOST_AXES`.

    Returns
    -------
    PrefactorError or None
        Zero where f carries no noise; None where the law holds for too few of the changed f.
    """
    if isinstance(found, GivenField) or found.noise_free:
        return PrefactorError(0.0, 0.0)
    changes = []
    covariance = found.covariance
    if found.noise is not None:
        covariance = scipy.linalg.block_diag(covariance, found.noise.covariance)
    axes = covariance_axes(covariance, np.random.default_rng(seed))
    for axis in axes:
        up, down = (_log_prefactor(_changed(found, one), path) for one in (axis, -axis))
        if up is not None and down is not None:
            changes.append(np.subtract(up, down) / 2)
    if len(changes) < FEWEST * len(axes):
        return None
    logarithm, barrier = np.array(changes).T * np.sqrt(len(axes) / len(changes))
    return PrefactorError(float(np.linalg.norm(logarithm)), float(logarithm @ barrier))


def _changed(found: IdentifiedField, change: np.ndarray) -> Dynamics:
    """The dynamics with the coefficients of f changed, and those of εD where it depends on the state."""
    count = len(found.values)
    dynamics = found.dynamics.with_values(found.values + change[:count])
    if found.noise is None:
        return dynamics
    noise = replace(found.noise, values=found.noise.values + change[count:])
    return replace(dynamics, diffusion=noise.diffusion(found.intensity))


def covariance_axes(covariance: np.ndarray, draw: np.random.Generator) -> Sequence[np.ndarray]:
    """Changes of the p coefficients whose outer products add up to the covariance, at most `MOST_AXES`.

    Of more than that a random rotation is taken of which the first ones, made longer, have it in the mean.
    """
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    root = root[:, root.any(axis=0)]  # what is known exactly, as in dx/dt = v, has no axis
    count = root.shape[1]
    if count <= MOST_AXES:
        return list(root.T)
    turned = np.linalg.qr(draw.standard_normal((count, MOST_AXES)))[0]
    return list((np.sqrt(count / MOST_AXES) * root @ turned).T)


def _log_prefactor(dynamics: Dynamics, path: MinimumActionPath) -> tuple[float, float] | None:
    """Ln K and ΔU of the same way out for a changed f; None where there is none, or the law does not hold."""
    ends = [equilibrium_near(dynamics, path, end) for end in (0, -1)]
    if ends[0] is None or ends[1] is None:
        return None
    try:
        again = minimum_action_path(
            dynamics, ends[0], ends[1], nodes=NODES, tolerance=TOLERANCE, initial=[path.points]
        )
        rate = escape_rate(dynamics, again)
    except (NumericalFailure, ValueError, np.linalg.LinAlgError):
        return None
    return (float(np.log(rate.prefactor)), again.action) if rate.prefactor > 0 else None


def equilibrium_near(dynamics: Dynamics, path: MinimumActionPath, end: int) -> np.ndarray | None:
    """Where f vanishes next to an end of a path, by Newton's method; None where it does not."""
    x = path.points[end].copy()
    distance = float(np.linalg.norm(path.points[-1] - path.points[0]))
    for _ in range(NEWTON):
        try:
            step = np.linalg.solve(dynamics.jacobian(x[None])[0], dynamics.drift(x[None])[0])
        except np.linalg.LinAlgError:
            return None
        x = x - step
        if not np.linalg.norm(x - path.points[end]) < FARTHEST * distance:
            return None
        if np.linalg.norm(step) < SETTLED * distance:
            return x
    return None
