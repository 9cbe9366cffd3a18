"""The step that draws the trajectories of a run: a simulation, or recordings resampled."""

from __future__ import annotations

from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from pathlib import Path
from typing import Any

from siq.data.preparation import in_stretches, read_pairs, without_slow_drift
from siq.data.recordings import Recordings, resample_recordings
from siq.errors import NumericalFailure
from siq.inference.noisy_sensor import of_all_states
from siq.numerics.randomness import Purpose, generator
from siq.systems.cards import load_system
from siq.systems.dynamics import Dynamics
from siq.systems.simulation import simulate_snapshots
from siq.workflow.files import read
from siq.workflow.outcomes import Outcome, Status, Step
from siq.workflow.settings import PipelineSettings


def read_states(path: str | Path, field: str | Path) -> Recordings | None:
    """Trajectories of a run, with velocities that were not recorded as its identified f has them."""
    recordings, record = read("recordings", path), read("field", field)
    if recordings is None or record is None:
        return recordings
    return of_all_states(recordings, record, pair_step=None)


@plain_dataclass(frozen=True)
class Drawn:
    """The trajectories of a run, None where its simulation failed."""

    recordings: Recordings | None
    outcome: Outcome

    def files(self) -> dict[str, Any]:
        """By the names of the rule."""
        return {"recordings": self.recordings, "draw_outcome": [self.outcome]}


def run(settings: PipelineSettings, source: Dynamics | Recordings, *, number: int) -> Drawn:
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
        hidden = settings.identification.hidden_velocities
        source = in_stretches(without_slow_drift(source), hidden_velocities=hidden)
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


def source_of(path: str | Path, settings: PipelineSettings) -> Dynamics | Recordings:
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
        hidden_velocities=settings.identification.hidden_velocities,
    )
    space = settings.space
    units = tuple(
        unit or space.unit(name, unknown="") or None
        for name, unit in zip(recordings.names, recordings.units, strict=True)
    )
    return replace(
        recordings, units=units, time_unit=recordings.time_unit or space.unit("t", unknown="") or None
    )
