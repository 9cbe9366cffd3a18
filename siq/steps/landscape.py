"""Landscape: equilibria, one formula for each well, transitions, and U over all wells, of one run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic.dataclasses import dataclass

from siq.certificate.certificates import Certificate
from siq.data.recordings import Recordings, snapshot_pairs
from siq.dynamics.phase_portrait import evenly_spread, phase_portrait
from siq.errors import NumericalFailure
from siq.identify.filtered_states import of_all_states
from siq.identify.storage import FieldRecord
from siq.landscape.dwell_times import NoiseStrength
from siq.landscape.finding import find_landscape
from siq.landscape.landscape import Landscape
from siq.landscape.options import LandscapeOptions
from siq.landscape.record_test import VisitTest
from siq.landscape.storage import write_landscape
from siq.numerics.randomness import Purpose, generator
from siq.potential.refinement import RefinementOptions
from siq.potential.storage import read_model
from siq.potential.well import Well
from siq.steps.landscape_tables import degree_rows, landscape_rows
from siq.steps.outcomes import Method, Outcome, Status, Step, write_outcomes
from siq.steps.settings import STRICT, Sampling, StateSpace
from siq.study.tables import as_table, write_table


@dataclass(frozen=True, config=STRICT)
class LandscapeSettings:
    """What a landscape depends on."""

    seed: int
    space: StateSpace
    sampling: Sampling
    refinement: RefinementOptions
    landscape: LandscapeOptions | None


@plain_dataclass(frozen=True)
class FoundLandscape:
    """The landscape of a run with the f that it is of, None where it could not be found."""

    landscape: Landscape | None
    record: FieldRecord | None
    outcome: Outcome


def run(
    settings: LandscapeSettings,
    recordings: Recordings | None,
    record: FieldRecord | None,
    *,
    number: int,
    wells: Sequence[Well] = (),
    seek_wells: bool = True,
    certificate: Certificate | None = None,
    visits: tuple[VisitTest, ...] = (),
) -> FoundLandscape:
    """The landscape of the identified f within the recorded region.

    The wells are those of the refinement, with their certificate, and `visits` those that its test against
    the record compared; where it found none, the local route is asked once more, within the whole
    recorded region, unless `seek_wells` says that it shall not.
    """
    if recordings is None or record is None:
        reason = "no vector field was identified"
        return FoundLandscape(None, record, Outcome(number, Step.LANDSCAPE, Status.SKIPPED, reason))
    recordings = of_all_states(recordings, record, pair_step=settings.sampling.pair_step)
    x = snapshot_pairs(recordings, pair_step=settings.sampling.pair_step).x0
    draw = generator(settings.seed, number, Purpose.LANDSCAPE)
    points = x[evenly_spread(x, generator=draw)]
    try:
        portrait = phase_portrait(record.found.dynamics, points, seed=number)
        found = find_landscape(
            record.found, portrait, wells=wells if wells or not seek_wells else None, certificate=certificate,
            options=settings.refinement, noise=noise_strength(settings, record), seed=number,
        )  # fmt: skip
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        return FoundLandscape(None, record, Outcome(number, Step.LANDSCAPE, Status.FAILED, str(error)))
    whole = found.over_wells is not None and not found.notes
    status = Status.OK if whole else Status.WARNING
    outcome = Outcome(number, Step.LANDSCAPE, status, "; ".join(found.notes))
    note = record.diffusion_source.note
    if note is not None:
        found = replace(found, notes=(*found.notes, note))
    # The attractors of both steps are those of one f: where they differ in number, indices mean nothing.
    if visits and max(one.well for one in visits) < len(found.attractors):
        found = replace(found, visits=visits)
    units, time = units_of(recordings, settings.space)
    found = found.in_units(units, time=time)
    return FoundLandscape(found, record, outcome)


def noise_strength(settings: LandscapeSettings, record: FieldRecord) -> NoiseStrength | None:
    """The noise that the recordings show, or else the first that the study gives."""
    if (shown := record.noise_strength) is not None:
        return NoiseStrength(*shown, source="estimated")
    given = () if settings.landscape is None else settings.landscape.noise_intensities
    return NoiseStrength(given[0]) if given else None


def units_of(recordings: Recordings, space: StateSpace) -> tuple[tuple[str, ...], str]:
    """Units of the states and of the time: as the recordings say, or else the card; ``1`` where none does."""
    states = tuple(
        unit or space.unit(name, unknown="1")
        for name, unit in zip(recordings.names, recordings.units, strict=True)
    )
    return states, recordings.time_unit or space.unit("t", unknown="1")


def read_wells(model: str | Path) -> tuple[Well, ...]:
    """V about the attractors as refinement wrote it to `model.json`."""
    formulas, _ = read_model(model)
    return formulas[Method.REFINED].wells if Method.REFINED in formulas else ()


def write(
    found: FoundLandscape,
    *,
    quasipotential: str | Path,
    table: str | Path,
    degrees: str | Path,
    outcome: str | Path,
) -> None:
    """Write `quasipotential.json` with its tables, an empty file and none where there is no landscape."""
    number, rows, accuracy = found.outcome.run, as_table("landscape", []), as_table("degrees", [])
    if found.landscape is None or found.record is None:
        Path(quasipotential).touch()
    else:
        write_landscape(quasipotential, found.landscape, dynamics=found.record.found.dynamics)
        rows, accuracy = (
            landscape_rows(number, found.landscape, found.record.diffusion_source.note),
            degree_rows(number, found.landscape),
        )
    write_table(table, rows)
    write_table(degrees, accuracy)
    write_outcomes(outcome, [found.outcome])
