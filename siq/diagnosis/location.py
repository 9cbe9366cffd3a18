"""Location: in which equation a mismatch sits, along which coordinate and where, in which recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from siq.diagnosis.dictionary import Roles, units_of
from siq.diagnosis.investigation import Investigation
from siq.diagnosis.mechanisms import MechanismCandidate
from siq.diagnosis.options import MismatchVerdict
from siq.diagnosis.residual_structure import Curve, Structure
from siq.diagnosis.unnamed_models import Model
from siq.inference.kalman_filter import Noise, solve, whiten
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.numerics.text import unit_text, value_text

VISIBLE = 0.1  # of the largest value of a curve
TWO_ERRORS = 2.0
NEARLY = 0.9  # of what the best coordinate, or a perfect description, would explain
RIVAL = 0.75  # of what the time or an input tells, from which on it is rather a state
PART = 0.5  # of its fair share of the excess, from which on a recording counts as affected


@dataclass(frozen=True)
class Location:
    """Where a mismatch sits.

    Attributes
    ----------
    equations
        Share of each equation in the excess, largest first; empty for a fault of a sensor.
    coordinate
        Along which it acts.
    region
        The part of the coordinate's range where it can be seen, by coordinate.
    time
        First and last time of it, where it acts along time only.
    recordings
        Labels of those that show it.
    recordings_total
        How many it was sought in.
    outputs
        What is measured otherwise, for a fault of a sensor.
    sentence
        All of it in words.
    curve
        What is missing against the coordinate, where that is a state, an input or an amplitude.
    """

    equations: dict[str, float]
    coordinate: str
    region: dict[str, tuple[float, float]]
    time: tuple[float, float] | None
    recordings: tuple[str, ...]
    sentence: str
    curve: Curve | None
    recordings_total: int = 0
    outputs: tuple[str, ...] = ()

    def as_data(self) -> dict[str, Any]:
        """What the verdict's file says of it."""
        return {
            "equations": self.equations,
            "outputs": list(self.outputs),
            "coordinate": self.coordinate,
            "region": {name: list(limits) for name, limits in self.region.items()},
            "time": None if self.time is None else list(self.time),
            "recordings": list(self.recordings),
            "recordings_total": self.recordings_total,
            "sentence": self.sentence,
        }


def locate(
    investigation: Investigation, data: Measurements, described: Model | None = None
) -> Location | None:
    """Say where a mismatch sits; None where there is none.

    What has no name is where the model of it stands. Where nothing describes it, it is sought in all
    equations by what they leave unexplained.

    Parameters
    ----------
    investigation
        What was found.
    data
        The recordings that it was found in.
    described
        The model of it that is part of the new card; by default the likeliest one, if there is any.
    """
    if not investigation.verdict.mismatch:
        return None
    curves = investigation.before.curves
    named = investigation.search.found[0].best.candidate if investigation.search.found else None
    outputs: tuple[str, ...] = ()
    if investigation.verdict is MismatchVerdict.MISSING_PHYSICS and named is not None:
        equations, coordinate = named.equations, named.coordinate
        outputs = _in_sensors(named)
    elif first := _first_part(investigation, described):
        equations, coordinate, outputs = first.equations, first.coordinate, _in_sensors(first)
    elif curves:
        equations, coordinate = most_telling(investigation.before, investigation.roles)
    else:
        equations, coordinate = (), "unknown"
    curve = next(
        (
            each
            for each in curves
            if each.direction.coordinate == coordinate and set(each.direction.equations) & set(equations)
        ),
        None,
    )
    if investigation.process_noise:
        driven = zip(investigation.model.states, investigation.search.fit.noise.process, strict=False)
        equations, coordinate, curve = tuple(name for name, q in driven if q > 0), "random", None
    region = visible_region(curve) if curve is not None else {}
    recordings = affected(investigation.search.recalibrated, investigation.search.fit.noise, data)
    time = (float(data.t.min()), float(data.t.max())) if coordinate == "t" else None
    return Location(
        equations=equation_shares(investigation, equations),
        coordinate=coordinate,
        region=region,
        time=time,
        recordings=recordings,
        sentence=where_it_sits(
            equations,
            coordinate,
            region,
            affected=len(recordings),
            recordings=len(data.labels),
            units=units_of(investigation.model),
        ),
        curve=curve,
        recordings_total=len(data.labels),
        outputs=outputs,
    )


def _first_part(investigation: Investigation, described: Model | None) -> MechanismCandidate | None:
    """The first part of the model of what has no name: the one that explains most."""
    if investigation.verdict is not MismatchVerdict.UNEXPLAINED:
        return None
    model = described or next(iter(investigation.models), None)
    return None if model is None else model.parts[0].trial.candidate


def _in_sensors(candidate: MechanismCandidate | None) -> tuple[str, ...]:
    """The outputs that a candidate changes, if it changes nothing else."""
    if candidate is None or candidate.equations:
        return ()
    names = set(candidate.model.output_names)
    return tuple(name for name, _ in candidate.changes if name in names)


def most_telling(structure: Structure, roles: Roles) -> tuple[tuple[str, ...], str]:
    """The equation in which something is missing, and the coordinate along which it shows best.

    Where its own motion tells nearly as much as that of others, it is its own; and where any motion tells
    most of what the time or an input tells, it is the motion, since these move a system, too. Where no
    coordinate tells nearly all, a force depends on the course of the motion, position and velocity both.
    """
    best = structure.curves[0]
    equations, coordinate = best.direction.equations, best.direction.coordinate
    own = next((pair for pair in roles.motions if pair[1] in equations), equations)
    if coordinate in (*own, "amplitude"):
        return equations, coordinate
    motion = {*roles.states, *(name for pair in roles.motions for name in pair), "amplitude"}
    rivals, share = (own, NEARLY) if coordinate in motion else (motion, RIVAL)
    for curve in structure.curves:
        there = set(equations) <= set(curve.direction.equations)
        if there and curve.direction.coordinate in rivals and curve.gain >= share * best.gain:
            return curve.direction.equations, curve.direction.coordinate
    excess = structure.total - structure.freedom
    if len(own) > len(equations) and best.gain < NEARLY * excess:
        return equations, ", ".join(own)
    return equations, coordinate


def equation_shares(investigation: Investigation, equations: tuple[str, ...]) -> dict[str, float]:
    """Share of what any one equation can explain, for the equations named."""
    gains: dict[str, float] = {}
    for curve in investigation.before.curves:
        for name in curve.direction.equations:
            gains[name] = max(gains.get(name, 0.0), curve.gain)
    total = max(investigation.before.total - investigation.before.freedom, 1e-300)
    return {name: float(min(max(gains.get(name, 0.0) / total, 0.0), 1.0)) for name in equations}


def visible_region(curve: Curve) -> dict[str, tuple[float, float]]:
    """The range of the coordinate in which the missing part is seen beyond its error."""
    size = np.abs(curve.values)
    seen = (size > TWO_ERRORS * curve.standard_errors) & (size > VISIBLE * size.max())
    knots = curve.direction.knots[seen] if seen.any() else curve.direction.knots
    return {curve.direction.coordinate: (float(knots.min()), float(knots.max()))}


def affected(recalibrated: Fit, noise: Noise, data: Measurements) -> tuple[str, ...]:
    """Recordings whose residuals, random forces not admitted, exceed noise by a fair share of the excess."""
    still = Noise(noise.measurement, np.zeros(recalibrated.model.dimension))
    white = whiten(recalibrated.linearisation, data, still)
    change, _ = solve(white.columns, white.innovations)
    left = white.innovations - white.columns @ change
    squares = np.bincount(white.recording, left**2, minlength=len(data.labels))
    counts = np.bincount(white.recording, white.known, minlength=len(data.labels))
    excess = np.maximum(squares - counts, 0.0)
    if not excess.sum() > 0:
        return data.labels
    fair = counts / counts.sum()
    return tuple(
        label
        for label, own, share in zip(data.labels, excess / excess.sum(), fair, strict=True)
        if own > PART * share
    )


def where_it_sits(
    equations: tuple[str, ...],
    coordinate: str,
    region: Mapping[str, tuple[float, float]],
    *,
    affected: int,
    recordings: int,
    units: Mapping[str, str] | None = None,
) -> str:
    """Say in a sentence where a mismatch sits.

    Parameters
    ----------
    equations
        States in whose equations it shows; none for a fault of the sensor.
    coordinate, region
        Along which it acts, and where it can be seen.
    affected, recordings
        In how many recordings it shows, and how many there are to learn from.
    units
        Of states, inputs and time, by name.
    """
    many = "s" if len(equations) > 1 else ""
    where = f"in the equation{many} of {' and '.join(equations)}" if equations else "in what is measured"
    along = {
        "t": ", in the course of time",
        "constant": ", to the same amount everywhere",
        "random": ", at random",
        "measurement": "",
        "unknown": "",
    }.get(coordinate, f", as a function of {coordinate}")
    if coordinate in region:
        lower, upper = (value_text(limit, digits=3) for limit in region[coordinate])
        unit = unit_text((units or {}).get(coordinate, "1"))
        after = f" {unit}" if unit else ""
        along += f" (near {lower}{after})" if lower == upper else f" (between {lower} and {upper}{after})"
    if recordings == 1:
        who = ""
    elif affected == recordings:
        who = f", in all {recordings} recordings that it was sought in"
    else:
        who = f", mainly in {affected} of {recordings} recordings"
    return f"The difference sits {where}{along}{who}."
