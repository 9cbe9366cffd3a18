"""Inertia of a recorded position: whether the position alone is the state.

Two models of the same positions, with the same functions F and a noise of the sensor each:

    dx = F(x) dt + noise                               overdamped
    dx = v dt,  dv = γ (F(x) - v) dt + noise           with inertia; the first is its limit γ → ∞

Their log-likelihoods are compared at Schwarz's price, half of ln n for each parameter and first state. The
error of the difference is that of a sum over blocks of the record, as in Vuong's test of models that are both
an approximation. Where inertia is not seen, what is known is from which γ on it would have been.

References
----------
Q. H. Vuong, Likelihood ratio tests for model selection and non-nested hypotheses, Econometrica 57 (1989) 307.
G. Schwarz, Estimating the dimension of a model, Ann. Statist. 6 (1978) 461.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import sympy

from siq.data.recordings import Recordings
from siq.errors import NumericalFailure
from siq.inference.kalman_filter import Noise, whiten
from siq.inference.library import candidate_library
from siq.inference.maximum_likelihood import Fit, fit_by_filter
from siq.inference.observation import force_noise, seen_positions, smoothed_motion, unbroken, velocity_names
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter, symbol

BLOCKS = 40  # of the record: the error of a sum of so many is known to a tenth
INTERVAL = 1.96  # standard errors: of 95 % of a normal distribution
DROP = INTERVAL**2 / 2  # of a log-likelihood, at the ends of such an interval
SLIGHT = 0.1  # relaxation over friction, below which x alone is the state to within a tenth
WELL_GRID = 400  # numerical: points at which F is looked at in search of wells
HALVINGS = 6  # numerical: of the logarithm of γ, to 2 % of a factor of four
MAX_FRICTION = 10.0  # γ times the step, beyond which velocities are forgotten between samples to exp(-10)
MIN_FRICTION = 1e-6  # γ times the step, below which no γ is excluded


@dataclass(frozen=True)
class InertiaTest:
    """What recordings of one position say of its inertia.

    Attributes
    ----------
    gain, gain_error
        Log-likelihood of the model with inertia over that without, at Schwarz's price, and its standard
        error from blocks of the record.
    friction, friction_error
        γ and its standard error. Where inertia is not seen γ is a lower limit of 95 %, without an error.
    relaxation
        How fast x relaxes in the stiffest well if there is no inertia, ``-F'(x)``; 0 where there is no well.
    frequency, frequency_error
        ω of that well with inertia, ``√(-γ F'(x))``, and its standard error.
    step
        Time between samples.
    """

    gain: float
    gain_error: float
    friction: float
    friction_error: float | None
    relaxation: float
    frequency: float
    frequency_error: float
    step: float

    @property
    def seen(self) -> bool:
        """Whether the record speaks for inertia, by more than its error."""
        return self.gain > INTERVAL * self.gain_error and self.gain > 0

    @property
    def needs_velocity(self) -> bool:
        """Whether inertia is seen, and is so large that x alone is not the state."""
        return self.seen and not self.frequency**2 <= SLIGHT * self.friction**2

    @property
    def overdamped(self) -> bool:
        """Whether inertia is slight enough to be left out: it is not seen, and would have been."""
        return not self.seen and self.relaxation <= SLIGHT * self.friction

    @property
    def undecided(self) -> bool:
        """Whether the record cannot tell."""
        return not (self.seen or self.overdamped)

    def sentence(self, unit: str = "") -> str:
        """The answer in words, with its figures."""
        time = f" {unit}" if unit else ""
        rate = f" per {unit}" if unit else ""
        if self.seen:
            damped = self.friction / (2 * self.frequency) if self.frequency > 0 else np.inf
            kind = "it swings in its well" if damped < 1 else "it creeps back into its well without a swing"
            assert self.friction_error is not None
            swing = f", ω = {self.frequency:.3g} ± {self.frequency_error:.1g}" if self.frequency > 0 else ""
            return (
                f"the position has inertia: the log-likelihood with a velocity is larger by {self.gain:.0f} ±"
                f" {self.gain_error:.0f}, γ = {self.friction:.3g} ± {self.friction_error:.1g}{swing}{rate}"
                f" (γΔt = {self.friction * self.step:.2g}); {kind}"
            )
        if self.overdamped:
            return (
                f"no inertia is seen: with a velocity the log-likelihood changes by {self.gain:.0f} ±"
                f" {self.gain_error:.0f}, and γ is above {self.friction:.3g}{rate}, while wells relax with"
                f" {self.relaxation:.3g}{rate}"
            )
        needed = 1 / max(self.relaxation / SLIGHT, 1e-300)
        return (
            "whether the position has inertia cannot be told: with a velocity the log-likelihood changes by"
            f" {self.gain:.0f} ± {self.gain_error:.0f}, and γ may be anything above"
            f" {self.friction:.3g}{rate}, while wells relax with {self.relaxation:.3g}{rate}; a step of at"
            f" most {needed:.2g}{time}, or a less noisy sensor at a short step, would tell"
        )


def inertia_test(recordings: Recordings, *, degree: int = 5, pair_step: float | None = None) -> InertiaTest:
    """Ask recordings of one position whether it has inertia.

    Parameters
    ----------
    recordings
        Of one position.
    degree
        Highest power of x in F.
    pair_step
        Longest time between samples that still belong together.

    Raises
    ------
    NumericalFailure
        Where one of the models cannot be fitted, or there is more than one position.
    """
    models = _InertialModels(recordings, degree, pair_step)
    test = models.test()
    if test is not None and test.seen:
        return test
    if test is None:  # the samples show no γ
        fastest = MAX_FRICTION / models.step
        fit = models.with_friction(fastest)
        limit = models.least_friction(fit.log_likelihood, fastest)
        return InertiaTest(*models.compared(fit), limit, None, models.relaxation, np.nan, np.nan, models.step)
    best = models.without.log_likelihood + test.gain + models.price
    return replace(test, friction=models.least_friction(best, test.friction), friction_error=None)


def seen_inertia(
    recordings: Recordings, *, degree: int = 5, pair_step: float | None = None
) -> InertiaTest | None:
    """The test where inertia is seen, and None elsewhere: without the search for a limit of γ.

    The arguments, and what is raised, are those of `inertia_test`.
    """
    test = _InertialModels(recordings, degree, pair_step).test()
    return test if test is not None and test.seen else None


class _InertialModels:
    """Fits of the models with inertia, beginning with the smoothed motion, and of the one without."""

    def __init__(self, recordings: Recordings, degree: int, pair_step: float | None) -> None:
        if len(recordings.names) != 1:
            raise NumericalFailure("the test of inertia is of one position; select one column")
        self.data = unbroken(recordings, pair_step=pair_step)
        self.library = candidate_library(recordings.names, degree=degree)
        self.step = float(np.median(self.data.step[self.data.begins]))
        self.x, self.noise = smoothed_motion(self.data, recordings.names)
        # Schwarz's, of γ and of a first velocity of each record.
        self.price = float(np.log(len(self.data.t)) / 2 * (1 + len(self.data.labels)))
        names = [f"c{place}_{'_'.join(recordings.names)}" for place in range(self.library.size)]
        self._parameters = tuple(Parameter(name, 0.0) for name in names)
        terms = zip(names, self.library.terms, strict=True)
        self._force = sympy.Add(*(symbol(name) * term for name, term in terms))

    @cached_property
    def without(self) -> Fit:
        """The model without inertia."""
        data, begins = self.data, self.data.begins
        model = Dynamics(
            self.library.states, (self._force,), Diffusion.identity(1), parameters=self._parameters
        )
        moved = ((data.outputs[begins + 1] - data.outputs[begins]) ** 2).mean(axis=0)
        noise = Noise(0.1 * moved, moved / float(data.step[begins].mean()))
        fit = fit_by_filter(model, data, x=data.outputs, noise=noise, closure=False)
        if fit.fault:
            raise NumericalFailure(f"the model without inertia cannot be fitted: {fit.fault}")
        return fit

    @property
    def relaxation(self) -> float:
        """In the stiffest well of the model without inertia."""
        return self._stiffness(self.without.model.values, self.without.covariance)[0]

    def compared(self, fit: Fit) -> tuple[float, float]:
        """Log-likelihood of a fit over that without inertia, at its price, and the error of that.

        The error is from blocks of the record.
        """
        gain, data = fit.log_likelihood - self.without.log_likelihood - self.price, self.data
        length = max(len(data.t) // BLOCKS, 2)
        differences = []
        for begin, end in zip(data.first[:-1], data.first[1:], strict=True):
            bounds = np.linspace(begin, end, max(round((end - begin) / length), 1) + 1).astype(int)
            for low, high in itertools.pairwise(bounds):
                rows, values = slice(low, high), []
                part = replace(
                    data, labels=("block",), first=np.array([0, high - low]), t=data.t[rows],
                    outputs=data.outputs[rows], courses=((),),
                )  # fmt: skip
                for one in (fit, self.without):  # the first state of a block is unknown
                    white = whiten(one.linearisation.at_rows(rows), part, one.noise)
                    values.append(white.log_likelihood(float(white.innovations @ white.innovations)))
                differences.append(values[0] - values[1])
        if len(differences) < 2:
            return gain, np.inf
        return gain, float(np.std(differences, ddof=1) * np.sqrt(len(differences)))

    def test(self) -> InertiaTest | None:
        """The test with the γ that fits best; None where that is none that samples could show."""
        # With γF in terms of its own, and γ behind their coefficients.
        model = self._model(lambda force, v, friction: force - friction * v, fixed=False)
        best = fit_by_filter(model, self.data, x=self.x, noise=self.noise, closure=False)
        friction = best.model.values[-1]
        if not best.converged or best.fault or not 0 < friction < MAX_FRICTION / self.step:
            return None
        stiffness, error = self._stiffness(best.model.values[:-1], best.covariance[:-1, :-1])
        frequency = float(np.sqrt(stiffness))
        return InertiaTest(
            *self.compared(best), float(friction), float(best.standard_errors[-1]), self.relaxation,
            frequency, error / (2 * frequency) if frequency > 0 else np.nan, self.step,
        )  # fmt: skip

    @cached_property
    def _with_speed(self) -> Dynamics:
        """With γ as it is given: F is that of the model without inertia."""
        return self._model(lambda force, v, friction: friction * (force - v), fixed=True)

    def with_friction(self, friction: float) -> Fit:
        """With γ given, beginning with F and the noise of the model without inertia."""
        model = self._with_speed.with_values(np.append(self.without.model.values, friction))
        rate = friction**2 * np.diag(self.without.noise.process)
        noise = force_noise(self.without.noise.measurement, rate)
        return fit_by_filter(model, self.data, x=self.x, noise=noise, closure=False)

    def least_friction(self, best: float, highest: float) -> float:
        """From which γ on, below a given one, the likelihood is within 95 % of the best."""
        low, high = highest, highest
        while best - self.with_friction(low).log_likelihood < DROP:
            low, high = low / 4, low
            if low * self.step < MIN_FRICTION:
                return 0.0
        for _ in range(HALVINGS):
            middle = float(np.sqrt(low * high))
            if best - self.with_friction(middle).log_likelihood < DROP:
                high = middle
            else:
                low = middle
        return high

    def _model(
        self, rate: Callable[[sympy.Expr, sympy.Symbol, sympy.Symbol], sympy.Expr], *, fixed: bool
    ) -> Dynamics:
        states = (*self.library.states, *velocity_names(self.library.states))
        friction = "friction" + "_" * max(map(len, states))  # no state is called so
        parameters = (*self._parameters, Parameter(friction, 0.0, fixed=fixed))
        equation = rate(self._force, symbol(states[1]), symbol(friction))
        return seen_positions(
            Dynamics(states, (sympy.S.Zero, equation), Diffusion.identity(2), parameters=parameters)
        )

    def _stiffness(self, values: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
        """``-F'`` where F falls through zero most steeply, and its standard error; zeros where nowhere."""
        low, high = np.quantile(self.data.outputs, (0.01, 0.99))
        places, library = np.linspace(low, high, WELL_GRID)[:, None], self.library
        force = library.evaluate(places) @ values
        falling = np.flatnonzero((force[:-1] > 0) & (force[1:] <= 0))
        if not len(falling):
            return 0.0, 0.0
        share = force[falling] / (force[falling] - force[falling + 1])
        wells = places[falling] + share[:, None] * (places[falling + 1] - places[falling])
        # ∂F/∂c at the well, where the well itself moves with F.
        slopes = np.einsum("nk,kj->nj", library.evaluate(wells), library.derivatives[:, 0, :])
        bends = np.einsum("nk,kj->nj", slopes, library.derivatives[:, 0, :])
        steep = slopes @ values
        one = int(np.argmin(steep))
        changed = slopes[one] - (bends[one] @ values) / steep[one] * library.evaluate(wells)[one]
        return float(-steep[one]), float(np.sqrt(max(changed @ covariance @ changed, 0.0)))
