"""Pair matching: how a vector field is held against the pairs (X0, Xh) (paper, Eq. loss, first term).

The loss compares ``(I_h(X0; f) - Xh)/h``, that is the integrator's mean velocity over the pair with the
observed ``Y = (Xh - X0)/h``. A rule of order p has a bias of O(h^p) in f.

===========  =====  ===========  ==========================================================
kind         order  evaluations  when to use it
===========  =====  ===========  ==========================================================
explicit     2      2            the paper's rule (Runge's midpoint); noisy pairs, since only X0 enters f
explicit     4      4            the classical Runge–Kutta rule; noisy pairs with a large h
symmetric    2      1            implicit midpoint ``f((X0 + Xh)/2)``: cheapest, noise-free pairs only
symmetric    4      3            Hermite–Simpson: noise-free pairs, unbiased to O(h⁴)
===========  =====  ===========  ==========================================================

The symmetric rules put Xh into f: with noise in Xh that correlates the regressor with its error and
biases f by as much as the noise is strong.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:  # options name the rules, and who only reads options need not wait for torch
    from torch import Tensor

MatchingRule = Literal["explicit", "symmetric"]
Order = Literal[2, 4]


def mean_velocity(
    vector_field: Callable[[Tensor], Tensor],
    x0: Tensor,
    xh: Tensor,
    h: Tensor,
    *,
    kind: MatchingRule,
    order: Order,
) -> Tensor:
    """Mean velocity over the pair that the vector field predicts, to be compared with (Xh - X0)/h.

    Parameters
    ----------
    vector_field
        f at points of shape ``(..., d)``.
    x0, xh
        The two snapshots, shape ``(..., d)``.
    h
        Time between them, shape ``(..., 1)``.
    kind, order
        The rule, see the table above.

    Returns
    -------
    torch.Tensor
        Shape ``(..., d)``.
    """
    match kind, order:
        case "explicit", 2:
            return vector_field(x0 + h / 2 * vector_field(x0))
        case "explicit", 4:
            k1 = vector_field(x0)
            k2 = vector_field(x0 + h / 2 * k1)
            k3 = vector_field(x0 + h / 2 * k2)
            k4 = vector_field(x0 + h * k3)
            return (k1 + 2 * (k2 + k3) + k4) / 6
        case "symmetric", 2:
            return vector_field((x0 + xh) / 2)
        case "symmetric", 4:
            start, end = vector_field(x0), vector_field(xh)
            middle = vector_field((x0 + xh) / 2 + h / 8 * (start - end))
            return (start + 4 * middle + end) / 6
    raise ValueError(f"there is no {kind} matching rule of order {order}; use order 2 or 4")
