"""The step that finds the landscape of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from pydantic.dataclasses import dataclass

from siq.data.recordings import Recordings, snapshot_pairs
from siq.errors import NumericalFailure
from siq.inference.identification import FieldRecord
from siq.inference.noisy_sensor import of_all_states
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.certificate import Certificate
from siq.quasipotential.landscape import Landscape, LandscapeOptions
from siq.quasipotential.landscape_assembly import find_landscape
from siq.quasipotential.occupancy import VisitTest
from siq.quasipotential.rates import MeanTime, NoiseStrength, mean_exit_time, mean_residence_time
from siq.quasipotential.refinement import RefinementOptions
from siq.quasipotential.wells import Well, best_trial
from siq.remarks import Remark
from siq.systems.cycles import Cycle
from siq.systems.phase_portrait import evenly_spread, phase_portrait
from siq.workflow.outcomes import Outcome, Status, Step
from siq.workflow.settings import STRICT, Sampling, StateSpace
from siq.workflow.tables import as_table


def place(position: np.ndarray) -> str:
    """A state as text."""
    return "(" + ", ".join(f"{value:.6g}" for value in position) + ")"


def landscape_rows(run: int, found: Landscape, remark: str | None = None) -> pd.DataFrame:
    """One row for each equilibrium, cycle and way out; `remark` is of what all barriers hang on.

    Mean times are for the noise of the landscape: of an attractor the time in its well, of a transition that
    over its saddle alone; the error is that of data and law together.
    """
    names = [f"A{index + 1}" for index in range(len(found.attractors))]
    heights = {place(one.position): index for index, one in enumerate(found.attractors)}
    tops: dict[str, float] = {}
    for way in found.transitions:
        top = found.heights[way.start] + way.barrier
        tops[place(way.saddle.position)] = min(top, tops.get(place(way.saddle.position), np.inf))
    noise = found.noise
    rows: list[dict[str, object]] = []
    for one in found.equilibria:
        index = heights.get(place(one.position))
        eigenvalues = ", ".join(_complex(value) for value in one.eigenvalues)
        rows.append(
            {
                "run": run,
                "item": "" if index is None else names[index],
                "kind": one.kind,
                "position": place(one.position),
                "eigenvalues": eigenvalues,
                "U": tops.get(place(one.position), np.nan) if index is None else found.heights[index],
                "basin": np.nan if index is None else found.basins[index],
            }
            | ({} if index is None else _time(found, mean_residence_time(found.exits(index), found.noise)))
        )
    rows += [_cycle_row(run, found, one, names, tops) for one in (*found.cycles, *found.parting)]
    for way in found.transitions:
        beyond = "outside" if way.end is None else names[way.end]
        rows.append(
            {
                "run": run,
                "item": f"{names[way.start]} to {beyond}",
                "kind": "transition",
                "position": place(way.place),
                "U": found.heights[way.start] + way.barrier,
                "barrier": way.barrier,
                "standard_error": way.standard_error,
                "formula_share": way.formula_share,
                "minimum_action": np.nan if way.path is None else way.path.uphill.action,
                "prefactor": np.nan if way.rate is None else way.rate.prefactor,
                "barrier_over_noise": np.nan if noise is None else way.barrier / noise.intensity,
                "note": "; ".join([*way.notes, *([] if remark is None else [remark])]),
            }
            | _time(found, None if noise is None else mean_exit_time(way.exit, noise))
        )
    return as_table("landscape", rows)


def _cycle_row(
    run: int, found: Landscape, one: Cycle, names: list[str], tops: dict[str, float]
) -> dict[str, object]:
    """Of a cycle, one of its states, the Floquet exponents, and a note with period and multipliers."""
    index = next((at for at, other in enumerate(found.attractors) if other is one), None)
    multipliers = ", ".join(_complex(value) for value in one.multipliers)
    return {
        "run": run,
        "item": "" if index is None else names[index],
        "kind": one.kind,
        "position": place(one.position),
        "eigenvalues": ", ".join(_complex(value) for value in one.eigenvalues),
        "U": tops.get(place(one.position), np.nan) if index is None else found.heights[index],
        "basin": np.nan if index is None else found.basins[index],
        "note": f"period {one.period:.8g}, Floquet multipliers {multipliers}",
    }


def _complex(value: complex) -> str:
    return f"{value.real:.4g}" + (f"{value.imag:+.4g}i" if value.imag else "")


def _time(found: Landscape, mean: MeanTime | None) -> dict[str, object]:
    noise = np.nan if found.noise is None else found.noise.intensity
    if mean is None:
        return {"noise": noise}
    return {"noise": noise, "mean_time": mean.value, "mean_time_error": mean.value * mean.error}


def degree_rows(run: int, found: Landscape) -> pd.DataFrame:
    """Accuracy against number of terms, about each attractor."""
    rows = [
        {
            "run": run, "attractor": f"A{index + 1}", "degree": trial.degree, "terms": trial.terms,
            "residual": trial.residual, "covered": trial.covered, "chosen": number == best_trial(well.trials),
        }
        for index, well in enumerate(found.wells)
        if well is not None
        for number, trial in enumerate(well.trials)
    ]  # fmt: skip
    return as_table("degrees", rows)


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

    def files(self) -> dict[str, Any]:
        """By the names of the rule."""
        number, stored = self.outcome.run, None
        rows, accuracy = as_table("landscape", []), as_table("degrees", [])
        if self.landscape is not None and self.record is not None:
            stored = self.landscape
            rows = landscape_rows(number, self.landscape, self.record.diffusion_source.note)
            accuracy = degree_rows(number, self.landscape)
        return {
            "quasipotential": stored, "landscape": rows, "degrees": accuracy,
            "landscape_outcome": [self.outcome],
        }  # fmt: skip


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
    whole = found.global_quasipotential is not None and not found.notes
    status = Status.OK if whole else Status.WARNING
    outcome = Outcome(number, Step.LANDSCAPE, status, "; ".join(found.notes))
    note = record.diffusion_source.note
    if note is not None:
        remark = Remark("quasipotential.reason", {"reason": note})
        found = replace(found, remarks=(*found.remarks, remark))
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
