"""The observation of states: measurement noise, integration time, hidden velocities.

A sample shows the state of a model with the noise of its sensor. It may be the mean of the state over an
integration time before it, as of an exposed camera. Such means are correlated: a part of the same path may be
in two of them. With the running mean as a state of its own, which begins anew with every exposure,

    ``dm/dt = x/T``,

the system is Markovian again. An exposure that is shorter than the step begins between two samples, at an
instant at which nothing is measured. Where it is longer, of several samples one is kept, so that no two
exposures overlap.

Or samples show positions, and the second half of the states are velocities of which they show nothing.
``dx/dt = v`` holds by definition, process noise acts on velocities, and what is sought is the force in
``dv/dt = f(x, v)``. Differences of positions are no velocities: measurement noise is divided by the
step in them, and what they leave is coloured.

Or one state was recorded and a slow force z on it was not, which may follow it,

    dx = (f(x) + z) dt + noise,    dz = (-z/τ + b x) dt + noise.

Or the sensor's own noise is slow: what is measured is ``x + z``, where z pushes nothing and forgets,
``dz = -z/τ dt + noise``.

Whether a recorded position has inertia, so that it alone is not the state, is asked of two models with the
same functions F and measurement noise of their own:

    dx = F(x) dt + noise                               overdamped
    dx = v dt,  dv = γ (F(x) - v) dt + noise           with inertia; the first is its limit γ → ∞

Their log-likelihoods are compared at Schwarz's price (Ann. Statist. 6 (1978) 461), half of ln n for each
parameter and first state. The error of the difference is that of a sum over blocks of the record, as in
Vuong's test of models that are both an approximation (Econometrica 57 (1989) 307). Where inertia is not seen,
what is known is from which γ on it would have been.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import sympy

from siq.data.recordings import Recordings
from siq.data.stationarity import runs_of, usual_step
from siq.errors import NumericalFailure
from siq.inference.field_estimate import FieldEstimate
from siq.inference.kalman_filter import Noise, whiten
from siq.inference.library import CandidateLibrary, candidate_library, field_dynamics
from siq.inference.maximum_likelihood import Fit, fit_by_filter
from siq.inference.measurements import Measurements
from siq.inference.selection import all_coefficients
from siq.remarks import Remark, sentence
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter, symbol

FIRST_FORCE = 0.01  # of what positions move by: a force to begin with; the search goes up and down from it
MIN_SAMPLES = 20  # of a recording, by which its first velocity is determined with its noise
INSTANT_TOLERANCE = 1e-6  # of an exposure: what rounding leaves between two instants
BLOCKS = 40  # of the record: the error of a sum of so many is known to a tenth
INTERVAL = 1.96  # standard errors: of 95 % of a normal distribution
DROP = INTERVAL**2 / 2  # of a log-likelihood, at the ends of such an interval
SLIGHT = 0.1  # relaxation over friction, below which x alone is the state to within a tenth
WELL_GRID = 400  # numerical: points at which F is looked at in search of wells
HALVINGS = 6  # numerical: of the logarithm of γ, to 2 % of a factor of four
MAX_FRICTION = 10.0  # γ times the step, beyond which velocities are forgotten between samples to exp(-10)
MIN_FRICTION = 1e-6  # γ times the step, below which no γ is excluded


def velocity_names(positions: Sequence[str]) -> tuple[str, ...]:
    """The names of the velocities: ``v_x`` of x; a NumericalFailure where a column has that name already."""
    names = tuple(f"v_{name}" for name in positions)
    if taken := set(names) & set(positions):
        raise NumericalFailure(
            f"{min(taken)} is recorded and would be the name of a hidden velocity as well; leave"
            " 'hidden_velocities' out if the velocities are recorded, or rename the column"
        )
    return names


def _seen_positions(plain: Dynamics) -> Dynamics:
    """Dynamics of forces alone, with ``dx/dt = v`` and with positions for their outputs."""
    half, symbols = plain.dimension // 2, plain.symbols
    outputs = tuple(zip(plain.states[:half], symbols[:half], strict=True))
    equations = (*symbols[half:], *plain.equations[half:])
    return Dynamics(plain.states, equations, plain.diffusion, parameters=plain.parameters, outputs=outputs)


def smoothed_motion(data: Measurements, names: Sequence[str]) -> tuple[np.ndarray, Noise]:
    """Positions and velocities to begin with, and both noises, when nothing but noise drives the velocities.

    That model is linear: its smoother is a spline through the measured positions whose stiffness follows from
    the likelihood, and no start matters. The states ``(n, d)`` have positions before velocities. It is a
    NumericalFailure where recordings are too short for it, or its likelihood cannot be worked out.
    """
    if np.diff(data.first).min() < MIN_SAMPLES:
        raise NumericalFailure(
            f"a recording has fewer than {MIN_SAMPLES} samples, which do not determine its velocity; leave it"
            " out"
        )
    states = (*names, *velocity_names(names))
    free = _seen_positions(Dynamics(states, (sympy.S.Zero,) * len(states), Diffusion.identity(len(states))))
    begins, velocity = data.begins, np.zeros_like(data.outputs)
    rate = (data.outputs[begins + 1] - data.outputs[begins]) / data.step[begins, None]
    velocity[begins] = rate
    begin = FIRST_FORCE * (rate**2).mean(axis=0) / float(np.median(data.step[begins]))
    noise = Noise.of_rate(data.with_known_noise(data.roughness), np.diag(np.append(0 * begin, begin)))
    x = np.concatenate([data.outputs, velocity], axis=1)
    fit = fit_by_filter(free, data, x=x, noise=noise, closure=False)
    if fit.fault:
        raise NumericalFailure(f"the velocities cannot be worked out: {fit.fault}")
    return fit.x, fit.noise


@dataclass(frozen=True)
class ObservationModel:
    """The relation of samples to the states of f.

    A sample may be a mean over an exposure. Where velocities are hidden they are the second half of the
    states, and samples show nothing of them. What is hidden may be a slow force instead, which is added to
    ``dx/dt`` times a factor that is known, `slow_force`; it may follow the state, or has noise alone. Or the
    sensor adds noise with a correlation time of its own, `sensor_time`; the logarithm of its rate is the last
    parameter. The variance of white measurement noise may depend on what is measured, by a law as in
    `siq.inference.measurements.Measurements`. Of so many samples one may be used, `thinned`.
    """

    library: CandidateLibrary
    diffusion: Diffusion
    exposure: float | None = None
    hidden: bool = False
    slow_force: float = 0.0
    follows: bool = False
    sensor_time: float | None = None
    sensor_law: np.ndarray | None = None
    thinned: int = 1

    @classmethod
    def of(cls, found: FieldEstimate) -> ObservationModel:
        """The one that an estimate was made with."""
        library, slow = found.library, found.slow_force
        follows = bool(slow) and found.coefficients[library.terms.index(library.symbols[0]), 1] != 0
        time = None if found.slow_sensor is None else found.slow_sensor[1]
        law, each = (None, 1) if (seen := found.diagnosis) is None else (seen.sensor_law, seen.thinned)
        return cls(
            library, found.diffusion, found.exposure, found.hidden_states, slow, follows, time, law, each
        )

    @property
    def hidden_states(self) -> int:
        """Number of states that are not measured."""
        return self.library.dimension // 2 if self.hidden else 0

    @property
    def everything(self) -> np.ndarray:
        """Component and term of every coefficient that is not known beforehand, shape ``(p, 2)``."""
        if not self.slow_force:
            return all_coefficients(range(self.hidden_states, self.library.dimension), self.library.size)
        (x, z), terms = self.library.symbols, self.library.terms
        of_state = [(0, k) for k, term in enumerate(terms) if z not in term.free_symbols]
        return np.array([*of_state, *[(1, terms.index(one)) for one in ((x, z) if self.follows else (z,))]])

    @property
    def definitions(self) -> np.ndarray:
        """Component and term of each v in ``dx/dt``, shape ``(d/2, 2)``; none where nothing is hidden."""
        velocities = self.library.symbols[len(self.library.symbols) - self.hidden_states :]
        places = [self.library.terms.index(one) for one in velocities]
        return np.array(list(enumerate(places)), dtype=int).reshape(-1, 2)

    def unknown(self, found: FieldEstimate) -> tuple[np.ndarray, np.ndarray]:
        """The terms of an estimated f that are fitted, and their coefficients."""
        fitted = ~(found.support[:, None] == self.definitions).all(axis=2).any(axis=1)
        return found.support[fitted], found.values[fitted]

    def model(self, support: np.ndarray, values: np.ndarray) -> Dynamics:
        """Dynamics with the coefficients of a support as parameters, as they are measured."""
        plain = field_dynamics(self.library, support, values, diffusion=self.diffusion)
        if self.slow_force:
            z = plain.symbols[1]
            forced = (plain.equations[0] + self.slow_force * z, plain.equations[1])
            return replace(plain, equations=forced, outputs=plain.outputs[:1])
        if self.hidden:
            return _seen_positions(plain)
        if self.sensor_time is not None:
            (name, x), z = plain.outputs[0], symbol(slow := f"_noise_{plain.states[0]}")
            rate = Parameter(f"_rate{slow}", -float(np.log(self.sensor_time)))  # its logarithm: none grows
            return Dynamics(
                (*plain.states, slow), (*plain.equations, -sympy.exp(symbol(rate.name)) * z),
                Diffusion.identity(2), parameters=(*plain.parameters, rate), outputs=((name, x + z),),
            )  # fmt: skip
        if self.exposure is None:
            return plain
        # The states, and their running means, which are what is measured.
        names = [f"_mean_{name}" for name in plain.states]
        states, noise = (*plain.states, *names), Diffusion.identity(2 * plain.dimension)
        equations = (*plain.equations, *(each / self.exposure for each in plain.symbols))
        outputs = tuple((name, symbol(mean)) for (name, _), mean in zip(plain.outputs, names, strict=True))
        return Dynamics(states, equations, noise, parameters=plain.parameters, outputs=outputs)

    def measured(self, recordings: Recordings, pair_step: float | None) -> Measurements:
        """The recordings as measurements, a new one behind every gap.

        Running means begin anew where an exposure does. Where that is between two samples a row without any
        measured value stands there.
        """
        data = unbroken(recordings, pair_step=pair_step, every=self.every(recordings))
        data = replace(data, sensor_law=self.sensor_law)
        if self.sensor_time is not None or (self.slow_force and not self.follows):
            return replace(data, stationary=(1,))
        if self.exposure is None:
            return data
        d, ends = self.library.dimension, data.begins + 1
        start = data.t[ends] - self.exposure
        inside = start > data.t[ends - 1] + INSTANT_TOLERANCE * self.exposure
        at, before = ends[inside], np.searchsorted(ends[inside], data.first)
        t, outputs = np.insert(data.t, at, start[inside]), np.insert(data.outputs, at, np.nan, axis=0)
        restarting = tuple(range(d, 2 * d))
        return replace(data, first=data.first + before, t=t, outputs=outputs, restarting=restarting)

    def every(self, recordings: Recordings) -> int:
        """Of how many samples one is kept, so that exposures do not overlap."""
        steps = 0.0 if self.exposure is None else self.exposure / usual_step(recordings)
        return max(int(np.ceil(steps * (1 - INSTANT_TOLERANCE))), self.thinned)

    def noise(self, noise: Noise) -> Noise:
        """The noise of the states, as it drives the model: nothing drives running means."""
        if self.exposure is None:
            return noise
        d, shape = self.library.dimension, None
        if noise.shape is not None and noise.field is None:
            shape = np.eye(2 * d)[None].copy()
            shape[0, :d, :d] = noise.shape[0]
        return Noise(noise.measurement, np.concatenate([noise.process, np.zeros(d)]), shape, noise.field)

    def noise_of(self, found: FieldEstimate) -> Noise:
        """Both noises of an estimate, as they are in the model."""
        assert found.diagnosis is not None
        sensor, rate = found.diagnosis.measurement**2, found.noise_rate
        if found.slow_sensor is not None:
            size, time, _ = found.slow_sensor
            return Noise(sensor, np.append(np.diag(rate), 2 * size**2 / time))
        if found.noise is not None:
            return self.noise(Noise(sensor, np.ones(len(rate)), field=found.noise.diffusion(1.0)))
        return self.noise(Noise.of_rate(sensor, rate))

    def following(self, x: np.ndarray, begins: np.ndarray, values: np.ndarray, step: float) -> np.ndarray:
        """The force that follows x ``(n,)`` without noise, from rest in each part; zero if none follows."""
        if not self.follows:
            return 0 * x
        from scipy.signal import lfilter  # which brings all of scipy.stats, half a second to import

        kept = float(np.exp(values[-1] * step))
        parts = [lfilter([1 - kept], [1, -kept], one, zi=kept * one[:1])[0] for one in np.split(x, begins)]
        return -values[-2] / values[-1] * np.concatenate(parts)

    def states(self, data: Measurements, values: np.ndarray | None = None) -> np.ndarray:
        """States of the model to begin with, as they are measured next; a force follows with coefficients."""
        if self.follows and values is not None:
            x, step = data.outputs[:, 0], float(np.median(data.step[data.begins]))
            return np.column_stack([x, self.following(x, data.first[1:-1], values, step)])
        if self.slow_force or self.sensor_time is not None:
            return np.column_stack([data.outputs, np.zeros(len(data.t))])
        if self.hidden:
            return smoothed_motion(data, self.library.states[: self.hidden_states])[0]
        unknown = np.isnan(data.outputs).any(axis=1)
        values = data.outputs[np.arange(len(unknown)) + unknown]  # never two in a row, nor at an end
        return values if self.exposure is None else np.column_stack([values, values])

    def fitted(self, support: np.ndarray, values: np.ndarray, data: Measurements, **options: Any) -> Fit:
        """The fit of some terms, beginning with their values; see `fit_by_filter` for the options.

        Where it does not settle that is a NumericalFailure.
        """
        fit = fit_by_filter(self.model(support, values), data, **options)
        if not fit.converged:
            fault = f": {fit.fault}" if fit.fault else ""
            raise NumericalFailure(
                f"the fit of f with measurement noise does not settle{fault}; record more, or sample more"
                " often"
            )
        return fit

    def followed(self, data: Measurements, model: Dynamics, *, noise: Noise, substeps: int) -> Fit:
        """The filter along recordings, with f and both noises as they are."""
        still = replace(model, parameters=tuple(replace(each, fixed=True) for each in model.parameters))
        return fit_by_filter(
            still, data, x=self.states(data, model.values), noise=noise, estimate_process=False,
            estimate_sensor=False, substeps=substeps,
        )  # fmt: skip

    def gain(
        self, found: FieldEstimate, recordings: Recordings, rival: FieldEstimate | None = None, *,
        pair_step: float | None,
    ) -> float:  # fmt: skip
        """Log-likelihood with a slow force, or slow measurement noise, over that without, at its price.

        Without it f has the same functions of the state, and measurement noise is white; or it is the rival,
        whose D may depend on the state. The price is Schwarz's, half of ln n for each further parameter.
        """
        support, values = self.unknown(found)
        model, noise = self.model(support, values), self.noise_of(found)
        without = model.equations[0] - self.slow_force * model.symbols[1]
        of_state = [model.parameters[place] for place in np.flatnonzero(support[:, 0] == 0)]
        if self.follows:  # at once, that is a multiple of the state
            at_once = Parameter(f"_at_once_{model.states[0]}", self.slow_force * values[-2] / -values[-1])
            without, of_state = without + symbol(at_once.name) * model.symbols[0], [*of_state, at_once]
        alone = Dynamics(model.states[:1], (without,), Diffusion.identity(1), parameters=tuple(of_state))
        data = self.measured(recordings, pair_step)
        moved, step = moved_by(data)
        # A search that begins with a quiet sensor may find no way up.
        quiet, noisy = Noise(noise.measurement, noise.process[:1]), Noise(moved / 3, moved / 3 / step)
        whole = fit_by_filter(model, data, x=self.states(data, values), noise=noise)
        data = replace(data, stationary=())
        fits = [fit_by_filter(alone, data, x=data.outputs, noise=level) for level in (quiet, noisy)]
        best, price = max(one.restricted_likelihood(data) for one in fits), np.log(len(data.t)) / 2
        if rival is not None:
            view, terms = ObservationModel.of(rival), 1 if rival.noise is None else len(rival.noise.values)
            same, level = view.model(*view.unknown(rival)), view.noise_of(rival)
            data = replace(data, sensor_law=view.sensor_law)
            other = view.followed(data, same, noise=level, substeps=rival.flow.steps)
            best = max(best, other.restricted_likelihood(data) - (terms - 1) * price)
        gain = whole.restricted_likelihood(data) - best - (1 + self.follows + 1) * price
        if self.follows:  # an initial state that is in one model alone has a spread
            spread = float(whole.linearised_at[:, 1].var())
            gain -= len(data.labels) / 2 * np.log(2 * np.pi * np.e * spread) if spread else np.inf
        return float(gain)


def moved_by(data: Measurements) -> tuple[np.ndarray, float]:
    """Mean square of what each output moves by from a measured sample to the next, and the mean time.

    Where no sample has a next one that is a NumericalFailure.
    """
    measured = np.flatnonzero(~np.isnan(data.outputs).all(axis=1))
    same = data.recording[measured[:-1]] == data.recording[measured[1:]]
    before, after = measured[:-1][same], measured[1:][same]
    if not len(before):
        raise NumericalFailure(
            "no two samples are so near in time that one tells of the other; record longer"
        )
    moved = ((data.outputs[after] - data.outputs[before]) ** 2).mean(axis=0)
    return moved, float((data.t[after] - data.t[before]).mean())


def unbroken(recordings: Recordings, *, pair_step: float | None = None, every: int = 1) -> Measurements:
    """Recordings as measurements of their states, a new one behind every gap; of `every` so many samples one.

    Samples belong together up to the time `pair_step`, by default `Recordings.longest_step`.
    """
    runs = [np.arange(run.start, run.stop, every) for run in runs_of(recordings, longest=pair_step)]
    rows = np.concatenate(runs)
    labels = tuple(recordings.labels[recordings.recording[run[0]]] for run in runs)
    first, outputs = np.cumsum([0, *map(len, runs)]), np.ascontiguousarray(recordings.values[rows])
    return Measurements(labels, first, recordings.t[rows], outputs, ((),) * len(runs))


@dataclass(frozen=True)
class _InertiaTest:
    """The test of the inertia of one recorded position.

    The gain is the log-likelihood of the model with inertia over that without, at Schwarz's price, its error
    from blocks of the record. The friction is γ; where inertia is not seen, a lower limit of 95 % without an
    error. In the stiffest well x relaxes at the rate ``-F'(x)`` if there is no inertia, 0 where there is no
    well; with inertia its frequency is ``√(-γ F'(x))``, not a number where γ is not shown. The step is the
    time between samples.
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

    def sentence(self, unit: str = "") -> str:
        """The answer in words, with its figures."""
        needed = 1 / max(self.relaxation / SLIGHT, 1e-300)
        verdict = {"seen": self.seen, "overdamped": self.overdamped, "needed": needed, "unit": unit}
        return sentence(Remark("inference.inertia", vars(self) | verdict))


def inertia_test(
    recordings: Recordings, *, degree: int = 5, pair_step: float | None = None, limit: bool = True
) -> _InertiaTest:
    """Ask recordings of one position whether it has inertia, with powers of x up to a degree in F.

    Where no inertia is seen a limit of γ may be searched for; if not, γ means nothing there.

    Raises
    ------
    NumericalFailure
        Where one of the models cannot be fitted, or there is more than one position.
    """
    models = _InertialModels(recordings, degree, pair_step)
    model = models.with_velocity(given=False)
    best = fit_by_filter(model, models.data, x=models.x, noise=models.noise, closure=False)
    friction, fastest = float(best.model.values[-1]), MAX_FRICTION / models.step
    shown = best.converged and not best.fault and 0 < friction < fastest
    if not (shown or limit):
        return _InertiaTest(0.0, np.inf, 0.0, None, 0.0, np.nan, np.nan, models.step)
    frequency, error = np.nan, np.nan
    if shown:
        stiffness, error = models.stiffness(best.model.values[:-1], best.covariance[:-1, :-1])
        frequency = float(np.sqrt(stiffness))
        error = error / (2 * frequency) if frequency > 0 else np.nan
    else:
        friction, best = fastest, models.with_friction(fastest)
    relaxation = models.stiffness(models.without.model.values, models.without.covariance)[0]
    test = _InertiaTest(
        *models.compared(best), friction, float(best.standard_errors[-1]), relaxation, frequency, error,
        models.step,
    )  # fmt: skip
    if shown and (test.seen or not limit):
        return test
    return replace(test, friction=models.least_friction(best.log_likelihood, friction), friction_error=None)


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
        data, (moved, step), noise = self.data, moved_by(self.data), Diffusion.identity(1)
        model = Dynamics(self.library.states, (self._force,), noise, parameters=self._parameters)
        begin = Noise(0.1 * moved, moved / step)
        fit = fit_by_filter(model, data, x=data.outputs, noise=begin, closure=False)
        if fit.fault:
            raise NumericalFailure(f"the model without inertia cannot be fitted: {fit.fault}")
        return fit

    def compared(self, fit: Fit) -> tuple[float, float]:
        """Log-likelihood over that without inertia, at its price, and its error from blocks of the record."""
        gain, data = fit.log_likelihood - self.without.log_likelihood - self.price, self.data
        length = max(len(data.t) // BLOCKS, 2)
        differences = []
        for begin, end in itertools.pairwise(data.first):
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
        return gain, float(np.std(differences, ddof=1) * np.sqrt(len(differences)))

    @cached_property
    def _with_speed(self) -> Dynamics:
        return self.with_velocity(given=True)

    def with_friction(self, friction: float) -> Fit:
        """With γ given, beginning with F and the noise of the model without inertia."""
        model = self._with_speed.with_values(np.append(self.without.model.values, friction))
        rate = np.diag(np.append(0.0, friction**2 * self.without.noise.process))
        noise = Noise.of_rate(self.without.noise.measurement, rate)
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
            within = best - self.with_friction(middle).log_likelihood < DROP
            low, high = (low, middle) if within else (middle, high)
        return high

    def with_velocity(self, *, given: bool) -> Dynamics:
        """With γ as it is given, and F as without inertia; else with γF in terms of its own, and γ behind."""
        states = (*self.library.states, *velocity_names(self.library.states))
        friction = "friction" + "_" * max(map(len, states))  # no state is called so
        parameters = (*self._parameters, Parameter(friction, 0.0, fixed=given))
        v, rate = symbol(states[1]), symbol(friction)
        equations = (sympy.S.Zero, rate * (self._force - v) if given else self._force - rate * v)
        return _seen_positions(Dynamics(states, equations, Diffusion.identity(2), parameters=parameters))

    def stiffness(self, values: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
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
