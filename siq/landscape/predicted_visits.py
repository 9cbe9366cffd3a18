"""How long do visits to wells last, core to core, and how are states spread meanwhile: as f, D and ε say?

In one and two states from the Fokker–Planck operator, whatever the barriers; beyond, by the law of Eyring
and Kramers. Errors are those of f and ε: the same is computed for draws of both from their distributions,
with the cores where they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from siq.dynamics.dynamics import Dynamics
from siq.dynamics.equilibria import hessian_at
from siq.dynamics.phase_portrait import PhasePortrait
from siq.errors import NumericalFailure
from siq.identify.identified_field import IdentifiedField, field_dynamics
from siq.landscape.dwell_times import NoiseStrength, dwell_time
from siq.landscape.transitions import transitions, ways_out
from siq.numerics.measured_text import place_text
from siq.numerics.normal_draws import normal_draws
from siq.reference.fokker_planck import CELLS, CellProcess, cell_process, cores_of

OVERSHOOT = 0.5826  # derived: -ζ(1/2)/√(2π)
SMALLEST = 0.2  # of a core's radius: of steps as long as the core no such correction is known
SHARE = 0.5  # of U at the next saddle: a core lies well within its well
MARGINS = (
    0.15,
    0.0,
)  # of the recorded box on each side: beyond it the operator lets nothing go. None where a
# formula of D(x), continued beyond what was recorded, is no longer positive
DRAWS = {1: 24, 2: 8}  # of f, by the number of states: an error is then known to a sixth, or a quarter
COARSER = 0.5  # as many cells along each state: enough for how much a time changes
MOST_PLACES = 400  # cells of a sheared grid all have places of their own, and are put together


@dataclass(frozen=True, eq=False)
class Cores:
    """The cores of wells: where ``(x - A)ᵀ M (x - A)``, U to the second order, is below a level.

    Attributes
    ----------
    attractors
        Shape ``(k, d)``.
    hessians
        M, of V: ``(k, d, d)``.
    levels
        Shape ``(k,)``.
    """

    attractors: np.ndarray
    hessians: np.ndarray
    levels: np.ndarray

    def as_sampled(self, dynamics: Dynamics, intensity: float, step: float) -> Cores:
        """Cores that a state meets all the time as often as it is seen in these at samples a step apart.

        Between two samples a state may come into a core and leave it unseen. A random walk meets a boundary
        as Brownian motion meets one that lies `OVERSHOOT` standard deviations of a step farther on (Chernoff;
        Siegmund, Sequential Analysis, 1985): the cores are smaller by so much. The step is that along the
        metric of the core, ``√(ε h tr(MD)/d)``.
        """
        levels = []
        for place, hessian, level in zip(self.attractors, self.hessians, self.levels, strict=True):
            spread = np.trace(hessian @ dynamics.diffusion.at(place[None])[0]) / len(place)
            radius = np.sqrt(level) - OVERSHOOT * np.sqrt(intensity * step * max(float(spread), 0.0))
            levels.append(max(radius, SMALLEST * np.sqrt(level)) ** 2)
        return replace(self, levels=np.array(levels))

    def of(self, points: np.ndarray) -> np.ndarray:
        """The core of each point ``(n, d)``, -1 between them: shape ``(n,)``."""
        return cores_of(points, self.attractors, self.hessians, self.levels)


@dataclass(frozen=True)
class VisitTime:
    """Mean time of visits to a well, core to core, with its relative standard error."""

    well: int
    mean: float
    error: float


@dataclass(frozen=True, eq=False)
class CellVisits:
    """The operator of one f, with the probability of each cell to belong to a visit of each well."""

    process: CellProcess
    last: tuple[np.ndarray, ...]
    means: np.ndarray


@dataclass(frozen=True, eq=False)
class PredictedVisits:
    """What to expect of a record.

    Attributes
    ----------
    times
        Of the wells for which something is known.
    method
        ``operator`` or ``law``.
    processes
        The operator of f, and of draws of it; empty where the law was used.
    notes
        What is not known, in words.
    """

    times: tuple[VisitTime, ...]
    method: str
    processes: tuple[CellVisits, ...] = ()
    notes: tuple[str, ...] = ()

    def distribution(
        self, well: int, state: int, places: np.ndarray, blur: float = 0.0, *, draw: int = 0
    ) -> np.ndarray:
        """Distribution function of a state during visits to a well, at places ``(m,)``.

        Parameters
        ----------
        well, state
            Their indices.
        places
            Values of the state.
        blur
            Standard deviation of the sensor's error.
        draw
            Which of the processes; 0 is that of f itself.
        """
        cells = self.processes[draw]
        x = cells.process.points[:, state]
        at, group = np.unique(np.round(x, 12), return_inverse=True)
        mass = np.bincount(group, weights=cells.process.density * cells.last[well])
        if len(at) > MOST_PLACES:
            mass, edges = np.histogram(at, bins=MOST_PLACES, weights=mass)
            at = (edges[1:] + edges[:-1]) / 2
        spread = np.hypot(blur, float(np.median(np.diff(at))) / np.sqrt(12))  # a cell is no point
        return np.asarray(stats.norm.cdf((places[:, None] - at) / spread) @ (mass / mass.sum()))


def cores_about(dynamics: Dynamics, portrait: PhasePortrait, intensity: float) -> Cores:
    """The core of each attractor: U below ε, or below half of what it is at the next saddle or attractor."""
    attractors = np.array([one.position for one in portrait.attractors])
    hessians, levels = [], []
    for place, attractor in enumerate(attractors):
        hessian = hessian_at(dynamics, attractor)
        others = [*np.delete(attractors, place, axis=0), *(one.position for one in portrait.saddles[place])]
        away = np.array(others) - attractor
        lowest = float(np.einsum("ni,ij,nj->n", away, hessian, away).min())
        hessians.append(hessian)
        levels.append(min(intensity, SHARE * lowest))
    return Cores(attractors, np.array(hessians), np.array(levels))


def predicted_visits(
    found: IdentifiedField, portrait: PhasePortrait, noise: NoiseStrength, cores: Cores, *, seed: int = 0
) -> PredictedVisits:
    """Mean times of visits to every well, by the operator where it can be solved, or else by the law.

    Parameters
    ----------
    found, portrait
        F with its uncertainty, and what follows from it.
    noise
        ε with its error.
    cores
        See `cores_about`.
    seed
        Decides the draws.
    """
    notes: list[str] = []
    if found.dynamics.dimension in CELLS:
        for margin in MARGINS:
            try:
                processes = _processes(found, portrait, noise, cores, margin, seed)
            except (NumericalFailure, np.linalg.LinAlgError, RuntimeError, ValueError) as error:
                notes.append(str(error))
                continue
            means = processes[0].means
            errors = np.log([one.means for one in processes[1:]]).std(axis=0, ddof=1)
            times = [
                VisitTime(well, float(mean), float(error))
                for well, (mean, error) in enumerate(zip(means, errors, strict=True))
                if np.isfinite(mean) and np.isfinite(error)
            ]
            return PredictedVisits(tuple(times), "operator", processes)
    count = len(cores.attractors)
    ways = transitions(found, ways_out(found.dynamics, portrait), [None] * count)
    times, missing = [], []
    for well, one in enumerate(portrait.attractors):
        found_time = dwell_time([way.exit for way in ways if way.start == well], noise)
        if found_time is None or not found_time.complete:
            missing.append(place_text(one.position))
        else:
            times.append(VisitTime(well, found_time.value, found_time.error))
    if missing:
        notes.append(f"no law says how long {' and '.join(missing)} lasts")
    return PredictedVisits(tuple(times), "law", notes=tuple(notes))


def _processes(
    found: IdentifiedField,
    portrait: PhasePortrait,
    noise: NoiseStrength,
    cores: Cores,
    margin: float,
    seed: int,
) -> tuple[CellVisits, ...]:
    dynamics = found.dynamics
    width = portrait.box[:, 1] - portrait.box[:, 0]
    box = portrait.box + margin * np.stack([-width, width], axis=1)
    cells = CELLS[dynamics.dimension]
    main = _visits(dynamics, noise.intensity, box, cores, cells)
    generator = np.random.default_rng(seed)
    others = []
    for _ in range(DRAWS[dynamics.dimension]):
        drawn = drawn_system(found, generator=generator)
        strength = float(np.exp(noise.standard_error / noise.intensity * generator.standard_normal()))
        others.append(_visits(drawn, noise.intensity * strength, box, cores, round(COARSER * cells)))
    return (main, *others)


def drawn_system(found: IdentifiedField, *, generator: np.random.Generator) -> Dynamics:
    """F and D drawn from their distributions, further terms of f and the terms of D(x) included.

    Parameters
    ----------
    found
        What is known of both.
    generator
        Where the draw comes from.
    """
    coefficients = np.zeros_like(found.coefficients)
    own = normal_draws(found.values, found.covariance, 1, generator=generator)[0]
    coefficients[found.support[:, 1], found.support[:, 0]] = own
    if found.rivals is not None:
        coefficients += found.rivals.drawn(1, generator=generator)[0]
    support = np.argwhere(coefficients.T != 0)
    diffusion = found.diffusion
    if found.noise is not None:
        terms = found.noise
        entries = normal_draws(terms.values, terms.covariance, 1, generator=generator)[0]
        diffusion = replace(terms, values=entries).diffusion(found.intensity)
    values = coefficients[support[:, 1], support[:, 0]]
    return field_dynamics(found.library, support, values, diffusion=diffusion)


def _visits(dynamics: Dynamics, intensity: float, box: np.ndarray, cores: Cores, cells: int) -> CellVisits:
    process = cell_process(dynamics, intensity, box, cells=cells)
    core = cores.of(process.points)
    count = len(cores.attractors)
    if len(np.unique(core[core >= 0])) < count:
        raise NumericalFailure("the core of a well is smaller than a cell of the grid")
    last = tuple(process.last_visited(core, well) for well in range(count))
    means = np.array([process.mean_visit(core, well) for well in range(count)])
    return CellVisits(process, last, means)
