"""Options of a training, and how a vector field is matched to pairs (paper, Eq. loss, first term).

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
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

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


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class CheckOptions:
    """When a training may end before its last step: as soon as refinement will succeed from where it is.

    The check refines the networks' V by itself, with parameters of its own, so that other parameters of
    the regression or of the refinement train nothing again.

    Attributes
    ----------
    first, every
        Steps before the first check, and between checks.
    degree
        Highest power of V in the check.
    residual
        Largest relative Hamilton–Jacobi residual after it.
    difference
        Largest relative difference of V from the local route's in any well, beside what their residuals
        explain.
    attempts
        Trainings from fresh networks, if a training ends without having passed; every second one in another
        way, see `TrainingOptions.attempt`.
    """

    first: Annotated[int, Field(ge=1)] = 1000
    every: Annotated[int, Field(ge=1)] = 500
    degree: Annotated[int, Field(ge=2, le=12)] = 4
    residual: Annotated[float, Field(gt=0)] = 0.05
    difference: Annotated[float, Field(gt=0)] = 0.02
    attempts: Annotated[int, Field(ge=1)] = 2


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class TrainingOptions:
    """How the networks are trained; every one of these changes the result.

    The defaults are those of a short training, a minute or less on one core, that ends as soon as its check
    passes. The paper's own are spelled out in the studies ``*-published``.

    Attributes
    ----------
    widths
        Neurons in the hidden layers of both networks.
    steps
        Steps of Adam, at most.
    check
        When a training may end earlier; None takes all its steps.
    batch_size
        Pairs in the first term of the loss, and representative points in the second, per step.
    representative_share
        Share of the pairs of a batch that are drawn from the representative ones, the rest from all. The
        paper has 0; above it the loss weighs the region away from the attractors more, where pairs are
        few and fast.
    learning_rate, decay_rate, decay_steps
        The rate is ``learning_rate * decay_rate ** (step / decay_steps)``.
    orthogonality_weight
        λ.
    asymmetry
        δ of w(z, δ).
    matching, matching_order
        The pair-matching rule, see `siq.networks.options`.
    relative_dynamics
        Divide the first term of the loss by the mean square of the observed velocities, so that λ means
        the same for every system and in any units. The paper does not.
    slow_speed
        Judge the mismatch of every pair by its own speed, or by this share of the root mean square speed
        where it is slower. Left out: by the same measure everywhere, as the paper does, and the fastest
        region rules. For pairs without noise only, which would add to the speed.
    thinning_distance
        r, the distance between representative points, in the units of the states. Left out: a tenth of
        each state's standard deviation, whatever the units.
    slowest_share
        Share of the representative points that train, those where the observed velocities are slowest.
        Below 1 the networks learn the surroundings of the attractors and leave the fast region far out.
    normalise_on
        The points from which μ, σ, η_v and η_g are estimated. ``pairs``: all training pairs, as the paper
        does. ``representative``: the evenly spread ones. Trajectories crowd at attractors, where f is
        small and some states hardly vary: estimated there, the scales start V several times too small and
        too narrow, and a short training ends in a V that is flat along a direction.
    potential_from
        What η_v is estimated from. ``speed``: ∣∇V∣ is as large as the observed speed, as in the paper.
        ``descent``: -D∇V is the part of the observed velocity that goes down the initial V. Where the
        rotation is many times faster than the descent the former starts V as many times too steep.
    potential_gain
        Factor on η_v; the paper has 1. A larger one lets V learn faster beside g, which a short training
        needs: otherwise g takes over what V has not yet learned, and V stays flat along a direction.
    training_share
        Share of the recordings that train; the others measure the held-out loss.
    precision
        Floating-point type of the networks.
    """

    widths: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)] = (50, 50, 50)
    steps: Annotated[int, Field(ge=1)] = 4000
    check: CheckOptions | None = CheckOptions()
    batch_size: Annotated[int, Field(ge=1)] = 256
    representative_share: Annotated[float, Field(ge=0, le=1)] = 1.0
    learning_rate: Annotated[float, Field(gt=0)] = 5e-3
    decay_rate: Annotated[float, Field(gt=0, le=1)] = 0.95
    decay_steps: Annotated[float, Field(gt=0)] = 40.0
    orthogonality_weight: Annotated[float, Field(ge=0)] = 1.0
    asymmetry: Annotated[float, Field(ge=0)] = 0.1
    matching: MatchingRule = "explicit"
    matching_order: Order = 2
    relative_dynamics: bool = True
    slow_speed: Annotated[float, Field(gt=0)] | None = None
    thinning_distance: Annotated[float, Field(gt=0)] | None = None
    slowest_share: Annotated[float, Field(gt=0, le=1)] = 1.0
    normalise_on: Literal["pairs", "representative"] = "representative"
    potential_from: Literal["speed", "descent"] = "speed"
    potential_gain: Annotated[float, Field(gt=0)] = 3.0
    training_share: Annotated[float, Field(gt=0, lt=1)] = 0.7
    precision: Literal["float32", "float64"] = "float32"

    def attempt(self, number: int) -> TrainingOptions:
        """What a training is told that comes after `number` trainings that failed.

        What failed once is likelier to succeed in another way than once more: every second training has a λ
        ten times as large, starts V as steep as f descends, leaves out the faster half of the states, and,
        where the pairs are free of noise, judges each by its own speed. Which of the two ways a system
        needs is known of none beforehand: the first fails where f turns much faster than it descends, the
        second where V is to be steep.
        """
        if number % 2 == 0:
            return self
        return replace(
            self,
            orthogonality_weight=10 * self.orthogonality_weight,
            potential_from="descent",
            potential_gain=1.0,
            slowest_share=0.5 * self.slowest_share,
            slow_speed=(self.slow_speed or 0.1) if self.matching == "symmetric" else self.slow_speed,
        )
