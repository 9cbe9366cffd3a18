"""The step that draws the trajectories of a run: a simulation, or recordings resampled."""

from __future__ import annotations

from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from pathlib import Path

from pydantic.dataclasses import dataclass

from siq.data.inspection import read_pairs
from siq.data.recordings import Recordings, read_recordings, write_recordings
from siq.data.selection import in_stretches, resample_recordings
from siq.data.two_states import without_slow_drift
from siq.errors import NumericalFailure
from siq.inference.identification import read_field
from siq.inference.noisy_sensor import of_all_states
from siq.numerics.randomness import Purpose, generator
from siq.systems.cards import load_system
from siq.systems.dynamics import Dynamics
from siq.systems.simulation import SimulationOptions, simulate_snapshots
from siq.workflow.outcomes import Outcome, Status, Step, write_outcomes
from siq.workflow.settings import STRICT, Sampling, StateSpace


def read_run(path: str | Path) -> Recordings | None:
    """The trajectories of a run, or None where drawing them failed and left an empty file."""
    return read_recordings(path) if Path(path).stat().st_size else None


def read_states(path: str | Path, field: str | Path) -> Recordings | None:
    """The same with velocities that were not recorded, as the identified f of the run has them."""
    recordings, record = read_run(path), read_field(field)
    if recordings is None or record is None:
        return recordings
    return of_all_states(recordings, record, pair_step=None)


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
