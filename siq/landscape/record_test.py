"""Does what was identified foresee how the record itself hops, and where it is?

f and D are learned from what happens within single steps. How long visits to a well last, and how states are
spread about it, are other figures of the same record, which no fit saw; on recordings that were held out they
share no sample with it either. A prediction that misses them is wrong, whatever its own tests say.

*Which time.* A visit to a well begins where the record enters the core of an attractor, and ends where it
enters another one's: well to well, with everything between the cores counted as part of the visit. A core
is where ``(x - A)ᵀ M (x - A)``, which is U to the second order, stays below ε, or below half of what it is at
the next saddle if that is less. What is predicted is this same time: in one and two states by the
Fokker–Planck operator (`siq.reference.fokker_planck`), whatever the barrier, and beyond that by the law of
Eyring and Kramers, whose mean time is that to the neighbourhood of the next attractor.

A record knows only what it saw at its samples, and so the cores of the prediction are smaller than those of
the count by what a walk oversteps (`siq.landscape.predicted_visits.Cores.as_sampled`).

*Which error.* n visits that ended in a time T were as likely as Poisson's law with the mean T/τ says, where τ
is uncertain by what draws of f from its distribution, and of ε, make of it. The distribution of each state
during the visits to a well is compared as Kolmogorov and Smirnov do, with as many samples as the correlation
time leaves independent.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import stats

from siq.certificate.tests import Verdict
from siq.data.record_states import BINS
from siq.data.recordings import Recordings
from siq.data.selection import joined
from siq.data.stationarity import correlated_samples, runs_of, usual_step
from siq.data.transitions import LEVEL, Switching, switching
from siq.data.visits import DwellCount, continued_visits, dwell_counts
from siq.dynamics.phase_portrait import PhasePortrait
from siq.identify.identified_field import IdentifiedField
from siq.landscape.dwell_times import NoiseStrength
from siq.landscape.predicted_visits import PredictedVisits, cores_about, predicted_visits
from siq.reference.fokker_planck import CELLS

NO_WONDER = 0.01  # probability of no hop at all, below which it contradicts the prediction
NODES = 41  # of the integral over the prediction's own error
FEWEST = 20  # independent samples: fewer say nothing of a distribution
PLACES = 200  # at which distribution functions are compared
MEAN_DISTANCE = 0.8687  # of Kolmogorov's statistic: √(π/2) ln 2


@dataclass(frozen=True)
class VisitTest:
    """Visits to one well: as counted, and as predicted.

    Attributes
    ----------
    well
        Index of the attractor.
    held_out, whole
        Counted on recordings that no fit saw, and on all.
    predicted
        Mean time, in the unit of time.
    error
        Its relative standard error.
    method
        ``operator``: of Fokker and Planck; ``law``: of Eyring and Kramers.
    probability
        Of a count as far off as the one of the held-out recordings, if the prediction holds within its error.
    """

    well: int
    held_out: DwellCount
    whole: DwellCount
    predicted: float
    error: float
    method: str
    probability: float


@dataclass(frozen=True, eq=False)
class DensityTest:
    """How a state is spread during the visits to one well.

    Attributes
    ----------
    well, state
        Indices of the attractor, and of the state.
    distance
        The largest difference of the two distribution functions.
    independent
        How many independent samples the held-out recordings hold.
    error
        The distance that the uncertainty of f alone would make, in the mean.
    probability
        Of as large a distance, were the prediction true within its error.
    edges, counted, predicted
        The histogram: edges ``(b + 1,)``, densities ``(b,)`` per unit of the state.
    """

    well: int
    state: int
    distance: float
    independent: float
    error: float
    probability: float
    edges: np.ndarray
    counted: np.ndarray
    predicted: np.ndarray


@dataclass(frozen=True)
class RecordTest:
    """All of it.

    Attributes
    ----------
    visits, densities
        As counted, and as predicted.
    missing
        Why neither is compared, in words; None where they are.
    notes
        What is not known, in words.
    unseen
        Two states between which the record hops, where a single one was identified; None elsewhere.
    """

    visits: tuple[VisitTest, ...] = ()
    densities: tuple[DensityTest, ...] = ()
    missing: str | None = None
    notes: tuple[str, ...] = ()
    unseen: Switching | None = None

    @property
    def hops(self) -> int:
        """How many were seen on all recordings."""
        return sum(one.whole.visits for one in self.visits)

    def verdict(self, *, false_alarms: float) -> Verdict | None:
        """The verdict for the certificate; None where there is no test.

        Its figure is how many powers of ten the least probability lies below 1, times the number of figures
        compared.

        Parameters
        ----------
        false_alarms
            Probability with which chance alone refuses what is right.
        """
        if self.unseen is not None:
            rarity, limit = -float(np.log10(self.unseen.probability)), -float(np.log10(LEVEL))
            return Verdict(rarity, limit, False, self.missing or "")
        found = [one.probability for one in self.visits] + [one.probability for one in self.densities]
        if self.missing is not None or not found:
            return None
        least = min(found)
        rarity = -float(np.log10(min(max(least * len(found), 1e-300), 1.0)))
        limit = -float(np.log10(false_alarms))
        return Verdict(rarity, limit, rarity <= limit, "" if rarity <= limit else self._reason(least))

    def _reason(self, least: float) -> str:
        for one in self.visits:
            if one.probability == least:
                counted = f"{one.held_out.mean:.3g}" if one.held_out.visits else "no end"
                return (
                    f"visits to well {one.well + 1} last {one.predicted:.3g} by what was identified, and"
                    f" {counted} as counted on held-out recordings"
                )
        worst = min(self.densities, key=lambda one: one.probability)
        return f"states in well {worst.well + 1} are spread otherwise than what was identified says"


def record_test(
    found: IdentifiedField,
    portrait: PhasePortrait,
    noise: NoiseStrength | None,
    recordings: Recordings,
    held_out: np.ndarray,
    *,
    sensor: np.ndarray | None = None,
    seed: int = 0,
) -> RecordTest:
    """Hold what was identified against the record's own hops and histogram.

    Parameters
    ----------
    found, portrait
        F with its uncertainty, and what follows from it.
    noise
        ε, None where the recordings show none.
    recordings
        All of them.
    held_out
        Mask over ``recordings.labels``: those that no fit saw.
    sensor
        Standard deviation of each state's sensor noise, shape ``(d,)``; None where there is none.
    seed
        Decides the draws of f.
    """
    if found.noise_free:
        return RecordTest(missing="the recordings show no random forces, so that nothing hops")
    if noise is None:
        return RecordTest(missing="the strength of the random forces is not known")
    if len(portrait.attractors) < 2:
        seen = switching(joined(recordings)) if found.dynamics.dimension == 1 else None
        if seen is None or not seen.supported:
            return RecordTest(missing="there is one stable state, so that nothing hops")
        low, high = seen.levels
        return RecordTest(
            missing=f"the record hops between two states, at {low:.3g} and {high:.3g}, with {seen.hops}"
            " transitions seen, and what was identified has one stable state",
            unseen=seen,
        )
    cores = cores_about(found.dynamics, portrait, noise.intensity)
    runs = runs_of(recordings)
    visits = continued_visits(cores.of(recordings.values), runs_of(joined(recordings)))
    apart = [run for run in runs if held_out[recordings.recording[run.start]]]
    states = len(portrait.attractors)
    whole = dwell_counts(recordings.t, visits, runs_of(joined(recordings)), states=states)
    held = dwell_counts(recordings.t, visits, apart, states=states)
    if found.dynamics.dimension not in CELLS and not any(one.visits for one in whole):
        return RecordTest(missing="the recordings do not hop")
    sampled = cores.as_sampled(found.dynamics, noise.intensity, usual_step(recordings))
    prediction = predicted_visits(found, portrait, noise, sampled, seed=seed)
    tested = tuple(
        VisitTest(
            one.well, held[one.well], whole[one.well], one.mean, one.error, prediction.method,
            probability_of(held[one.well], one.mean, one.error),
        )
        for one in prediction.times
    )  # fmt: skip
    if not tested:
        return RecordTest(missing=f"no dwell time is predicted: {'; '.join(prediction.notes)}")
    chance = min(probability_of(one.whole, one.predicted, one.error) for one in tested)
    if not any(one.visits for one in whole) and chance > NO_WONDER:
        return RecordTest(missing="the recordings do not hop, nor should they have in their time")
    densities = _densities(prediction, recordings, visits, apart, sensor)
    return RecordTest(tested, densities, notes=prediction.notes)


def probability_of(count: DwellCount, mean: float, error: float) -> float:
    """Two-sided probability of so many visits in their time, if they last `mean` within its error."""
    if count.time <= 0 or not np.isfinite(mean):
        return 1.0
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
    expected = count.time / mean * np.exp(np.clip(error * nodes, -50, 50))
    weights = weights / weights.sum()
    fewer = float(weights @ stats.poisson.cdf(count.visits, expected))
    more = float(weights @ stats.poisson.sf(count.visits - 1, expected))
    return min(2 * min(fewer, more), 1.0)


def _densities(
    prediction: PredictedVisits,
    recordings: Recordings,
    visits: np.ndarray,
    runs: list[slice],
    sensor: np.ndarray | None,
) -> tuple[DensityTest, ...]:
    """Each state's distribution during the visits to each well, on the runs given."""
    if not prediction.processes:
        return ()
    used = np.zeros(len(visits), dtype=bool)
    for run in runs:
        used[run] = True
    tests = []
    for one in prediction.times:
        rows = np.flatnonzero(used & (visits == one.well))
        if len(rows) < FEWEST:
            continue
        pieces = _pieces(rows)
        for state in range(len(recordings.names)):
            x = recordings.values[rows, state]
            blur = 0.0 if sensor is None else float(sensor[state])
            independent = len(x) / (2 * correlated_samples(x, pieces))
            if independent >= FEWEST and np.ptp(x) > 0:
                tests.append(_density(prediction, one.well, state, x, independent, blur))
    return tuple(tests)


def _pieces(rows: np.ndarray) -> list[slice]:
    """Where rows follow each other: slices of the places in `rows`."""
    breaks = np.flatnonzero(np.diff(rows) > 1) + 1
    return [slice(int(a), int(b)) for a, b in pairwise(np.concatenate([[0], breaks, [len(rows)]]))]


def _density(
    prediction: PredictedVisits, well: int, state: int, x: np.ndarray, independent: float, blur: float
) -> DensityTest:
    places = np.quantile(x, np.linspace(0.005, 0.995, PLACES))
    counted = np.searchsorted(np.sort(x), places, side="right") / len(x)
    foreseen = prediction.distribution(well, state, places, blur)
    distance = float(np.abs(counted - foreseen).max())
    drawn = [
        np.abs(prediction.distribution(well, state, places, blur, draw=draw) - foreseen).max()
        for draw in range(1, len(prediction.processes))
    ]
    error = float(np.mean(drawn)) if drawn else 0.0
    # The mean distance of n samples is 0.87/√n: an error of the prediction is as if there were fewer.
    effective = 1 / (1 / independent + (error / MEAN_DISTANCE) ** 2)
    edges = np.linspace(x.min(), x.max(), BINS + 1)
    share = np.diff(prediction.distribution(well, state, edges, blur))
    width = edges[1] - edges[0]
    return DensityTest(
        well,
        state,
        distance,
        float(independent),
        error,
        float(stats.kstwobign.sf(distance * np.sqrt(effective))),
        edges,
        np.histogram(x, bins=edges)[0] / (len(x) * width),
        share / width,
    )
