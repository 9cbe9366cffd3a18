"""Draw: which trajectories has a run? A simulation of its system, or its recordings, resampled."""

from __future__ import annotations

from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from pathlib import Path

from pydantic.dataclasses import dataclass

from siq.data.learnable import read_pairs
from siq.data.recordings import Recordings, write_recordings
from siq.data.selection import in_stretches, resample_recordings
from siq.data.transitions import without_slow_drift
from siq.dynamics.cards import load_system
from siq.dynamics.dynamics import Dynamics
from siq.dynamics.simulation import SimulationOptions, simulate_snapshots
from siq.errors import NumericalFailure
from siq.numerics.randomness import Purpose, generator
from siq.steps.outcomes import Outcome, Status, Step, write_outcomes
from siq.steps.settings import STRICT, Sampling, StateSpace


@dataclass(frozen=True, config=STRICT)
class DrawSettings:
    """What drawing depends on; `simulation` is None where recordings take its place.

    Of the identification it is told one thing: whether the recordings are positions (`hidden_velocities`).
    """

    seed: int
    space: StateSpace
    sampling: Sampling
    simulation: SimulationOptions | None
    hidden_velocities: bool = False


@plain_dataclass(frozen=True)
class Drawn:
    """The trajectories of a run, None where its simulation failed."""

    recordings: Recordings | None
    outcome: Outcome


def run(settings: DrawSettings, source: Dynamics | Recordings, *, number: int) -> Drawn:
    """The trajectories of run `number`.

    Parameters
    ----------
    settings
        What is drawn.
    source
        The system to be simulated, or the recordings: run 0 takes them all, further runs resample them.
    number
        Of the run.
    """
    if isinstance(source, Recordings):
        source = in_stretches(without_slow_drift(source), hidden_velocities=settings.hidden_velocities)
        if number > 0:
            draw = generator(settings.seed, number, Purpose.RESAMPLE)
            source = resample_recordings(source, generator=draw)
        return Drawn(source, Outcome(number, Step.RESAMPLE, reason="; ".join(source.notes)))
    assert settings.simulation is not None  # a system is simulated
    try:
        draw = generator(settings.seed, number, Purpose.SIMULATE)
        recordings = simulate_snapshots(source, options=settings.simulation, generator=draw)
        return Drawn(recordings, Outcome(number, Step.SIMULATE))
    except NumericalFailure as error:
        return Drawn(None, Outcome(number, Step.SIMULATE, Status.FAILED, str(error)))


def read(path: str | Path, settings: DrawSettings) -> Dynamics | Recordings:
    """The card that is simulated, or the recordings in its place.

    Raises
    ------
    InputError
        When the file is refused.
    """
    if settings.simulation is not None:
        return load_system(path)
    recordings, _ = read_pairs(
        path,
        states=settings.space.names,
        units=settings.space.units,
        pair_step=settings.sampling.pair_step,
        hidden_velocities=settings.hidden_velocities,
    )
    space = settings.space
    units = tuple(
        unit or space.unit(name, unknown="") or None
        for name, unit in zip(recordings.names, recordings.units, strict=True)
    )
    return replace(
        recordings, units=units, time_unit=recordings.time_unit or space.unit("t", unknown="") or None
    )


def write(drawn: Drawn, *, recordings: str | Path, outcome: str | Path) -> None:
    """Write the trajectories, an empty file where there are none, and what became of the step."""
    if drawn.recordings is None:
        Path(recordings).touch()
    else:
        write_recordings(recordings, drawn.recordings)
    write_outcomes(outcome, [drawn.outcome])
