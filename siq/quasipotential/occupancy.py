"""Residence times and occupation of states as f, D and ε predict them, against the record itself.

f and D are learned from what happens within single steps. Mean residence times in the wells, and how states
are spread about them, are other figures of the same record, which no fit saw; on recordings that were held
out they share no sample with it either. A prediction that misses them is wrong, whatever its own tests say.

**Operator.** In one or two states times and densities follow from the Fokker–Planck operator on cells
(`siq.quasipotential.fokker_planck`), whatever ε is.

**Which time.** A visit to a well begins where the record enters the core of an attractor, and ends where it
enters another one's: everything between the cores is part of the visit. A core is where
``(x - A)ᵀ M (x - A)``, which is U to the second order, stays below ε, or below half of what it is at the next
saddle if that is less. With the invariant density π, and q the probability that of all cores this one was
visited last (the solution of the time-reversed ``L̃ q = 0`` with q = 1 in this core and 0 in the others),

    mean visit = ∫ π q dx / (flow of π q into other cores),

exactly, for any barrier (Vanden-Eijnden, *Transition path theory*, Lect. Notes Phys. 703 (2006) 453). In more
than two states it is predicted by the law of Eyring and Kramers. A record knows only what it saw at its
samples, and so the cores of the prediction are smaller by what a walk oversteps (`_as_sampled`).

**Which error.** The same is computed for draws of f and ε from their distributions, with the cores where they
are. n visits that ended in a time T were as likely as Poisson's law with the mean T/τ says, where τ is
uncertain by these draws. The distribution of each state during the visits to a well is compared as Kolmogorov
and Smirnov do, with as many samples as the correlation time leaves independent. What is compared are the
values as they were recorded: the state as a filter knows it follows from f, and is spread less than the
state by what the filter does not know. So the prediction is ``π q`` convolved with the sensor's noise, once;
the filter only says to which well a sample belongs. A mean over an exposure T lies about ``x + T f/4``, where
x is the state in its middle, which f leads to and from alike, with a variance of ``εD T/12``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
from scipy import sparse, special
from scipy.spatial import cKDTree

from siq.data.kinetics import continued_visits
from siq.data.preparation import joined
from siq.data.recordings import LONGEST_STEP, Recordings
from siq.data.states import BINS, SIGNIFICANCE, DwellCount, RecordStates, switching
from siq.data.stationarity import correlated_samples, runs_of, usual_step
from siq.errors import NumericalFailure
from siq.inference.field_estimate import FieldEstimate, Verdict
from siq.numerics.randomness import positive
from siq.numerics.text import place_text
from siq.quasipotential.fokker_planck import CELLS, COARSER, CellProcess, cores_about
from siq.quasipotential.rates import NoiseStrength, mean_residence_time
from siq.quasipotential.transitions import transitions, ways_out
from siq.remarks import Remark, sentence
from siq.systems.dynamics import Dynamics
from siq.systems.escapes import Neighbourhood
from siq.systems.phase_portrait import PhasePortrait

OVERSHOOT = 0.5826  # derived: -ζ(1/2)/√(2π)
SMALLEST_CORE = 0.2  # of a core's radius: of steps as long as the core no such correction is known
# Of the recorded box on each side, beyond which the operator lets nothing go. None where a formula of D(x),
# continued beyond what was recorded, is no longer positive.
MARGINS = (0.15, 0.0)
DRAWS, MOST_STATES = 24, 2  # of f, by which an error is known to a seventh; more states have too many cells
MOST_PLACES = 400  # cells of a sheared grid all have places of their own, and are put together

NO_HOP_PROBABILITY = 0.01  # below it, no hop at all contradicts the prediction
HERMITE_NODES = 41  # of the integral over the prediction's own error
MIN_INDEPENDENT_SAMPLES = 20  # fewer say nothing of a distribution
COMPARED_PLACES = 200  # at which distribution functions are compared
MEAN_DISTANCE = 0.8687  # of Kolmogorov's statistic: √(π/2) ln 2
POWER = 0.8  # probability with which a disagreement would have been noticed
USUAL_GAPS = 0.9  # quantile of the times between samples
WAY_PIECES = 10  # of a way from a well to a saddle: on each the mean force is asked for
LEAST_POWER = 10.0  # the factor of a time: a record that would not have shown it tests no times (a choice)


class _VisitProcess(CellProcess):
    """The process between cells with the visits to the cores of wells.

    `force` and `power` are f and the diagonal of εD in the cells. For each core, `last` are the probabilities
    that it was the last of all that was visited, of each cell, ``(n,)``; and `means` are the mean times from
    entering it until another one is entered.
    """

    def __init__(
        self, dynamics: Dynamics, intensity: float, box: np.ndarray, cores: Sequence[Neighbourhood], *,
        cells: int | None = None,
    ) -> None:  # fmt: skip
        super().__init__(dynamics, intensity, box, cells=cells)
        self._given = (intensity, box, cores, cells)
        self.force = dynamics.drift(self.points)
        self.power = intensity * np.diagonal(dynamics.diffusion.at(self.points), axis1=1, axis2=2)
        core, wells = _core_of(cores, self.points), range(len(cores))
        if len(np.unique(core[core >= 0])) < len(wells):
            raise NumericalFailure("the core of a well is smaller than a cell of the grid")
        own = (np.where(core < 0, np.nan, core == well) for well in wells)
        self.last = [np.clip(self.solved(given, backwards=True), 0.0, 1.0) for given in own]
        self.means = np.full(len(cores), np.inf)
        for well, last in enumerate(self.last):
            spent = self.density * last
            flow = float(spent @ (self.rates @ ((core >= 0) & (core != well)).astype(float)))
            if flow > 0:
                self.means[well] = spent.sum() / flow

    def of(self, dynamics: Dynamics) -> _VisitProcess | None:
        """The process of another f between these cells and cores; None where it has none."""
        intensity, box, cores, cells = self._given
        try:
            return _VisitProcess(dynamics, intensity, box, cores, cells=cells)
        except (NumericalFailure, np.linalg.LinAlgError, RuntimeError, ValueError):
            return None

    def distribution(
        self, well: int, state: int, places: np.ndarray, *, blur: float = 0.0, exposure: float = 0.0
    ) -> np.ndarray:
        """Distribution function of a recorded state during visits to a well.

        `blur` is the standard deviation of measurement noise, and each value a mean over an `exposure`.
        """
        points = self.points[:, state]
        if exposure:
            points = points + exposure / 4 * self.force[:, state]
            blur = float(np.sqrt(blur**2 + exposure / 12 * self.density @ self.power[:, state]))
        at, group = np.unique(np.round(points, 12), return_inverse=True)
        mass = np.bincount(group, weights=self.density * self.last[well])
        if len(at) > MOST_PLACES:
            mass, edges = np.histogram(at, bins=MOST_PLACES, weights=mass)
            at = (edges[1:] + edges[:-1]) / 2
        spread = np.hypot(blur, float(np.median(np.diff(at))) / np.sqrt(12))  # a cell is no point
        return np.asarray(special.ndtr((places[:, None] - at) / spread) @ (mass / mass.sum()))


def _as_sampled(
    cores: Sequence[Neighbourhood], dynamics: Dynamics, intensity: float, step: float
) -> list[Neighbourhood]:
    """Cores that a state meets all the time as often as it is seen in these at samples a step apart."""
    # A random walk meets a boundary as Brownian motion meets one that lies OVERSHOOT standard deviations
    # of a step farther on (Chernoff; Siegmund, Sequential Analysis, 1985), √(ε h tr(MD)/d) in the metric.
    found = []
    for core in cores:
        spread = np.trace(core.hessian @ dynamics.diffusion.at(core.center[None])[0]) / len(core.center)
        whole = np.sqrt(2 * core.level)
        radius = whole - OVERSHOOT * np.sqrt(intensity * step * max(float(spread), 0.0))
        found.append(replace(core, level=max(radius, SMALLEST_CORE * whole) ** 2 / 2))
    return found


def _core_of(cores: Sequence[Neighbourhood], points: np.ndarray) -> np.ndarray:
    """The core of each point ``(n, d)``, -1 between them: shape ``(n,)``."""
    heights = [one.height(points.T) for one in cores]
    nearest = np.argmin([*heights, np.full(len(points), np.nextafter(1, 2))], axis=0)
    return np.where(nearest < len(cores), nearest, -1)


def _predicted_visits(
    found: FieldEstimate, portrait: PhasePortrait, noise: NoiseStrength, cores: Sequence[Neighbourhood], *,
    seed: int = 0,
) -> tuple[list[tuple[int, float, float]], list[_VisitProcess], Remark]:  # fmt: skip
    """Well, mean time of visits and its relative error by f, D and ε, core to core, where that is known.

    It is by the operator of f and of draws of it, which is returned too, or else by the law; and what is not
    known.
    """
    reasons: list[str] = []
    dynamics, width = found.dynamics, portrait.box[:, 1] - portrait.box[:, 0]
    for margin in MARGINS if dynamics.dimension <= MOST_STATES else ():
        cells = CELLS[dynamics.dimension]
        box = portrait.box + margin * np.stack([-width, width], axis=1)
        try:
            processes = [_VisitProcess(found.drawn(), noise.intensity, box, cores, cells=cells)]
            generator = np.random.default_rng(seed)
            for _ in range(DRAWS):
                drawn = found.drawn(generator)
                strength = float(np.exp(noise.standard_error / noise.intensity * generator.standard_normal()))
                coarse = round(COARSER * cells)
                processes.append(_VisitProcess(drawn, noise.intensity * strength, box, cores, cells=coarse))
        except (NumericalFailure, np.linalg.LinAlgError, RuntimeError, ValueError) as error:
            reasons.append(str(error))
            continue
        means, errors = processes[0].means, np.log([one.means for one in processes[1:]]).std(axis=0, ddof=1)
        known = np.flatnonzero(np.isfinite(means) & np.isfinite(errors))
        times = [(int(well), float(means[well]), float(errors[well])) for well in known]
        return times, processes, Remark("quasipotential.no_dwell_time", {"reasons": [], "places": []})
    ways = transitions(found, ways_out(dynamics, portrait), [None] * len(cores))
    times, places = [], []
    for well, one in enumerate(portrait.attractors):
        mean_time = mean_residence_time([way.exit for way in ways if way.start == well], noise)
        if mean_time is None or not mean_time.complete:
            places.append(place_text(one.position))
        else:
            times.append((well, mean_time.value, mean_time.error))
    return times, [], Remark("quasipotential.no_dwell_time", {"reasons": reasons, "places": places})


@dataclass(frozen=True)
class VisitTest:
    """Visits to one well: as counted, and as predicted."""

    well: int  #: index of the attractor
    #: Counted on recordings of which each is foreseen by a fit that did not see it, and on all.
    held_out: DwellCount
    whole: DwellCount
    #: Mean time, in the unit of time, and its relative standard error.
    predicted: float
    error: float
    method: str  #: ``operator``, of Fokker and Planck, or ``law``, of Eyring and Kramers
    #: Of a count as far off as the one of the held-out recordings, if the prediction holds within its error.
    probability: float


@dataclass(frozen=True, eq=False)
class _DensityTest:
    """How a state is spread during the visits to one well."""

    #: Indices of the attractor, and of the state.
    well: int
    state: int
    #: The largest difference of the two distribution functions; and how many independent samples there are.
    distance: float
    independent: float
    probability: float  #: of as large a distance, were the prediction true within its error
    #: The histogram: edges ``(b + 1,)``, densities ``(b,)`` per unit of the state.
    edges: np.ndarray
    counted: np.ndarray
    predicted: np.ndarray


@dataclass(frozen=True)
class OccupancyCheck:
    """Visits to the wells, and the spread of states about them, against the record.

    `missing` says why neither is compared. `unseen` are two states between which the record hops, where a
    single one was identified. `passages` are how often the record went from one well, a row, into another, a
    column; empty where there is none to go to. `errors_along` are the standard errors of ΔU/ε that samples on
    the way between the two leave where no formula is trusted. `foreseen` are how many visits ought to have
    ended in all, by fits to other recordings, and the relative error of that.
    """

    visits: tuple[VisitTest, ...] = ()
    densities: tuple[_DensityTest, ...] = ()
    missing: Remark | None = None
    unseen: RecordStates | None = None
    passages: tuple[tuple[int, ...], ...] = ()
    errors_along: np.ndarray | None = None
    foreseen: tuple[float, float] = (0.0, 0.0)

    def verdicts(self, *, false_alarms: float) -> dict[str, Verdict]:
        """The verdicts for the certificate, each refused by chance with a probability `false_alarms`.

        ``connected``: whether recordings passed from well to well. ``times``: whether visits last as
        foreseen. ``record``: whether states are spread so. The figure of the last two is how many powers of
        ten their least probability lies below 1, times the number of figures compared.
        """
        tests: dict[str, Verdict] = {}
        why = "" if self.missing is None else sentence(self.missing)
        if self.unseen is not None:
            rarity, limit = -float(np.log10(self.unseen.probability)), -float(np.log10(SIGNIFICANCE))
            return {"record": Verdict(rarity, limit, False, why)}
        if self.passages:
            tests["connected"] = self._connected()
            tests["times"] = Verdict.not_tested(why) if self.missing else self._times(false_alarms)
        if self.densities:
            worst = min(self.densities, key=lambda one: one.probability)
            reason = f"states in well {worst.well + 1} are spread otherwise than what was identified says"
            chance = worst.probability * len(self.densities)
            tests["record"] = Verdict.of_probability(chance, false_alarms, reason)
        return tests

    def _connected(self) -> Verdict:
        """Whether all wells are joined, one way at least, by passages that tell what lies between them."""
        counts, error = np.array(self.passages), None
        if self.errors_along is not None:
            blind = (counts > 0) & (self.errors_along > np.log(LEAST_POWER))
            error = float(self.errors_along[blind].min()) if blind.any() else None
            counts = np.where(blind, 0, counts)
        _, piece = sparse.csgraph.connected_components(counts > 0, directed=False)
        apart = [int(well) + 1 for well in np.flatnonzero(piece != piece[0])]
        values = {"passages": int(counts.sum()), "apart": apart, "error": error}
        told = sentence(Remark("quasipotential.passages", values))
        return Verdict.not_tested(told) if apart else Verdict(0.0, 0.0, True, told)

    def _times(self, false_alarms: float) -> Verdict:
        """All visits together, and those to each well."""
        (expected, spread), held = self.foreseen, [one.held_out for one in self.visits]
        if not expected > 0:
            return Verdict.not_tested(sentence(Remark("quasipotential.no_power", {"factor": None})))
        count = DwellCount(sum(one.visits for one in held), sum(one.time for one in held))
        chances = [one.probability for one in self.visits]
        chances.append(_probability_of(count, count.time / expected, spread))
        chance = min(chances) * len(chances)
        worst = min(self.visits, key=lambda one: one.probability)
        counted = f"{worst.held_out.mean:.3g}" if worst.held_out.visits else "no end"
        reason = (
            f"visits to well {worst.well + 1} last {worst.predicted:.3g} by what was identified, and"
            f" {counted} as counted on recordings that it was not fitted to"
        )
        verdict = Verdict.of_probability(chance, false_alarms, reason)
        # 2√n has the variance 1, and 1 + n e² where its mean is uncertain by the share e.
        share = (special.ndtri(1 - false_alarms / (2 * len(chances))) + special.ndtri(POWER)) / 2
        left = 1 - share * np.hypot(expected**-0.5, spread)
        factor = left**-2 if left > 0 else np.inf
        values = {"factor": float(factor) if factor <= LEAST_POWER else None}
        told = sentence(Remark("quasipotential.no_power", values))
        if not verdict.passed:
            return verdict
        return Verdict.not_tested(told) if values["factor"] is None else replace(verdict, reason=told)


def _passages_of(
    portrait: PhasePortrait, recordings: Recordings, cores: Sequence[Neighbourhood]
) -> tuple[tuple[int, ...], ...]:
    """How often a record went from one well into the core of another.

    Where a run of samples begins outside all cores, it begins in the well that f leads to. Gaps as they are
    usual, as between pairs of samples, end no run.
    """
    gaps = np.diff(recordings.t)[np.diff(recordings.recording) == 0]
    usual = LONGEST_STEP * float(np.quantile(gaps, USUAL_GAPS)) if len(gaps) else None
    runs = runs_of(recordings, longest=usual)
    visits = continued_visits(_core_of(cores, recordings.values), runs)
    counts = np.zeros((len(portrait.attractors),) * 2, dtype=int)
    starts, ends = portrait.descents.paths[:, 0], portrait.descents.ends
    width = positive(np.ptp(portrait.box, axis=1))
    begins = np.array([recordings.values[run.start] for run in runs])
    _, nearest = cKDTree(starts / width).query(begins / width)
    for run, begin in zip(runs, nearest, strict=True):
        inside = visits[run]
        order = np.concatenate([[ends[begin]], inside[inside >= 0]])
        order = order[(order >= 0) & (order < len(counts))]
        np.add.at(counts, (order[:-1], order[1:]), order[:-1] != order[1:])
    return tuple(map(tuple, counts.tolist()))


def _errors_along(
    found: FieldEstimate, portrait: PhasePortrait, intensity: float, recordings: Recordings
) -> np.ndarray:
    """Standard errors of ΔU/ε on the ways between wells ``(k, k)``, where no formula of f is trusted.

    Of a piece of the way, w long in units of √(εD), the mean force is known to 1/√T from samples that spent
    the time T abreast of it, and U/ε changes by 2w with each unit of it: together ``Σ 4w²/T``.
    """
    x, step, k = recordings.values, usual_step(recordings), len(portrait.attractors)
    errors, sides = np.full((k, k), np.inf), np.linspace(0, 1, WAY_PIECES + 1)
    of_saddles: dict[bytes, dict[int, float]] = {}
    for well, (attractor, around) in enumerate(zip(portrait.attractors, portrait.saddles, strict=True)):
        for saddle in around:
            way = saddle.position - attractor.position
            middles = attractor.position + np.outer((sides[1:] + sides[:-1]) / 2, way)
            precision = found.diffusion.precision_at(middles) / intensity
            along = precision.mean(axis=0) @ way
            off = x - attractor.position
            share = off @ along / (way @ along)
            off = off - np.outer(share, way)
            near = np.einsum("ni,ij,nj->n", off, precision.mean(axis=0), off) <= way @ along
            spent = step * np.histogram(share[near], sides)[0]
            squares = 4 * np.einsum("i,nij,j->n", way, precision, way) / WAY_PIECES**2
            error = float(np.sqrt((squares / np.maximum(spent, step / 2)).sum()))
            of_saddles.setdefault(saddle.position.tobytes(), {})[well] = error
    for one in of_saddles.values():
        for first, second in product(one, repeat=2):
            errors[first, second] = min(errors[first, second], max(one[first], one[second]))
    return errors


def check_occupancy(
    found: FieldEstimate, portrait: PhasePortrait, noise: NoiseStrength | None, recordings: Recordings,
    parts: Sequence[tuple[FieldEstimate, np.ndarray]], *, measured: Recordings | None = None, seed: int = 0,
) -> OccupancyCheck:  # fmt: skip
    """Hold what was identified against the record's own hops and histogram.

    Parameters
    ----------
    found, portrait, noise
        f with its uncertainty, what follows from it, and ε, None where the recordings show none.
    recordings, parts
        All of them; and estimates of f, each with a mask over labels of the recordings: of those that it was
        not fitted to, and is compared with.
    measured
        The values as the sensors showed them, where `recordings` are states as a filter knows them.
    seed
        Decides the draws of f.
    """
    if found.noise_free:
        return OccupancyCheck(missing=Remark("quasipotential.record_without_noise"))
    if found.dynamics.periodic:
        named = {"states": " and ".join(found.dynamics.periodic)}
        return OccupancyCheck(missing=Remark("quasipotential.record_of_angles", named))
    if len(portrait.attractors) < 2:
        if noise is None:
            return OccupancyCheck(missing=Remark("quasipotential.record_of_unknown_noise"))
        seen = switching(joined(recordings)) if found.dynamics.dimension == 1 else None
        if seen is None or not seen.supported:
            return OccupancyCheck(missing=Remark("quasipotential.record_of_one_state"))
        low, *_, high = seen.levels
        values = {"low": low, "high": high, "hops": seen.transitions}
        return OccupancyCheck(missing=Remark("quasipotential.hops_unseen", values), unseen=seen)
    if noise is None:
        return OccupancyCheck(missing=Remark("quasipotential.record_of_unknown_noise"))
    cores = cores_about(found.dynamics, portrait.attractors, portrait.saddles, noise.intensity)
    runs, whole_runs = runs_of(recordings, bridged=True), runs_of(joined(recordings), bridged=True)
    visits = continued_visits(_core_of(cores, recordings.values), whole_runs)
    passages = _passages_of(portrait, joined(recordings), cores)
    reached = found.diffusion.regular  # every state, by noise
    along = _errors_along(found, portrait, noise.intensity, recordings) if reached else None
    states = len(portrait.attractors)
    whole = DwellCount.of_visits(recordings.t, visits, whole_runs, states=states)
    if found.dynamics.dimension > MOST_STATES and not any(one.visits for one in whole):
        return OccupancyCheck(
            missing=Remark("quasipotential.record_without_hops"), passages=passages, errors_along=along
        )
    sampled = _as_sampled(cores, found.dynamics, noise.intensity, usual_step(recordings))
    times, processes, unknown = _predicted_visits(found, portrait, noise, sampled, seed=seed)
    method = "operator" if processes else "law"
    # What each part foresees of the recordings that it did not see. A law of three states and more has all.
    apart: list[tuple[np.ndarray, tuple[DwellCount, ...], _VisitProcess | None]] = []
    for fit, mask in parts:
        used = [run for run in runs if mask[recordings.recording[run.start]]]
        process = processes[0].of(fit.dynamics) if processes and fit is not found else None
        counts = DwellCount.of_visits(recordings.t, visits, used, states=states)
        apart.append((mask[recordings.recording], counts, process or (processes[0] if processes else None)))
    tested, foreseen = [], np.zeros(2)  # the number of visits, and the sum of its errors
    for well, mean, error in times:
        held = DwellCount(
            sum(counts[well].visits for _, counts, _ in apart),
            sum(counts[well].time for _, counts, _ in apart),
        )
        expected = sum(
            counts[well].time / (mean if process is None else float(process.means[well]))
            for _, counts, process in apart
        )
        foreseen += [expected, expected * error]  # errors of one f: they do not average out
        chance = _probability_of(held, held.time / expected if expected > 0 else mean, error)
        tested.append(VisitTest(well, held, whole[well], mean, error, method, chance))
    if not tested:
        return OccupancyCheck(missing=unknown, passages=passages, errors_along=along)
    chance = min(_probability_of(one.whole, one.predicted, one.error) for one in tested)
    if not any(one.visits for one in whole) and chance > NO_HOP_PROBABILITY:
        missing = Remark("quasipotential.record_too_short_to_hop")
        return OccupancyCheck(missing=missing, passages=passages, errors_along=along)
    # Each state's distribution during the visits to each well, on recordings that the parts did not see.
    recorded, variance, exposure = recordings.values, found.sensor_variance, found.exposure or 0.0
    if measured is not None:  # at the samples that the filter used
        kept = recordings.recording + 1j * recordings.t
        recorded = measured.values[np.isin(measured.recording + 1j * measured.t, kept)]
    densities = []
    for well, *_ in times if processes else ():
        chosen = [np.flatnonzero(used & (visits == well)) for used, *_ in apart]
        rows = np.sort(np.concatenate(chosen))
        if len(rows) < MIN_INDEPENDENT_SAMPLES:
            continue
        breaks = np.flatnonzero(np.diff(rows) > 1) + 1
        pieces = [slice(int(a), int(b)) for a, b in pairwise(np.concatenate([[0], breaks, [len(rows)]]))]
        for state in range(recorded.shape[1]):
            x = recorded[rows, state]
            blur = 0.0 if variance is None else float(np.sqrt(variance[state]))
            shown = {"blur": blur, "exposure": exposure}
            independent = len(x) / (2 * correlated_samples(x, pieces))
            if independent < MIN_INDEPENDENT_SAMPLES or not np.ptp(x) > 0:
                continue
            places = np.quantile(x, np.linspace(0.005, 0.995, COMPARED_PLACES))
            counted = np.searchsorted(np.sort(x), places, side="right") / len(x)
            whole_f, *drawn = (one.distribution(well, state, places, **shown) for one in processes)
            predicted = sum(
                len(own) / len(rows) * (process or processes[0]).distribution(well, state, places, **shown)
                for own, (_, _, process) in zip(chosen, apart, strict=True)
            )
            distance = float(np.abs(counted - predicted).max())
            error = float(np.mean([np.abs(one - whole_f).max() for one in drawn])) if drawn else 0.0
            # The mean distance of n samples is 0.87/√n: an error of the prediction is as if there were fewer.
            effective = 1 / (1 / independent + (error / MEAN_DISTANCE) ** 2)
            edges = np.linspace(x.min(), x.max(), BINS + 1)
            share = np.diff(processes[0].distribution(well, state, edges, **shown))
            width = edges[1] - edges[0]
            counts = np.histogram(x, bins=edges)[0] / (len(x) * width)
            probability = float(special.kolmogorov(distance * np.sqrt(effective)))
            densities.append(
                _DensityTest(
                    well, state, distance, float(independent), probability, edges, counts, share / width
                )
            )
    told = (float(foreseen[0]), float(foreseen[1] / foreseen[0]) if foreseen[0] > 0 else 0.0)
    return OccupancyCheck(
        tuple(tested), tuple(densities), passages=passages, errors_along=along, foreseen=told
    )


def _probability_of(count: DwellCount, mean: float, error: float) -> float:
    """Two-sided probability of so many visits in their time, if they last `mean` within its error."""
    if count.time <= 0 or not np.isfinite(mean):
        return 1.0
    nodes, weights = np.polynomial.hermite_e.hermegauss(HERMITE_NODES)
    expected = count.time / mean * np.exp(np.clip(error * nodes, -50, 50))
    weights = weights / weights.sum()
    fewer = float(weights @ special.pdtr(count.visits, expected))
    return min(2 * min(fewer, float(weights @ special.gammainc(count.visits, expected))), 1.0)
