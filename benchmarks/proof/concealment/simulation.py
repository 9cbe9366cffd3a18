"""Simulation: what a system with its effect really does, by rules that the diagnosis does not use.

Without noise it is the rule of Dormand and Prince of order eight, for all recordings at once. Inputs have a
kink or a jump at every sample, so each interval between samples is integrated on its own; laws with kinks or
jumps, such as friction, are integrated from one crossing to the next. With noise it is Heun's rule with fine
steps.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks.proof.cases import RanAway
from benchmarks.proof.concealment.experiments import Experiment
from benchmarks.proof.concealment.model import Drive, Trajectories, TrueSystem
from benchmarks.proof.concealment.physics import PhysicalSystem

TOLERANCE, PILOT = 1e-10, 1e-4  # relative, of each step
PILOT_SMOOTHING = 0.02  # of a typical speed
HEUN_STEPS = 40  # between two samples
CHECKS = 4  # between two samples, whether a switch has been crossed
MOST_EVENTS = 50  # between two samples


def simulate(
    model: TrueSystem, experiment: Experiment, rng: np.random.Generator, *, pilot: bool = False
) -> Trajectories:
    """Carry an experiment out.

    Parameters
    ----------
    model
        What is there.
    experiment
        What is done to it.
    rng
        Draws process noise, and nothing else.
    pilot
        A few digits are enough: steps are long, and do not stop at the kinks of inputs.

    Raises
    ------
    RanAway
        When a state leaves the system's limits.
    """
    times = experiment.times()
    own = np.zeros((len(model.names) - len(model.system.states), experiment.starts.shape[1]))
    start = np.concatenate([experiment.starts, own])
    drive = Drive(times, experiment.inputs, model.system.held, model.lag)
    if model.effect and model.effect.noise:
        states = _with_noise(model, drive, start, rng)
    elif model.effect and model.effect.switches and not pilot:
        states = _switching(model, drive, start)
    else:
        states = _smooth(model, drive, start, pilot)
    _check(model.system, states.reshape(len(states), -1))
    return Trajectories(times, states, experiment.inputs)


def _check(system: PhysicalSystem, x: np.ndarray) -> None:
    low, high = system.limits
    rows = x[: len(low)]
    if not ((rows >= low) & (rows <= high)).all():
        raise RanAway


def _absolute(model: TrueSystem, tolerance: float) -> np.ndarray:
    """Absolute tolerance of every state, a tenth of the relative one of its size."""
    sizes = [model.system.sizes.get(name, np.nan) for name in model.names]
    # What an effect brings along may be as small as the square of a small state.
    return 0.1 * tolerance * np.nan_to_num(sizes, nan=min(np.nanmin(sizes) ** 2, 1.0))


def _rates(
    model: TrueSystem,
    drive: Drive,
    moment: float | None,
    shape: tuple[int, ...],
    sides: np.ndarray | None = None,
) -> Callable[[float, np.ndarray], np.ndarray]:
    """The right-hand side for flat states, within the piece of the inputs around a moment or anywhere."""
    piece = None if moment is None else drive.line(moment)

    def rates(t: float, flat: np.ndarray) -> np.ndarray:
        value, slope, origin = piece or drive.line(t)
        x = flat.reshape(shape)
        _check(model.system, x)
        if piece is None and model.effect and model.effect.friction:
            # A pilot passes smoothly from one direction to the other: the jump would take it many steps.
            speed = PILOT_SMOOTHING * model.system.sizes[model.effect.friction.velocity]
            return model.drift(t, x, value + slope * (t - origin), np.tanh(model.switches(x) / speed)).ravel()
        return model.drift(t, x, value + slope * (t - origin), sides).ravel()

    return rates


def _smooth(model: TrueSystem, drive: Drive, start: np.ndarray, pilot: bool) -> np.ndarray:
    """States at the samples, all recordings at once, ``(states, recordings, N)``."""
    states = np.empty((*start.shape, len(drive.times)))
    states[..., 0] = start
    breaks = drive.times[[0, -1]] if pilot else drive.breaks()
    tolerance = PILOT if pilot else TOLERANCE
    absolute = np.repeat(_absolute(model, tolerance), start.shape[1])
    x = start.ravel()
    for begin, end in pairwise(breaks):
        inside = (drive.times > begin) & (drive.times <= end)
        solution = solve_ivp(
            _rates(model, drive, None if pilot else (begin + end) / 2, start.shape),
            (begin, end),
            x,
            "RK45" if pilot else "DOP853",
            t_eval=np.union1d(drive.times[inside], end),
            rtol=tolerance,
            atol=absolute,
            first_step=min(end - begin, drive.times[1]),
        )
        if not solution.success:
            raise RanAway
        x = solution.y[:, -1]
        states[..., inside] = solution.y[:, : inside.sum()].reshape(*start.shape, -1)
    return states


def _switching(model: TrueSystem, drive: Drive, start: np.ndarray) -> np.ndarray:
    """States at the samples where a law has kinks or jumps, ``(states, recordings, N)``.

    From one sample to the next the sides of all switches stay as they are, for all recordings at once. Those
    that cross over meanwhile go that way again, from crossing to crossing.
    """
    states = np.empty((*start.shape, len(drive.times)))
    states[..., 0] = x = start
    sides = _first_sides(model, drive, start)
    absolute = _absolute(model, TOLERANCE)
    for index, (begin, end) in enumerate(pairwise(drive.times), start=1):
        middle = (begin + end) / 2
        pull = _pull(model, drive, middle)
        _start_moving(sides, pull(begin, x), model)  # the input may have jumped
        checks = np.linspace(begin, end, CHECKS + 1)[1:]
        solution = solve_ivp(
            _rates(model, drive, middle, start.shape, sides),
            (begin, end),
            x.ravel(),
            "DOP853",
            t_eval=checks,
            rtol=TOLERANCE,
            atol=np.repeat(absolute, start.shape[1]),
            first_step=end - begin,
        )
        if not solution.success:
            raise RanAway
        path = solution.y.reshape(*start.shape, -1)
        crossed = np.zeros(start.shape[1], dtype=bool)
        for number, t in enumerate(checks):
            crossed |= _crossed(model, sides, path[..., number], pull(t, path[..., number]))
        before, x = x, path[..., -1].copy()
        for recording in np.flatnonzero(crossed):
            x[:, recording], sides[:, recording] = _from_crossing_to_crossing(
                model,
                drive.only(int(recording)),
                (begin, end),
                before[:, recording],
                sides[:, recording],
                absolute,
            )
        states[..., index] = x
    return states


def _first_sides(model: TrueSystem, drive: Drive, start: np.ndarray) -> np.ndarray:
    """Signs of all switches; of those that are zero, the signs that they are about to have."""
    rates = _rates(model, drive, drive.times[1] / 2, start.shape)
    soon = start + 1e-9 / model.system.rate * rates(0.0, start.ravel()).reshape(start.shape)
    sides = np.sign(model.switches(start))
    return np.where(sides == 0, np.sign(model.switches(soon)), sides)


def _pull(model: TrueSystem, drive: Drive, moment: float) -> Callable[[float, np.ndarray], np.ndarray]:
    """Force per mass without friction on what has friction, one a recording; zero where there is none."""
    if model.effect is None or model.effect.friction is None:
        return lambda t, x: np.zeros(x.shape[1:])
    row = model.names.index(model.effect.friction.velocity)
    frictionless = TrueSystem(model.system, model.parameters)
    value, slope, origin = drive.line(moment)
    return lambda t, x: frictionless.drift(t, x, value + slope * (t - origin))[row]


def _start_moving(sides: np.ndarray, pull: np.ndarray, model: TrueSystem) -> None:
    """Let go what friction holds no longer, in place."""
    if model.effect is None or model.effect.friction is None:
        return
    low, high = model.holding()
    away = np.where(pull > high, 1.0, np.where(pull < low, -1.0, 0.0))
    sides[0] = np.where(sides[0] == 0, away, sides[0])


def _crossed(model: TrueSystem, sides: np.ndarray, x: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """Which recordings are no longer where their sides say, or no longer held."""
    crossed = (model.switches(x) * sides < 0).any(axis=0)
    if model.effect is not None and model.effect.friction is not None:
        low, high = model.holding()
        crossed |= (sides[0] == 0) & ((pull > high) | (pull < low))
    return crossed


def _from_crossing_to_crossing(
    model: TrueSystem,
    drive: Drive,
    span: tuple[float, float],
    x: np.ndarray,
    sides: np.ndarray,
    absolute: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """State and sides of one recording at the end of an interval between samples."""
    assert model.effect is not None
    friction = model.effect.friction
    pull = _pull(model, drive, sum(span) / 2)
    t, end = span
    longest = interval = end - t
    sides = sides.copy()
    for _ in range(MOST_EVENTS):
        events = _events(model, sides, pull)
        solution = solve_ivp(
            _rates(model, drive, sum(span) / 2, (len(x), 1), sides[:, None]),
            (t, end),
            x,
            "DOP853",
            events=events,
            rtol=TOLERANCE,
            atol=absolute,
            first_step=min(end - t, longest / 2),
            max_step=longest / 2,
        )
        if solution.status == 1 and solution.t[-1] - t < 1e-10 * interval and longest > 1e-6 * interval:
            # It came back within the first step; a switch that starts at zero hides where, if steps are long.
            longest /= 4
            continue
        longest = interval
        t, x = solution.t[-1], solution.y[:, -1]
        if solution.status == 0:
            return x, sides
        if friction is None:
            for number, moments in enumerate(solution.t_events):
                sides[number] *= -1 if len(moments) else 1
        elif sides[0] == 0:  # it breaks away, upwards or downwards
            sides[0] = 1 if len(solution.t_events[0]) else -1
        else:
            x[model.names.index(friction.velocity)] = 0
            sides[0] = 0
            _start_moving(sides[:, None], pull(t, x[:, None]), model)
        if t >= end:
            return x, sides
    raise RanAway


def _events(
    model: TrueSystem, sides: np.ndarray, pull: Callable[[float, np.ndarray], np.ndarray]
) -> list[Callable[[float, np.ndarray], float]]:
    """What ends a motion on given sides, or a rest: functions of t and x that cross zero."""

    def side(number: int) -> Callable[[float, np.ndarray], float]:
        return lambda t, x: float(model.switches(x[:, None])[number, 0])

    functions: list[tuple[Callable[[float, np.ndarray], float], float]]
    if model.effect is not None and model.effect.friction is not None and sides[0] == 0:
        low, high = model.holding()
        functions = [
            (lambda t, x: float(pull(t, x[:, None])[0]) - high, 1.0),
            (lambda t, x: float(pull(t, x[:, None])[0]) - low, -1.0),
        ]
    else:
        functions = [(side(number), -sign) for number, sign in enumerate(sides)]
    for function, crossing in functions:
        function.terminal, function.direction = True, crossing  # type: ignore[attr-defined]
    return [function for function, _ in functions]


def _with_noise(model: TrueSystem, drive: Drive, start: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """States at the samples with additive noise, ``(states, recordings, N)``."""
    assert model.effect is not None
    noise = np.zeros((len(start), 1))
    for name, symbol in model.effect.noise.items():
        noise[model.names.index(name)] = model.effect.parameters[symbol]
    step = drive.times[1] / HEUN_STEPS
    states = np.empty((*start.shape, len(drive.times)))
    states[..., 0] = x = start
    for index, begin in enumerate(drive.times[:-1]):
        value, slope, origin = drive.line(begin + step / 2)
        kicks = noise * np.sqrt(step) * rng.standard_normal((HEUN_STEPS, *start.shape))
        for number, kick in enumerate(kicks):
            t = begin + number * step
            before = model.drift(t, x, value + slope * (t - origin))
            after = model.drift(t + step, x + step * before + kick, value + slope * (t + step - origin))
            x = x + step / 2 * (before + after) + kick
        _check(model.system, x)
        states[..., index + 1] = x
    return states
