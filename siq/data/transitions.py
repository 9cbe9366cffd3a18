"""How many states does a record itself support, and how often does it hop between them?

Nothing is identified here: this is what the numbers say before any formula does.

*Two states.* A histogram with two peaks is no evidence: a slow background makes one of a single state. Two
states have a place between them *from which the record is pushed away to both sides*: that is the first test.
Where hops are faster than that shows, as in counts of events, there is a second one, a valley of the
histogram that no linear system shows (`siq.data.two_state_tests` has both). Few hops do not pass it, and
records that stay where they are neither; and where a single state attracts beyond doubt by the first test, it
is not asked. Two states are supported if one of the tests says so, and a hop was seen.

*Hops* are counted from one of their levels (`siq.data.two_levels`) to the other (`siq.data.visits`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from siq.data.noise_floor import noise_floors
from siq.data.recordings import Recordings
from siq.data.stationarity import (
    Background,
    background_of,
    relaxation_samples,
    runs_of,
    usual_step,
    without_background,
)
from siq.data.two_levels import two_levels
from siq.data.two_state_tests import SURROGATES, pushed_apart, valley_between
from siq.data.visits import DwellCount, counted_visits, dwell_counts

LEVEL = 0.01  # probability with which a single state is taken for two
DECIDED = 1e-5  # probability for the first test from which on the second one is not asked
PULLED = -3.0  # standard errors: where f falls so clearly from every place to every other, one state attracts


@dataclass(frozen=True)
class Switching:
    """Two states of a record, and its hops between them.

    Attributes
    ----------
    state
        Index of the state (column) that shows them best.
    levels
        The two levels, the lower first, in the unit of the state; of the record less its background.
    spreads
        Standard deviation about each.
    counts
        How long each lasts.
    visits
        Shape ``(n,)``: 0 or 1 at each sample, -1 before the record has reached a level.
    background
        What drifts slowly below both levels.
    relaxation
        The local relaxation time.
    pushed
        By how many standard errors the record is pushed away from between the levels; negative where it is
        pulled there, NaN where it is too short to tell.
    valley
        Share of the samples in the lesser peak of the histogram, above the valley; 0 where there is one peak.
    probability
        Of so much with a single state over a slowly drifting background, both tests and all states counted.
    """

    state: int
    levels: tuple[float, float]
    spreads: tuple[float, float]
    counts: tuple[DwellCount, DwellCount]
    visits: np.ndarray
    background: Background
    relaxation: float
    pushed: float
    valley: float
    probability: float

    @property
    def hops(self) -> int:
        """How many transitions were seen, both ways."""
        return self.counts[0].visits + self.counts[1].visits

    @property
    def supported(self) -> bool:
        """Whether the record supports two states: it is pushed apart, and was seen to hop at least once."""
        return self.probability < LEVEL and self.hops > 0


def switching(recordings: Recordings, *, generator: np.random.Generator | None = None) -> Switching | None:
    """The two states that the recordings show best; None where they are too short to tell anything.

    Every state is looked at by itself, and the one in which the record is pushed apart most clearly is taken.
    Whether two are supported at all is `Switching.supported`.

    Parameters
    ----------
    recordings
        Trajectories, of any number.
    generator
        Where surrogates come from; by default always the same ones.

    Examples
    --------
    >>> import numpy as np
    >>> from siq.data.recordings import Recordings
    >>> generator = np.random.default_rng(1)
    >>> x = np.empty((20_000, 1))
    >>> x[0] = 1.0
    >>> for before in range(len(x) - 1):
    ...     kick = np.sqrt(0.25 * 0.05) * generator.standard_normal()
    ...     x[before + 1] = x[before] + 0.05 * (x[before] - x[before] ** 3) + kick
    >>> found = switching(Recordings.from_arrays(0.05 * np.arange(len(x)), x, names=["x"]))
    >>> found.supported, [round(level, 1) for level in found.levels]
    (True, [-0.9, 0.8])
    """
    runs, step = runs_of(recordings), usual_step(recordings)
    generator = np.random.default_rng(0) if generator is None else generator
    tests: dict[int, tuple[float, float, float, float]] = {}
    for place, column in enumerate(recordings.values.T):
        relaxation = relaxation_samples(column, runs)
        if relaxation is None:  # too short, or a column that runs on like a clock
            continue
        pushed = pushed_apart(column, runs, relaxation) or (float("nan"), 1.0)
        if pushed[0] < PULLED or pushed[1] < DECIDED:
            valley = (valley_between(column, runs, relaxation, generator=None)[0], 1.0)
        else:
            number = SURROGATES * recordings.values.shape[1]
            valley = valley_between(column, runs, relaxation, generator=generator, surrogates=number)
        tests[place] = (min(pushed[1], valley[1]), pushed[0], valley[0], relaxation)
    if not tests:
        return None
    state = min(tests, key=lambda place: (tests[place][0], -tests[place][2]))
    probability, push, depth, relaxation = tests[state]
    values = recordings.values[:, state]
    background, levels, spreads = two_levels(recordings, values, runs, relaxation)
    visits = counted_visits(values - background.values, runs, levels)
    lower, upper = dwell_counts(recordings.t, visits, runs)
    return Switching(
        state,
        levels,
        spreads,
        (lower, upper),
        visits,
        background,
        relaxation * step,
        push,
        depth,
        min(2 * probability * len(tests), 1.0),
    )


def without_slow_drift(recordings: Recordings) -> Recordings:
    """A single long recording less what drifts slowly in it, which a note says for each state.

    Of a record that supports two states the drift is what both levels have in common; of any other, what slow
    cosines explain. Several recordings come back as they are: how they begin may be a part of what they show.
    So does one without random forces, in which nothing but the system itself moves.
    """
    floors = noise_floors(recordings) if len(recordings.labels) == 1 else None
    if floors is None or any(floor.process == 0 for floor in floors):
        return recordings
    found = switching(recordings)
    flat = recordings
    for state, values in enumerate(recordings.values.T):
        if found is not None and found.supported and state == found.state:
            flat = without_background(flat, state, found.background)
        else:
            flat = without_background(flat, state, background_of(recordings, values))
    return flat
