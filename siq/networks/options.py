"""What a training is told: every option of it changes the result."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from siq.networks.matching import MatchingRule, Order


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
        The pair-matching rule, see `siq.networks.matching`.
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
