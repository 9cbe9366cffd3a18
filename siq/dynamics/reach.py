"""Does noise reach every state, and in which units are states measured that it does not reach directly?

Noise that acts on velocities alone moves positions all the same: dx/dt = v. It *reaches* a state if it acts
on it, or on a state that stands in its equation, or on one that stands in the equation of that one, and so
on. About an equilibrium with Jacobian J this is Kalman's condition: the linear dynamics can be steered
everywhere by D = σσᵀ if ``(σ, Jσ, J²σ, …)`` has full rank, and then, and only then, W of ``J W + W Jᵀ =
-2D`` is regular (`siq.dynamics.equilibria.hessian_at`).

References
----------
J. Zabczyk, SIAM J. Control Optim. 23 (1985) 278: exit problems where noise acts on some states only.
"""

from __future__ import annotations

import numpy as np

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import classify, hessian_at
from siq.errors import NumericalFailure


def unreached_states(dynamics: Dynamics) -> tuple[str, ...]:
    """The states that no noise reaches, directly or through the equations; none of them if all is well.

    Examples
    --------
    >>> import sympy
    >>> x, v, w = sympy.symbols("x v w", real=True)
    >>> pushed = [[0, 0, 0], [0, 1, 0], [0, 0, 0]]
    >>> unreached_states(Dynamics.of((x, v, w), (v, -x - v + w, -w), diffusion=pushed))
    ('w',)
    """
    rows = dynamics.diffusion.formulas
    reached = {
        own for own, row in zip(dynamics.symbols, rows, strict=True) if any(entry != 0 for entry in row)
    }
    while True:
        further = {
            own
            for own, formula in zip(dynamics.symbols, dynamics.formulas, strict=True)
            if own not in reached and formula.free_symbols & reached
        }
        if not further:
            return tuple(
                name
                for name, own in zip(dynamics.states, dynamics.symbols, strict=True)
                if own not in reached
            )
        reached |= further


def measure_at(dynamics: Dynamics, attractor: np.ndarray) -> Diffusion:
    """In which metric speeds and slopes are measured about an attractor: D, or what stands in for it.

    Where D has no inverse, ``|f|² = f·D⁻¹f`` has no meaning. In its place stands ``K = -(tr J / d) W``: the
    mean rate of relaxation times the spread of states per noise. For ``f = -D∇V`` with relaxation as fast in
    every direction it is D.

    Parameters
    ----------
    dynamics
        f and D.
    attractor
        Shape ``(d,)``.

    Raises
    ------
    NumericalFailure
        When noise does not reach every state about the attractor, or it is none.
    """
    if dynamics.diffusion.regular:
        return dynamics.diffusion
    if classify(dynamics, attractor).kind != "attractor":
        raise NumericalFailure(
            f"{attractor.tolist()} is no stable equilibrium; where noise acts on some states only, speeds"
            " have a measure about stable equilibria alone"
        )
    relaxation = -float(np.trace(dynamics.jacobian(attractor[None])[0])) / dynamics.dimension
    return Diffusion(relaxation * np.linalg.inv(hessian_at(dynamics, attractor)))
