"""Simulation of trajectories, and how a system is sampled by its own rates (paper, Appendix B).

Time runs in steps of the Runge–Kutta rule, or of Euler and Maruyama's where there is noise, all trajectories
at once; the arrays hold components first, ``(d, trajectories)``, so that each component is contiguous.

The step of a pair follows from the fastest rate of the Jacobian over the card's domain, the length of a
trajectory from the slowest relaxation to an attractor.

An external simulator has no equations to read, and is asked instead: `with_simulator`.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Annotated, ClassVar

import numpy as np
import sympy
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from siq.data.recordings import Recordings
from siq.errors import Fault, InputError, NumericalFailure
from siq.numerics.integration import euler_maruyama_step, runge_kutta_step
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import find_equilibria

TRAJECTORIES = 1000  # enough for every state of a box in three dimensions, and simulated in seconds
STATES = 400  # of the domain, at which rates are asked for
TURNED = 0.1  # of a time constant in the step of a pair: the flow differs from f by so much, and is known
FASTEST = 0.9  # quantile of the rates: the corners of a domain are left at once
RELAXED = 3.0  # slowest time constants that a trajectory lasts: then 95 % of the way is done
MOST_STEPS = 100  # of a pair, between pairs: beyond, a slow system would cost minutes


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class SimulationEntry:
    """Sampling as a study gives it; values left out follow from the system, see `completed`."""

    trajectories: Annotated[int, Field(ge=2)] = TRAJECTORIES  #: how many are simulated
    pairs: Annotated[int, Field(ge=1)] = 50  #: along each trajectory
    #: h, the time between the two states of a pair, in the card's unit of time; by default a tenth of the
    #: fastest time constant, rounded down.
    pair_step: Annotated[float, Field(gt=0)] | None = None
    #: Time between the starts of pairs; by default such that a trajectory lasts three of the slowest time
    #: constants at an attractor.
    interval: Annotated[float, Field(gt=0)] | None = None
    substeps: Annotated[int, Field(ge=1)] = 5  #: Runge–Kutta steps in h; with noise, of Euler and Maruyama
    #: ε of ``√ε D^(1/2) dW``. The paper's ε = 0.01 in section 3.1.1 is 0.02 here.
    noise_intensity: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0

    def completed(self, dynamics: Dynamics) -> SimulationEntry:
        """The entry with missing values filled in from the rates of what is simulated, over its domain."""
        if self.pair_step is not None and self.interval is not None:
            return self
        fastest, slowest = _rates(dynamics)
        step = self.pair_step
        if step is None:
            step = _round_down(TURNED / fastest)
            if self.interval is not None:
                step = self.interval / max(math.ceil(self.interval / step), 2)
        interval = self.interval
        if interval is None:
            interval = step * round(min(max(RELAXED / slowest / self.pairs / step, 2.0), float(MOST_STEPS)))
        return replace(self, pair_step=step, interval=interval)

    def options(self) -> SimulationOptions:
        """The options of the simulation; raises ValueError where one is left out, or does not fit another."""
        if self.pair_step is None or self.interval is None:
            raise ValueError("the step and the interval of the pairs are not known without the system")
        options = SimulationOptions(**vars(self))
        _sampling_stride(options)
        return options


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class SimulationOptions(SimulationEntry):
    """Sampling of a simulated system, with the fields of `SimulationEntry`; defaults of the paper's Table B1.

    Initial states are uniform over the card's domain Ω, and pairs start at t_j = interval·j, j = 1 … pairs.
    The drift of the Euler–Maruyama rule is that of the continuous process but for O(h/substeps). The paper's
    section 3.1.1 writes the noise as ``⟨ξ_j(t) ξ_k(0)⟩ = 2ε δ_jk δ(t)``, so that its ε is half of ours.
    """

    trajectories: Annotated[int, Field(ge=2)] = 5000
    pair_step: Annotated[float, Field(gt=0)] = 0.01
    interval: Annotated[float, Field(gt=0)] = 0.1


def _sampling_stride(options: SimulationOptions) -> int:
    """Number of integrator steps between the starts of two pairs; raises Fault where it is not whole."""
    step = options.pair_step / options.substeps
    stride = round(options.interval / step)
    if abs(stride * step - options.interval) > 1e-9 * options.interval or stride <= options.substeps:
        raise Fault(
            f"simulation.interval ({options.interval}) is not a multiple of the step"
            f" pair_step/substeps ({step}) that exceeds pair_step",
            "change one of them",
        )
    return stride


def noise_source(
    dynamics: Dynamics, *, intensity: float, step: float, generator: np.random.Generator
) -> Callable[[np.ndarray], np.ndarray]:
    """Generator of the noise over one step Δt of states: ``sqrt(ε) σ(x) ΔW``, in the sense of Itô.

    It maps components of states ``(d, n)`` to increments ``(d, n)``, new ones with every call. Where D is no
    covariance beyond the domain, it is that of the edge. Raises ValueError when ε or Δt is negative.
    """
    if intensity < 0 or step < 0:
        raise ValueError(f"the noise intensity ({intensity}) and the step ({step}) must not be negative")
    factor, diffusion = float(np.sqrt(intensity * step)), dynamics.diffusion
    if diffusion.constant:
        whole = factor * diffusion.root
        return lambda x: np.asarray(whole @ generator.standard_normal(x.shape))
    low, high = dynamics.limits.T[..., None]

    def kicks(x: np.ndarray) -> np.ndarray:
        numbers = generator.standard_normal(x.shape)
        with suppress(NumericalFailure):
            return factor * diffusion.kicks(x, numbers)
        within = np.where(diffusion.positive_at(x.T), x, np.fmin(np.fmax(x, low), high))
        return factor * diffusion.kicks(within, numbers)

    return kicks


def simulate_snapshots(
    dynamics: Dynamics, *, options: SimulationOptions, generator: np.random.Generator
) -> Recordings:
    """Simulate trajectories from random initial states and keep their snapshot pairs.

    Parameters
    ----------
    dynamics
        What is simulated; its domain Ω is where the initial states are drawn, uniformly.
    options
        Sampling (paper, Appendix B).
    generator
        Source of the initial states, and then of the noise; a run passes its own. The initial states are
        the same with and without noise.

    Returns
    -------
    Recordings
        Every trajectory as one recording of 2·M samples at t_j and t_j + h. Consecutive samples no
        further apart than h are the pairs (X0, Xh); see `siq.data.recordings.snapshot_pairs`.

    Raises
    ------
    ValueError
        When the sampling does not fit the integrator's step.
    NumericalFailure
        When trajectories run to infinity.
    """
    step = options.pair_step / options.substeps
    stride = _sampling_stride(options)
    count, (lower, upper) = options.trajectories, dynamics.box.T
    x = generator.uniform(lower[:, None], upper[:, None], size=(dynamics.dimension, count))
    samples = np.empty((count, 2 * options.pairs, dynamics.dimension))
    noise = noise_source(dynamics, intensity=options.noise_intensity, step=step, generator=generator)
    drift = dynamics.drift_of_components

    def advance(x: np.ndarray) -> np.ndarray:
        if options.noise_intensity == 0:
            return runge_kutta_step(drift, x, step)
        return euler_maruyama_step(drift, x, step, noise(x))

    with np.errstate(over="ignore", invalid="ignore"):  # a runaway trajectory is told below, by name
        for pair in range(options.pairs):
            for _ in range(stride - (options.substeps if pair else 0)):
                x = advance(x)
            samples[:, 2 * pair] = x.T
            for _ in range(options.substeps):
                x = advance(x)
            samples[:, 2 * pair + 1] = x.T
    lost = ~np.isfinite(samples).all(axis=(1, 2))
    if lost.any():
        raise NumericalFailure(
            f"{lost.sum()} of {count} trajectories of {dynamics.name} run to infinity (the first is number"
            f" {int(lost.argmax())}); narrow the domains of the card or take more substeps"
        )
    starts = options.interval * np.arange(1, options.pairs + 1)
    times = np.stack([starts, starts + options.pair_step], axis=1).ravel()
    return Recordings(
        names=dynamics.states, units=dynamics.units,
        labels=tuple(f"trajectory{index:0{len(str(count - 1))}d}" for index in range(count)),
        recording=np.repeat(np.arange(count), 2 * options.pairs), t=np.tile(times, count),
        values=samples.reshape(-1, dynamics.dimension),
    )  # fmt: skip


def simulate_stationary(
    dynamics: Dynamics, *, intensity: float, start: np.ndarray, step: float, burn_in: int, steps: int,
    thin: int = 1, generator: np.random.Generator, rule: Callable[..., np.ndarray] = euler_maruyama_step,
) -> np.ndarray:  # fmt: skip
    """Samples of walkers in noise, shape ``(d, steps // thin, walkers)``, after a long time.

    The walkers share nothing but the equation ``dx = f dt + sqrt(ε) D^(1/2) dW``; the spread among them
    therefore tells the sampling error, whatever the correlation in time. Where ε is small a walker stays
    in the well in which it starts, and the shares of the wells are then those of `start`.

    Parameters
    ----------
    intensity
        ε, in the unit of U.
    start
        Initial states, shape ``(d, walkers)``.
    step
        Step of the rule; by that of Euler and Maruyama the samples' distribution is biased by O(step).
    burn_in, steps
        Number of steps before the first sample, and from then on.
    thin
        Every how many steps a sample is kept.
    rule
        The next state from f, the state, the step and the kicks of the noise (`siq.numerics.integration`).

    Raises
    ------
    ValueError
        When ε is negative, or no sample would be kept.
    NumericalFailure
        When walkers run to infinity.
    """
    if not 1 <= thin <= steps or burn_in < 0:
        raise ValueError(f"of {steps} steps after {burn_in}, every {thin}th leaves no sample")
    noise = noise_source(dynamics, intensity=intensity, step=step, generator=generator)
    x = np.array(start, dtype=float)
    samples = np.empty((len(x), steps // thin, x.shape[1]))
    with np.errstate(over="ignore", invalid="ignore"):  # told below
        for index in range(1 - burn_in, samples.shape[1] * thin + 1):
            x = rule(dynamics.drift_of_components, x, step, noise(x))
            if index > 0 and index % thin == 0:
                samples[:, index // thin - 1] = x
    lost = int((~np.isfinite(x).all(axis=0)).sum())  # what once is not finite stays so
    if lost:
        raise NumericalFailure(f"{lost} of {x.shape[1]} walkers run to infinity; take a smaller step")
    return samples


def _rates(dynamics: Dynamics) -> tuple[float, float]:
    """The fastest rate over the domain, and the slowest relaxation to an attractor, per unit of time.

    Eigenvalues of the Jacobian, which no choice of the states' units can alter. Where there is no attractor
    the slow rates of the domain stand in for its relaxation.
    """
    low, high = dynamics.box.T
    x = np.random.default_rng(0).uniform(low, high, size=(STATES, dynamics.dimension))
    sizes = np.abs(np.linalg.eigvals(dynamics.jacobian(x))).max(axis=1)
    fastest = float(np.quantile(sizes, FASTEST)) or 1.0
    relaxing = [
        -float(one.eigenvalues.real.max()) for one in find_equilibria(dynamics, x) if one.kind == "attractor"
    ]
    return fastest, max(min(relaxing, default=float(np.quantile(sizes, 1 - FASTEST))), 1e-6 * fastest)


def _round_down(value: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above a value: numbers that people read."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(f"{max(one for one in (1, 2, 5) if one * power <= value * (1 + 1e-9)) * power:.1g}")


Step = Callable[[np.ndarray, np.ndarray, np.ndarray, float], Sequence[float] | np.ndarray]
"""From states, inputs, parameters and a time step to the states after it, each in the order of the card."""

SIMULATOR = "the simulator"  # what messages call it
ACCURACY = 1e-9  # relative, of answers: between rounding and the tolerance of a solver
ANSWERS = 64  # kept: every state's rate and derivative is asked for at the same points
ASKED = 200  # states along the recordings at which a simulator is tried before it is used


class Simulated(sympy.Function):
    """The rate of a state, or a derivative of it, of which a simulator tells values and nothing else.

    It stands in formulas for what a card writes out. Its arguments are states, inputs and parameters, so that
    whatever acts through one of them, such as a delay or a drift, can be put in.
    """

    is_real = True
    simulator: ClassVar[_Simulator]
    row: ClassVar[int]
    by: ClassVar[tuple[int, ...]] = ()  #: arguments by which it is derived

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        """Its derivative by one of its arguments, from 1."""
        return self.simulator.function(self.row, (*self.by, argindex - 1))(*self.args)


class _Simulator:
    """The vector field behind a simulator, see `with_simulator`."""

    def __init__(self, simulate: Step, model: Dynamics, step: float) -> None:
        self._simulate, self._step, self._d = simulate, step, model.dimension
        names = [*model.states, *(u.name for u in model.inputs), *(p.name for p in model.parameters)]
        self.names, self._parts = names, (self._d, self._d + len(model.inputs))
        self._functions: dict[tuple[int, tuple[int, ...]], type[Simulated]] = {}
        self._answers: dict[bytes, np.ndarray] = {}
        self._together = False  # whether it takes many states at a time, as columns

    def function(self, row: int, by: tuple[int, ...] = ()) -> type[Simulated]:
        """A state's rate, derived by some arguments, as sympy knows functions."""
        by = tuple(sorted(by))
        if (row, by) not in self._functions:
            name = "_".join(["simulated", self.names[row], *(f"by_{self.names[one]}" for one in by)])
            values = staticmethod(partial(self._derivative, row, by))
            about = {"simulator": self, "row": row, "by": by, "_imp_": values}  # by which sympy evaluates it
            self._functions[row, by] = type(name, (Simulated,), about)
        return self._functions[row, by]

    def _derivative(self, row: int, by: tuple[int, ...], *arguments: np.ndarray | float) -> np.ndarray:
        """Central differences of the rate, of as many orders as there are arguments to derive by."""
        given = np.broadcast_arrays(*(np.asarray(each, dtype=float) for each in arguments))
        shape, at = given[0].shape, np.stack(given).reshape(len(given), -1)
        points, weight = at[:, None], np.ones((1, at.shape[1]))
        for one in by:
            size = np.maximum(np.abs(at[one]), np.median(np.abs(at[one])))
            # Truncation δ² and rounding ε/δ^m are alike at δ = ε^(1/(m+2)).
            reach = ACCURACY ** (1 / (len(by) + 2)) * np.where(size > 0, size, 1.0)
            shift = np.zeros((len(at), 1, at.shape[1]))
            shift[one] = reach
            points = np.concatenate([points + shift, points - shift], axis=1)
            weight = np.concatenate([weight, -weight]) / (2 * reach)
        rates = self._rates(points.reshape(len(at), -1))[row]
        return np.asarray((weight * rates.reshape(weight.shape)).sum(axis=0).reshape(shape))

    def _rates(self, at: np.ndarray) -> np.ndarray:
        """The effective vector field at columns of arguments: shape ``(d, n)``."""
        key = hashlib.blake2b(at.tobytes()).digest()
        if key not in self._answers:
            x, u, p = np.split(at, self._parts)
            one = self.after(x, u, p)
            two = self.after(one, u, p)
            three = self.after(two, u, p)
            if len(self._answers) == ANSWERS:
                del self._answers[next(iter(self._answers))]  # the oldest
            self._answers[key] = (18 * (one - x) - 9 * (two - x) + 2 * (three - x)) / (6 * self._step)
        return self._answers[key]

    def after(self, x: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
        """States a step later, in columns as they come; no number where there is no answer."""
        result = np.full(x.shape, np.nan)
        with np.errstate(all="ignore"):
            # Where all together raise an exception, some of them may have an answer by themselves.
            for place in (*([slice(None)] * self._together), *range(x.shape[1])):
                with suppress(Exception):  # as a formula that has no value at a trial state: fits step back
                    result[:, place] = self._asked(x[:, place], u[:, place], p[:, place])
                    if isinstance(place, slice):
                        break
        return result

    def _asked(self, x: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
        found = np.array(self._simulate(x.copy(), u.copy(), p.copy(), self._step), dtype=float)
        if found.shape != x.shape:
            fault = f"it answers with numbers of the shape {found.shape}, and states have {x.shape}"
            raise Fault(fault, "return the next value of every state, in the order of the card")
        return found

    def try_out(self, x: np.ndarray, u: np.ndarray, p: np.ndarray) -> None:
        """Ask at states ``(d, n)`` of recordings; raises InputError for what cannot be used."""
        p = np.broadcast_to(p[:, None], (len(p), x.shape[1]))
        few = range(min(self._d + 1, x.shape[1]))  # so that a matrix of them is not square
        one_by_one = np.stack([self._answer(x[:, k], u[:, k], p[:, k]) for k in few], axis=1)
        with suppress(Exception):  # it takes states one by one, then
            found = self._asked(x[:, few], u[:, few], p[:, few])
            self._together = bool(np.allclose(found, one_by_one, rtol=ACCURACY, atol=0.0))
        for k in np.flatnonzero(~np.isfinite(self.after(x, u, p)).all(axis=0)):
            self._answer(x[:, k], u[:, k], p[:, k])

    def _answer(self, x: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
        """The next state ``(d,)``, asked for twice."""
        values = zip(self.names, (*x, *u, *p), strict=True)
        place = "at " + ", ".join(f"{name} = {value:.6g}" for name, value in values)
        remedy = "it has to answer wherever recordings were"
        try:
            found, again = self._asked(x, u, p), self._asked(x, u, p)
        except Fault as error:
            raise error.at(SIMULATOR, place) from None
        except Exception as error:
            fault = f"it raises {type(error).__name__}: {error}"
            raise InputError(SIMULATOR, place, fault, remedy) from error
        if not np.isfinite(found).all():
            fault = f"the next {self.names[np.argmin(np.isfinite(found))]} is no number"
            raise InputError(SIMULATOR, place, fault, remedy)
        if (found != again).any():
            remedy = "let it begin at the states that it is given, with nothing drawn and nothing kept"
            raise InputError(SIMULATOR, place, "asked twice it gives two answers", remedy)
        return found


def with_simulator(
    model: Dynamics, simulate: Step, *, step: float, x: np.ndarray, inputs: np.ndarray
) -> Dynamics:
    """A dynamics whose equations, but for definitions such as ``x' = v``, are what a simulator does.

    The simulator's steps S of length h are those of a vector field F, which may be integrated by other rules,
    and to which terms may be added as to written equations. With ``ΔS = S(x) - x``, ``S = exp(hF)`` gives

        h F = log(1 + Δ) = ΔS - Δ²S/2 + Δ³S/3,    with an error of F of (h/τ)³/(4τ) for motion within τ,

    inputs and parameters being held: three steps. This is the motion of the simulator as it is, the error of
    its own rule at the step h included. A quick mode, of which S leaves nothing after a step, has the rate
    11/(6h) and no more: Runge–Kutta steps up to 1.5 h stay stable, however stiff the simulator is. One that
    overshoots (``S = -1``, the trapezoidal rule on stiff equations) has no such F. Nor is a definition told
    from what a coarse rule makes of it: Euler's with position after velocity seems damped by up to h/2 ∂f/∂x.

    Derivatives are central differences; of the second order and the third, too, for filters.

    Parameters
    ----------
    model
        Names, units, inputs, parameters and outputs. Its equations count where they are definitions.
    simulate
        From states ``(d,)``, inputs ``(i,)``, parameters ``(p,)`` and a time step to the next states. If it
        takes columns, ``(d, n)`` and so on, with the same result, all columns are asked for at once.
    step
        h, which it is always asked for.
    x, inputs
        States ``(d, n)`` and inputs ``(i, n)`` where it has to answer. Elsewhere an exception is no answer.

    Raises
    ------
    InputError
        Where it raises an exception, returns something else than a number for each state, or answers
        differently when asked again.

    Notes
    -----
    What the simulator does not report, or does not take, is out of reach: no term can be added to a state
    that it keeps to itself, no parameter refitted that is not passed, and no part of a rate replaced. So a
    saturation of a meeting of prey and predator, or an angle within a sine, is not looked for, or has to be
    told by a unit.
    """
    rows = np.unique(np.linspace(0, x.shape[1] - 1, ASKED).astype(int))
    simulator = _Simulator(simulate, model, step)
    simulator.try_out(x[:, rows], inputs[:, rows], model.values)
    arguments = [model.names[name] for name in simulator.names]
    told = (simulator.function(row)(*arguments) for row in range(model.dimension))
    rows_of = zip(model.equations, told, model.kinematic, strict=True)
    return replace(
        model, equations=tuple(written if defined else asked for written, asked, defined in rows_of)
    )
