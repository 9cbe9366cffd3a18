"""Landscapes of given equations, and of records: noisy ones that hop, and some that do not."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import sympy

import siq
from benchmarks.equations import CASES, SYSTEMS
from benchmarks.golden.table import tolerated

TOLERANCES = {
    "equations": {
        **tolerated("barrier", 1e-6),
        **tolerated("attractors saddles periods curvature parting_periods", 1e-6, 1e-9),
        **tolerated("path_barrier heights U_between multipliers", 1e-5, 1e-8),
        **tolerated("mean_time dwell_time", 1e-4),
        **tolerated("barrier_error", 0.05, 1e-6),
        **tolerated("stated_error", 0.1, 1e-8),
        **tolerated("basins", 0.0, 0.01),
    },
    "records": {  # f is fitted to noise, and rules that stop leave more open than where f is given
        **tolerated("attractors saddles coefficients", 1e-5, 1e-8),
        **tolerated("barrier path_barrier heights U_between epsilon memory relaxation sensor", 1e-4, 1e-9),
        **tolerated("mean_time dwell_time position_errors epsilon_error probability", 1e-3, 1e-9),
        **tolerated("barrier_error stated_error", 0.05, 1e-6),
        **tolerated("levels visit_times", 1e-6),
        **tolerated("basins", 0.0, 0.01),
    },
}
REFERENCES = ("linear", "double-well", "growing-noise", "archetype", "maier-stein", "maier-stein-5", "toggle")
CARDS = ("archetype4d", "budworm", "duffing", "lake", "resonator", "schloegl", "stommel")
OTHERS = ("noise on the velocity that grows with x²", "coloured noise, τ = 1", "steep toggle switch")
SHARES = (0.25, 0.5)  # of the way from an attractor to its saddle: where U is read
QUIET = 0.2  # of the lowest barrier: the noise for which mean times are asked
RECORDS, WITHIN = 8, 10  # records of a kind; steps of Euler and Maruyama a sample
X, Y = sympy.symbols("x y", real=True)


def equations(results: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every landscape of equations, or the kind of error where there is none."""
    known, box, row = siq.reference_systems(), [(-2, 2)] * 2, sympy.symbols("x:5", real=True)
    hopf = (X - Y - X * (X**2 + Y**2), X + Y - Y * (X**2 + Y**2))
    energy = row[-1] ** 2 + sum(one**2 - one * other / 2 for one, other in itertools.pairwise(row))
    force = [-energy.diff(one) for one in row]
    force[0], force[-1] = force[0] + row[-1] / 2, force[-1] - row[0]  # the ends turn about each other
    growing = [[1 + X**2 / 4, 0], [0, 1]]
    systems = {
        **{
            f"reference {name}": known[name].dynamics for name in (*REFERENCES, "fitzhugh-nagumo", "particle")
        },
        **{f"card {name}": SYSTEMS / f"{name}.yaml" for name in CARDS},
        **{name: CASES[name] for name in OTHERS},
        "cycle alone": siq.Dynamics.of((X, Y), hopf, domain=box),
        "point and cycle": known["point-and-cycle"].dynamics,
        "no attractor": siq.Dynamics.of((X, Y), (X, Y), domain=box),
        "no noise in y": siq.Dynamics.of((X, Y), (X - X**3, -Y), diffusion=[[1, 0], [0, 0]], domain=box),
        "noise grows with x": siq.Dynamics.of((X, Y), (X - X**3, X - Y), diffusion=growing, domain=box),
        "five states": siq.Dynamics.of(row, force, domain=[(-2, 2)] * 5),
    }
    for name, system in systems.items():
        try:
            found = siq.Landscape.from_equations(system)
            yield name, landscape(found) | {"curvature": curvature(found)}
        except (siq.InputError, siq.NumericalFailure) as error:
            yield name, {"refused": type(error).__name__}


def records(results: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every record: what it shows by itself, and its landscape with f, or how that was refused."""
    for name, make in MADE.items():
        record = make()
        found = siq.inspect(record)
        said = {
            each: getattr(found.memory, each) for each in ("kind", "lag", "memory", "relaxation", "sensor")
        }
        said |= {"pairs": found.pairs, "gaps": found.gaps}
        yield f"{name}: inspected", said | states_of(found.switching)
        yield f"{name}: landscape", analysed(record)


def maier_stein(state: np.ndarray) -> np.ndarray:
    """The force on states ``(n, 2)``; with β = 1, for which the barriers of U are 1/2."""
    x, y = state.T
    return np.stack([x - x**3 - x * y**2, -(1 + x**2) * y], axis=1)


def noisy(
    seed: int, force: Callable[[np.ndarray], np.ndarray] = maier_stein, *, intensity: float = 0.1,
    sensor: float = 0.0, grows: bool = False, samples: int = 20_000, step: float = 0.01,
) -> pd.DataFrame:  # fmt: skip
    """Records that begin at x = ±1, with the same noise in every state, which may grow with x."""
    draw, d, short = np.random.default_rng(seed), 2 if force is maier_stein else 1, step / WITHIN
    state, states = np.zeros((RECORDS, d)), np.empty((samples, RECORDS, d))
    state[:, 0] = np.sign(draw.standard_normal((2, RECORDS))[0])
    for sample in range(samples):
        states[sample] = state
        for _ in range(WITHIN):
            local = np.maximum(0.05, 1 + 0.8 * state[:, :1]) if grows else 1.0
            push = np.sqrt(intensity * short * local) * draw.standard_normal((RECORDS, d))
            state = state + short * force(state) + push
    return table(states + sensor * draw.standard_normal(states.shape), step)


def relaxing(seed: int) -> pd.DataFrame:
    """Sixty records without noise: x' = x - x³, y' = -y."""
    t, starts = np.linspace(0, 3, 61), np.random.default_rng(seed).uniform(-1.5, 1.5, (2, 60, 1))
    x = starts[0] / np.sqrt(starts[0] ** 2 + (1 - starts[0] ** 2) * np.exp(-2 * t))
    return table(np.stack([x.T, (starts[1] * np.exp(-t)).T], axis=2), t[1])


def table(states: np.ndarray, step: float) -> pd.DataFrame:
    """States ``(samples, records, d)`` as a table."""
    t, names = np.arange(len(states)) * step, "xy"[: states.shape[2]]
    return pd.concat(
        pd.DataFrame({"recording": f"r{k}", "t": t} | dict(zip(names, states[:, k].T, strict=True)))
        for k in range(states.shape[1])
    )


of_one_state = partial(noisy, force=lambda x: x - x**3, intensity=0.15, samples=2_500, step=0.05)
MADE: dict[str, Callable[[], pd.DataFrame]] = {
    "hop": partial(noisy, 1),
    "hop-often": partial(noisy, 5, intensity=0.2),
    "hop-005": partial(noisy, 3, sensor=0.005),
    "hop-02": partial(noisy, 2, sensor=0.02),
    "hop-multiplicative": partial(noisy, 4, grows=True),
    "relaxing": partial(relaxing, 0),
    "one state": partial(of_one_state, 11),
    "one state, sensor noise": partial(of_one_state, 12, sensor=0.05),
    "one well": partial(of_one_state, 13, force=np.negative),
    "few samples": partial(of_one_state, 14, samples=20),
    "short hops": partial(noisy, 15, sensor=0.005, intensity=0.2, samples=3_000),
    "hardly any samples": partial(of_one_state, 16, samples=4),
    "errors alone": partial(of_one_state, 17, force=np.zeros_like, intensity=0.0, sensor=0.1),
    "random walk": partial(of_one_state, 18, force=np.zeros_like),
}


def states_of(seen: Any) -> dict[str, Any]:
    """The two states between which a record hops by itself."""
    if seen is None:
        return {"two_states": None}
    said = {name: getattr(seen, name) for name in ("state", "probability", "levels")}
    counts = {"visits": [one.visits for one in seen.counts], "visit_times": [one.time for one in seen.counts]}
    return {"two_states": seen.supported} | said | counts


def analysed(record: pd.DataFrame) -> dict[str, Any]:
    """The landscape of a record with f and the noise, or how it was refused."""
    try:
        found = siq.Landscape.from_recordings(record)
    except siq.InputError as error:
        return {"refused": type(error).__name__}
    except siq.NoLandscape as error:
        field = {} if error.dynamics is None else support_of(error.dynamics)
        return {"refused": type(error).__name__, **field, **states_of(error.states)}
    said = {"refused": None, **support_of(found.dynamics), **landscape(found)}
    if found.noise is not None:
        said |= {"epsilon": found.noise.intensity, "epsilon_error": found.noise.standard_error}
        said |= {"dwell_time recorded": found.dwell_times()["mean_time"]}
    return said | {"position_errors": found.position_errors} | states_of(found.recorded_states)


def support_of(dynamics: siq.Dynamics) -> dict[str, Any]:
    """The terms of f and their coefficients, by state."""
    parts = [one.expand().as_coefficients_dict() for one in dynamics.formulas]
    terms = [sorted((str(term), float(value)) for term, value in part.items()) for part in parts]
    support, coefficients = ([[pair[place] for pair in one] for one in terms] for place in (0, 1))
    return {"support": support, "coefficients": coefficients}


def landscape(found: siq.Landscape) -> dict[str, Any]:
    """Attractors, saddles, barriers with relative errors, U over the lowest barrier, times, and verdicts."""
    ways, barriers, certificate = found.transitions, found.barriers(), found.certificate
    barrier = barriers["barrier"].to_numpy(float)
    lowest = min(barrier[np.isfinite(barrier) & (barrier > 0)], default=np.nan)
    ends = [(position(found.attractors[way.start]), position(way.saddle)) for way in ways]
    between = [a + share * (b - a) for a, b in ends if a is not None and b is not None for share in SHARES]
    said: dict[str, Any] = {
        "certified": certificate is not None and certificate.certified,
        "equilibria": [one.kind for one in found.equilibria if one.kind != "degenerate"],
        "attractors": [extent(one) if position(one) is None else position(one) for one in found.attractors],
        "basins": found.basins,
        "degrees": [None if well is None else well.degree for well in found.wells],
        "ways": [[way.start, way.end] for way in ways],
        "saddles": [position(way.saddle) for way in ways],
        "barrier": barrier,
        "barrier_error": barriers["standard_error"].to_numpy(float) / barrier,
        "path_barrier": [None if way.path is None else way.path.action for way in ways],
        "heights": found.heights / lowest,
        "U_between": found.quasipotential(np.array(between)) / lowest if between else [],
    }
    if found.cycles or found.parting:
        said["periods"] = [one.period for one in found.cycles]
        said["multipliers"] = [one.multipliers for one in found.cycles]
        said["parting_periods"] = [one.period for one in found.parting]
    if certificate is not None:
        said |= {
            "scope": certificate.scope,
            "stated_error": certificate.error,
            "tests": sorted(certificate.tests),
        }
        said["tests_failed"] = sorted(name for name, one in certificate.tests.items() if not one.passed)
    if np.isfinite(lowest):
        try:
            said["mean_time"] = found.escape_times(noise=QUIET * lowest)["mean_time"]
            said["dwell_time"] = found.dwell_times(noise=QUIET * lowest)["mean_time"]
        except ValueError as error:
            said["no_times"] = type(error).__name__
    return said


def position(place: Any) -> Any:
    """Of a point; None of a cycle."""
    return getattr(place, "position", None)


def extent(cycle: Any) -> list[np.ndarray]:
    """The box of a cycle, since the list of its points may begin anywhere."""
    return [cycle.points.min(axis=0), cycle.points.max(axis=0)]


def curvature(found: siq.Landscape) -> list[Any]:
    """The Hessian of V at every point attractor."""
    pairs = zip(found.wells, map(position, found.attractors), strict=True)
    return [None if well is None or at is None else well.hessians(at[None])[0] for well, at in pairs]
