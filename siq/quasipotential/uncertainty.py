"""How far does the uncertainty of f, and of D, carry V off, at every state?

Changes δf of f and δD of D change V, to first order, by

    δV(x) = -∫ (p·δf + p·δD p) dt,    p = ∇V,

along the path ``dx/dt = f + 2D∇V`` that ends at x. It is a characteristic of the Hamilton–Jacobi equation,
along which the action is stationary, so that the path itself need not be changed. V is zero at the attractor,
wherever f moves that to. The integral is linear in the coefficients of f and of D; their covariance does the
rest.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from siq.inference.field_estimate import AnyField, GivenField, IdentifiedField
from siq.systems.equilibria import hessian_at

RELAXATIONS = 12.0  # times 1/slowest rate: e^-12 of V is left at the beginning of a path
STEP = 0.3  # of 1/fastest rate: Heun's rule is then good to some per cent of an error
FEWEST_STEPS, MOST_STEPS = 200, 4000  # numerical
FAR = 3.0  # of the box's width from its middle: a path so far out does not come from the attractor
ARRIVED = 0.02  # of the box's width: as far from the attractor a path may begin, V being known by its square
UNKNOWN = 0.1  # share of the points whose error may stay unknown, at the rim of a well


def potential_errors(
    found: AnyField,
    gradient: Callable[[np.ndarray], np.ndarray],
    attractor: np.ndarray,
    x: np.ndarray,
) -> np.ndarray:
    """Standard errors of ``V(x) - V(attractor)``, from what is not known of f, and of a D that was estimated.

    Parameters
    ----------
    found
        f with the covariance of its coefficients, and its doubts about which terms there are; D likewise.
    gradient
        ∇V, points ``(n, d)`` to ``(n, d)``.
    attractor
        From which V rises, shape ``(d,)``.
    x
        Where to tell, shape ``(n, d)``.

    Returns
    -------
    numpy.ndarray
        Shape ``(n,)``; zero where f carries no noise, NaN where no ascending path comes from the attractor.
    """
    if isinstance(found, GivenField) or found.noise_free or not len(x):
        return np.zeros(len(x))
    of_field, of_noise = potential_slopes(found, gradient, attractor, x)
    return np.asarray(np.sqrt(found.variance(of_field) + found.noise_variance(of_noise)))


def potential_slopes(
    found: IdentifiedField,
    gradient: Callable[[np.ndarray], np.ndarray],
    attractor: np.ndarray,
    x: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """∂V/∂Ξ at points, by every coefficient that f might have, and ∂V/∂θ by those of an estimated εD.

    Shapes ``(n, q, d)`` and ``(n, k)``; NaN as above.

    Parameters
    ----------
    found, gradient, attractor, x
        As of `potential_errors`.
    """
    dynamics = found.dynamics
    rates = -np.linalg.eigvals(dynamics.jacobian(attractor[None])[0]).real
    places = np.concatenate([x, attractor[None]])
    middle, width = (places.max(axis=0) + places.min(axis=0)) / 2, np.ptp(places, axis=0)
    # Of a few points some state may hardly differ: paths to them use what V allows them in each.
    hessian, offset = hessian_at(dynamics, attractor), x - attractor
    highest = float(np.einsum("ni,ij,nj->n", offset, hessian, offset).max())
    width = np.maximum(width, np.sqrt(highest * np.diag(np.linalg.inv(hessian))))
    width = np.where(width > 0, width, 1.0)
    scaled = dynamics.jacobian(x) * width / width[:, None]
    fastest = float(np.quantile(np.linalg.norm(scaled, axis=(1, 2)), 0.99))
    duration = RELAXATIONS / rates.min()
    steps = int(np.clip(duration * fastest / STEP, FEWEST_STEPS, MOST_STEPS))
    step = duration / steps

    q, d = found.library.size, found.library.dimension

    def back(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope = gradient(points)
        velocity = -(dynamics.drift(points) + 2 * dynamics.diffusion.push(points, slope))
        of_field = np.einsum("nq,nd->nqd", found.library.evaluate(points), slope).reshape(len(points), -1)
        return velocity, np.column_stack([of_field, found.noise_slopes(points, slope)])

    total = np.zeros((len(x), 1))
    lost = np.zeros(len(x), dtype=bool)
    with np.errstate(over="ignore", invalid="ignore"):
        velocity, integrand = back(x)
        for _ in range(steps):
            moved = x + step / 2 * (velocity + back(x + step * velocity)[0])
            lost |= ~(np.abs(moved - middle) < FAR * width).all(axis=1)
            x = np.where(lost[:, None], x, moved)
            velocity, following = back(x)
            total = total - step / 2 * (integrand + following)
            integrand = following
    lost |= ~(np.abs(x - attractor) < ARRIVED * width).all(axis=1)
    total = np.where(lost[:, None], np.nan, total)
    return total[:, : q * d].reshape(-1, q, d), total[:, q * d :]


def relative_error(
    found: AnyField,
    gradient: Callable[[np.ndarray], np.ndarray],
    attractor: np.ndarray,
    x: np.ndarray,
    values: np.ndarray,
) -> float:
    """Root mean square of the standard errors of V over that of V; see `potential_errors`.

    Parameters
    ----------
    found, gradient, attractor, x
        As there.
    values
        V at the points, zero at the attractor, shape ``(n,)``.

    Returns
    -------
    float
        Infinite where the errors of more than a tenth of the points cannot be told.
    """
    if isinstance(found, GivenField) or found.noise_free or not len(x):
        return 0.0
    errors = potential_errors(found, gradient, attractor, x)
    known = np.isfinite(errors)
    if known.mean() < 1 - UNKNOWN:
        return np.inf
    return float(np.linalg.norm(errors[known]) / np.linalg.norm(values[known]))
