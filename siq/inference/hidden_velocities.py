"""Hidden velocities: f(x, v) and noise from positions alone.

Two models of the same positions, with the same functions F and an error of the sensor each:

    dx = F(x) dt + noise                               overdamped
    dx = v dt,  dv = γ (F(x) - v) dt + noise           with inertia; the first is its limit γ → ∞

Their log-likelihoods are compared at Schwarz's price, half of ln n for each parameter and first state. The
error of the difference is that of a sum over blocks of the record, as in Vuong's test of models that are both
an approximation. Where inertia is not seen, what is known is from which γ on it would have been.

References
----------
Q. H. Vuong, Likelihood ratio tests for model selection and non-nested hypotheses, Econometrica 57 (1989) 307.
G. Schwarz, Estimating the dimension of a model, Ann. Statist. 6 (1978) 461.

``dx = v dt``, ``dv = f(x, v) dt + √ε σ dW``; x is measured, with an error R, and v never is. Differences of
positions are no velocities: the error of the sensor is divided by the step in them, and what they leave is
coloured. The likelihood of a filter that holds x and v needs none. All functions of a library are fitted so,
beginning with f = 0, whose filter is linear; coefficients enter linearly, so that the first step of
Gauss and Newton is already the weighted regression on what the filter knows of v. Terms are chosen as
everywhere (`siq.inference.noisy_sensor`).

Noise drives the velocities, and is the same everywhere.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
import sympy

from siq.data.recordings import Recordings
from siq.errors import NumericalFailure
from siq.inference.field_estimate import FlowMap, IdentifiedField
from siq.inference.kalman_filter import Linearisation, Noise, whiten
from siq.inference.library import CandidateLibrary, candidate_library
from siq.inference.maximum_likelihood import Fit, fit_by_filter
from siq.inference.measurements import Measurements
from siq.inference.noisy_sensor import NUMBERS, ROUNDS, FilteredTerms, moved_by, neighbours
from siq.inference.observation import (
    View,
    force_diffusion,
    force_noise,
    seen_positions,
    smoothed_motion,
    unbroken,
    velocity_names,
    with_definitions,
)
from siq.inference.recalibration import NoiseUncertainty, noise_uncertainty, without_idle_forces
from siq.inference.selection import critical_values
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter, symbol

BLOCKS = 40  # of the record: the error of a sum of so many is known to a tenth
INTERVAL = 1.96  # standard errors: of 95 % of a normal distribution
DROP = INTERVAL**2 / 2  # of a log-likelihood, at the ends of such an interval
SLIGHT = 0.1  # relaxation over friction, below which x alone is the state to within a tenth
PLACES = 400  # numerical: at which F is looked at in search of wells
SEARCHED = 6  # numerical: halvings of the logarithm of γ, to 2 % of a factor of four
FASTEST = 10.0  # γ times the step, beyond which velocities are forgotten between samples to exp(-10)


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
    models = _Inertia.of(recordings, degree, pair_step)
    test = models.free_test()
    if test is not None and test.seen:
        return test
    if test is None:  # the samples show no γ
        fastest = FASTEST / models.step
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
    test = _Inertia.of(recordings, degree, pair_step).free_test()
    return test if test is not None and test.seen else None


def _without_inertia(library: CandidateLibrary, data: Measurements) -> Fit:
    names, force = _force(library)
    model = Dynamics(
        library.states, (force,), Diffusion.identity(1),
        parameters=tuple(Parameter(name, 0.0) for name in names),
    )  # fmt: skip
    begins = data.begins
    moved = ((data.outputs[begins + 1] - data.outputs[begins]) ** 2).mean(axis=0)
    step = float(np.diff(data.t)[begins].mean())
    fit = fit_by_filter(
        model, data, x=data.outputs, noise=Noise(0.1 * moved, moved / step), closure=False
    )  # fmt: skip
    if fit.fault:
        raise NumericalFailure(f"the model without inertia cannot be fitted: {fit.fault}")
    return fit


@dataclass(frozen=True)
class _Inertia:
    """Fits of the model with inertia, beginning with the smoothed motion."""

    library: CandidateLibrary
    data: Measurements
    x: np.ndarray
    noise: Noise
    step: float

    @classmethod
    def of(cls, recordings: Recordings, degree: int, pair_step: float | None) -> _Inertia:
        """The models of recordings of one position."""
        if len(recordings.names) != 1:
            raise NumericalFailure("the test of inertia is of one position; select one column")
        data = unbroken(recordings, pair_step=pair_step)
        library = candidate_library(recordings.names, degree=degree)
        step = float(np.median(np.diff(data.t)[data.begins]))
        return cls(library, data, *smoothed_motion(data, recordings.names), step)

    @cached_property
    def without(self) -> Fit:
        """The model without inertia."""
        return _without_inertia(self.library, self.data)

    @property
    def price(self) -> float:
        """Schwarz's, of γ and of a first velocity of each record."""
        return float(np.log(len(self.data.t)) / 2 * (1 + len(self.data.labels)))

    @cached_property
    def places(self) -> np.ndarray:
        """At which wells are sought, shape ``(n, 1)``."""
        low, high = np.quantile(self.data.outputs, (0.01, 0.99))
        return np.linspace(low, high, PLACES)[:, None]

    @property
    def relaxation(self) -> float:
        """In the stiffest well of the model without inertia."""
        return _stiffest(self.library, self.without.model.values, self.without.covariance, self.places)[0]

    def compared(self, fit: Fit) -> tuple[float, float]:
        """Log-likelihood of a fit over that without inertia, at its price, and the error of that."""
        gain = fit.log_likelihood - self.without.log_likelihood - self.price
        return gain, _error(fit, self.without, self.data)

    def free_test(self) -> InertiaTest | None:
        """The test with the γ that fits best; None where samples show none."""
        best = self.free()
        if best is None:
            return None
        values, covariance = best.model.values[:-1], best.covariance[:-1, :-1]
        stiffness, error = _stiffest(self.library, values, covariance, self.places)
        frequency = float(np.sqrt(stiffness))
        return InertiaTest(
            *self.compared(best), float(best.model.values[-1]), float(best.standard_errors[-1]),
            self.relaxation, frequency, error / (2 * frequency) if frequency > 0 else np.nan, self.step,
        )  # fmt: skip

    @cached_property
    def _with_force(self) -> Dynamics:
        """With γF in terms of its own, and γ behind their coefficients."""
        return self._model(lambda force, v, friction: force - friction * v, fixed=False)

    @cached_property
    def _with_speed(self) -> Dynamics:
        """With γ as it is given: F is that of the model without inertia."""
        return self._model(lambda force, v, friction: friction * (force - v), fixed=True)

    def free(self) -> Fit | None:
        """With γ free; None where it does not settle at a γ that samples could show."""
        fit = fit_by_filter(self._with_force, self.data, x=self.x, noise=self.noise, closure=False)
        usable = fit.converged and not fit.fault and 0 < fit.model.values[-1] < FASTEST / self.step
        return fit if usable else None

    def with_friction(self, friction: float) -> Fit:
        """With γ given, beginning with F and the noise of the model without inertia."""
        model = self._with_speed.with_values(np.append(self.without.model.values, friction))
        rate = friction**2 * np.diag(self.without.noise.process)
        return fit_by_filter(
            model, self.data, x=self.x, noise=force_noise(self.without.noise.measurement, rate),
            closure=False,
        )  # fmt: skip

    def least_friction(self, best: float, highest: float) -> float:
        """From which γ on, below a given one, the likelihood is within 95 % of the best."""
        low, high = highest, highest
        while best - self.with_friction(low).log_likelihood < DROP:
            low, high = low / 4, low
            if low * self.step < 1e-6:  # no γ is excluded
                return 0.0
        for _ in range(SEARCHED):
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
        names, force = _force(self.library)
        friction = "friction" + "_" * max(map(len, states))  # no state is called so
        parameters = (*(Parameter(name, 0.0) for name in names), Parameter(friction, 0.0, fixed=fixed))
        equation = rate(force, symbol(states[1]), symbol(friction))
        return seen_positions(
            Dynamics(states, (sympy.S.Zero, equation), Diffusion.identity(2), parameters=parameters)
        )


def _force(library: CandidateLibrary) -> tuple[list[str], sympy.Expr]:
    """F in all functions of a library, and the names of its coefficients."""
    names = [f"c{place}_{'_'.join(library.states)}" for place in range(library.size)]
    terms = zip(names, library.terms, strict=True)
    return names, sympy.Add(*(symbol(name) * term for name, term in terms))


def _stiffest(
    library: CandidateLibrary, values: np.ndarray, covariance: np.ndarray, places: np.ndarray
) -> tuple[float, float]:
    """``-F'`` where F falls through zero most steeply, with its standard error; zeros where it never does."""
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


def _error(one: Fit, other: Fit, data: Measurements) -> float:
    """Standard error of the difference of two log-likelihoods, from blocks of the record."""
    length = max(len(data.t) // BLOCKS, 2)
    differences = []
    for begin, end in zip(data.first[:-1], data.first[1:], strict=True):
        count = max(round((end - begin) / length), 1)
        bounds = np.linspace(begin, end, count + 1).astype(int)
        for low, high in itertools.pairwise(bounds):
            differences.append(_of_block(one, data, low, high) - _of_block(other, data, low, high))
    if len(differences) < 2:
        return np.inf
    return float(np.std(differences, ddof=1) * np.sqrt(len(differences)))


def _of_block(fit: Fit, data: Measurements, low: int, high: int) -> float:
    """Log-likelihood of a part of a record, its first state unknown."""
    rows = slice(low, high)
    along = {each.name: getattr(fit.linearisation, each.name)[rows] for each in fields(Linearisation)}
    part = replace(
        data, labels=("block",), first=np.array([0, high - low]), t=data.t[rows], outputs=data.outputs[rows],
        courses=((),),
    )  # fmt: skip
    white = whiten(Linearisation(**along), part, fit.noise)
    return white.log_likelihood(float(white.innovations @ white.innovations))


KNOWN = 2.0  # half of the equations hold by definition, and no false term comes into them


@dataclass(frozen=True)
class HiddenMotion:
    """An identified f(x, v) with both noises.

    Attributes
    ----------
    found
        f of positions and velocities, `siq.inference.observation.with_definitions`; D acts on velocities, and
        is the unit matrix there if no random forces are seen.
    sensor
        Variance of each position's sensor noise, shape ``(d/2,)``.
    sensor_error
        Standard error of its logarithm.
    intensity, intensity_error
        ε, and the standard error of its logarithm; zero of ring-downs, without random forces.
    correlation, score
        Of neighbouring innovations, the strongest, and in standard errors.
    states
        What the filter knows of positions and velocities at each sample, shape ``(n, d)``.
    log_likelihood
        Of the fit.
    """

    found: IdentifiedField
    sensor: np.ndarray
    sensor_error: np.ndarray
    intensity: float
    intensity_error: float
    correlation: float
    score: float
    states: np.ndarray
    log_likelihood: float


def identify_hidden_motion(
    library: CandidateLibrary,
    recordings: Recordings,
    *,
    false_terms: float,
    generator: np.random.Generator,
    pair_step: float | None = None,
) -> HiddenMotion:
    """Find the forces, how noise drives the velocities, and the noise of the sensors together.

    Parameters
    ----------
    library
        The candidate functions of positions and velocities.
    recordings
        Of positions, in the order of the library's first states.
    false_terms
        Probability that chance brings any false term into f.
    generator
        Draws recordings again, see `siq.inference.selection`.
    pair_step
        Longest time between samples that still belong together.

    Raises
    ------
    NumericalFailure
        When the fit does not settle, or the library is too large.
    """
    d = library.dimension
    half = d // 2
    view = View(library, Diffusion.identity(d), None, hidden=True)
    data = view.measured(recordings, pair_step)
    everything = view.everything
    if data.outputs.size * len(everything) > NUMBERS:
        raise NumericalFailure(
            f"{len(everything)} coefficients and {len(data.t)} samples are too much for the memory; lower"
            " identification.degree, or name the functions of f"
        )
    x, noise = smoothed_motion(data, library.states[:half])
    if not noise.process.any():
        raise NumericalFailure("no force is seen: the positions move evenly; record longer")
    whole = fit_by_filter(
        view.model(everything, np.zeros(len(everything))), data, x=x, noise=noise, iterations=ROUNDS,
        closure=False,
    )  # fmt: skip
    if whole.fault:
        raise NumericalFailure(f"the likelihood with hidden velocities cannot be worked out: {whole.fault}")
    critical = critical_values(library, false_terms=min(KNOWN * false_terms, 0.5))
    terms = FilteredTerms.along(view, data, whole, np.tile(critical, half))
    chosen = terms.chosen()
    for place, name in enumerate(library.states[half:], start=half):
        if place not in everything[chosen, 0]:
            raise NumericalFailure(f"no term of the equation of {name} is significant; record longer")
    fit, support, chosen = terms.settled(chosen, whole.noise, x=whole.linearised_at)
    # The search for intensities ends at the least that it tries; of ring-downs there are none.
    fit = without_idle_forces(fit, data) or fit
    one = _as_motion(view, support, fit, data, noise_uncertainty(fit, data))
    shares = np.concatenate([np.ones(half), terms.stability(chosen, generator=generator)])
    return replace(one, found=replace(one.found, rivals=terms.rivals(chosen), stability=shares))


def _as_motion(
    view: View, support: np.ndarray, fit: Fit, data: Measurements, certain: NoiseUncertainty
) -> HiddenMotion:
    library = view.library
    half = library.dimension // 2
    rate = fit.noise.intensity[0]
    diffusion, intensity = force_diffusion(rate[half:, half:])
    own = with_definitions(library, support, fit.model.values, certain.covariance)
    coefficients = np.zeros((library.size, library.dimension))
    coefficients[own[0][:, 1], own[0][:, 0]] = own[1]
    moved, step = moved_by(data)
    # What is not foreseen from a sample to the next: twice the sensor's error, and what noise makes of v.
    unforeseen = 2 * fit.noise.measurement + np.diag(rate)[half:] * step**3 / 3
    found = IdentifiedField(
        library, coefficients, own[0], own[2], rate, float(np.sqrt((unforeseen / moved).mean())),
        FlowMap(fit.substeps), diffusion,
    )  # fmt: skip
    return HiddenMotion(
        found,
        fit.noise.measurement,
        certain.measurement,
        intensity,
        float(np.sqrt((certain.process[half:] ** 2).sum())) / half if intensity else 0.0,
        *neighbours(whiten(fit.linearisation, data, fit.noise), data),
        fit.linearised_at,
        fit.log_likelihood,
    )
