"""Studies of mismatch: which simulation is compared with which recordings, and how.

`MismatchStudy` is the schema of a study, `SearchOptions` says what counts as found, and `Comparison` is a
case that was read and checked: the simulation, the recordings to learn from and those held out, and the
mechanisms that may be named.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.interpolate import PPoly

from siq.data.preparation import outliers
from siq.data.recordings import Recordings, read_recordings
from siq.diagnosis.dictionary import Mechanism, dictionary_of
from siq.errors import Fault, InputError
from siq.inference.budget import DEFAULT_SECONDS, DEFAULT_WORK
from siq.inference.measurements import Measurements, measurements, with_variation
from siq.inference.trajectories import PREFIX, SHORTEST_PREFIX
from siq.numerics.files import read_document, validate
from siq.remarks import Remark
from siq.systems.cards import load_system
from siq.systems.dynamics import Dynamics

if TYPE_CHECKING:
    import pandas as pd

MIN_SAMPLES = 8  # of a recording that something can be learned from


class SearchOptions(BaseModel):
    """What counts as found."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    #: Probability of a mechanism where none is missing, over all candidates together, for each test
    false_alarms: Annotated[float, Field(gt=0, lt=1)] = 0.002
    #: Candidates whose χ² is within this of the best are indistinguishable from it
    same: Annotated[float, Field(gt=0)] = 10.0
    #: Most candidates that are fitted after each screening
    fitted: Annotated[int, Field(ge=1)] = 6
    #: Most mechanisms that are looked for
    mechanisms: Annotated[int, Field(ge=1, le=5)] = 3
    #: Probability beforehand that what a simulation lacks is not in the dictionary
    unnamed: Annotated[float, Field(gt=0, lt=1)] = 0.1
    #: By ``physics`` what nearly every system of a kind has is likelier than what few have, as the weights of
    #: the dictionary say; ``flat`` makes all mechanisms alike
    prior: Literal["physics", "flat"] = "physics"
    #: Most probability of a name that is wrong, since something without a name looks alike. What is less
    #: certain is detected, and described.
    wrong_names: Annotated[float, Field(gt=0, lt=0.5)] = 0.05
    #: Least number of blocks into which recordings are cut for clustered errors, where there are fewer than
    #: half as many recordings
    blocks: Annotated[int, Field(ge=4)] = 10

    @property
    def least_log_odds(self) -> float:
        """Logarithm of the odds that a name takes."""
        return math.log((1 - self.wrong_names) / self.wrong_names)


class MismatchVerdict(StrEnum):
    """What a diagnosis ends with, as files have it."""

    NO_MISMATCH = "no mismatch"
    PARAMETER_SHIFT = "parameter shift"
    MISSING_PHYSICS = "missing physics"
    UNEXPLAINED = "unexplained"

    @property
    def mismatch(self) -> bool:
        """Whether the equations differ from the system, whatever their parameters."""
        return self in (MismatchVerdict.MISSING_PHYSICS, MismatchVerdict.UNEXPLAINED)

    @property
    def names(self) -> bool:
        """Whether what is missing has a name."""
        return self is MismatchVerdict.MISSING_PHYSICS


class Allowance(BaseModel):
    """How much work a case may take."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    #: Of the likelihood for one sample, one state and one column of derivatives (`siq.inference.budget`). The
    #: default takes about five minutes of a core.
    evaluations: Annotated[float, Field(gt=0)] = DEFAULT_WORK
    #: By the clock, a safety net for machines on which that takes far longer
    seconds: Annotated[float, Field(gt=0)] = DEFAULT_SECONDS


class MismatchStudy(BaseModel):
    """The schema of ``config/mismatch/NAME.yaml``, and of ``study.yaml`` in the folder of a case."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    #: What the report is headed
    title: str = ""
    #: The simulation: name of a system card, or path of one. In the folder of a case it is ``system.yaml``.
    system: str | None = None
    #: Path of the long table. In the folder of a case it is ``recordings.parquet`` or ``.csv``.
    recordings: str | None = None
    #: Recordings that take no part in finding anything: their labels, or their share. Where there is only one
    #: recording, the share is its last part.
    held_out: tuple[str, ...] | Annotated[float, Field(gt=0, lt=1)] = 0.25
    #: Labels of held-out recordings by which somebody else scores: they are shown, and choose nothing. Where
    #: all that is held out are tests, a model of what has no name has to predict the parts of the recordings
    #: to learn from, each left out of its fit in turn.
    tests: tuple[str, ...] = ()
    #: Standard deviation of the measurement noise by output, where it is known; by default it is estimated
    noise: dict[str, Annotated[float, Field(gt=0)]] = {}
    #: Whether samples that stand apart from a smooth motion on either side, and drop-outs, are left out: the
    #: sensor made them. Turn it off where the system itself does something that lasts for one sample.
    without_outliers: bool = True
    #: Parameters that differ from recording to recording, such as a friction that the temperature changes
    varies: tuple[str, ...] = ()
    #: Further entries of the dictionary; one of a known name replaces it
    mechanisms: tuple[Mechanism, ...] = ()
    #: Names of entries that are not to be used
    without: tuple[str, ...] = ()
    #: Highest degree of formulas that describe what has no name
    degree: Annotated[int, Field(ge=1, le=5)] = 3
    #: What counts as found
    search: SearchOptions = SearchOptions()
    #: How much work the search may take before the best answer so far is given
    budget: Allowance = Allowance()


def load_mismatch_study(path: str | Path) -> MismatchStudy:
    """Read a study of mismatch.

    Raises
    ------
    InputError
        With the line of the first entry that cannot be used.
    """
    return validate(read_document(path), MismatchStudy)


def _measurements_of(recordings: Recordings | pd.DataFrame | str | Path, system: Dynamics) -> Measurements:
    """The recordings that a simulation is to be compared with, laid out for fitting."""
    file = str(recordings) if isinstance(recordings, str | Path) else "the recordings"
    columns, states = (
        (*system.output_names, *(one.name for one in system.inputs)),
        dict(zip(system.states, system.units, strict=True)),
    )
    # The unit of each column, as far as it follows from those of the states and inputs.
    units = {name: states[str(formula)] for name, formula in system.outputs if str(formula) in states}
    units |= {entry.name: entry.unit for entry in system.inputs} | {"t": system.time_unit}
    if isinstance(recordings, Recordings):
        for name in columns:
            if name not in recordings.names:
                remedy = f"the simulation needs it; there are {', '.join(recordings.names)}"
                raise InputError(file, "", f"the column '{name}' is missing", remedy)
        places = [recordings.names.index(name) for name in columns]
        chosen = replace(
            recordings, names=tuple(columns), units=tuple(recordings.units[place] for place in places),
            values=np.ascontiguousarray(recordings.values[:, places]),
        )  # fmt: skip
        for name, unit in {"t": chosen.time_unit, **dict(zip(columns, chosen.units, strict=True))}.items():
            if unit is not None and name in units and unit != units[name]:
                fault = f"its unit is {unit}, and in the simulation it is {units[name]}"
                raise InputError(file, f"column {name}", fault, "convert one of the two")
    elif isinstance(recordings, str | Path):
        chosen = read_recordings(recordings, columns=columns, units=units, gaps=False)
    else:
        chosen = Recordings.from_frame(recordings, columns=columns, units=units)
    try:
        data = measurements(chosen, system)
    except Fault as error:
        raise error.at(file) from None
    if (np.diff(data.first) < MIN_SAMPLES).all():
        fault, remedy = f"it has fewer than {MIN_SAMPLES} samples", "record more, or join recordings"
        raise InputError(file, f"recording {data.labels[0]}", fault, remedy)
    return data


@dataclass(frozen=True)
class Comparison:
    """What is compared with what: the simulation, recordings to learn from, and those held out.

    The settings say how, the dictionary has the mechanisms that may be named, and remarks say what was
    left out.
    """

    system: Dynamics
    learn: Measurements
    kept: Measurements
    settings: MismatchStudy
    dictionary: tuple[Mechanism, ...]
    remarks: tuple[Remark, ...] = ()

    def with_variation(self, names: tuple[str, ...]) -> Comparison:
        """The same where parameters differ from recording to recording."""
        system, learn, kept = with_variation(self.system, names, self.learn, self.kept)
        settings = self.settings.model_copy(update={"varies": names})
        return replace(self, system=system, learn=learn, kept=kept, settings=settings)

    def with_held_inputs(self) -> Comparison | None:
        """The same with inputs held between samples where the card is silent; None where it never is."""
        inputs, straight = self.system.inputs, [len(each.c) == 2 for each in self.learn.courses[0]]
        held = [each.interpolation is None and line for each, line in zip(inputs, straight, strict=True)]
        if not any(held):
            return None

        def of(data: Measurements) -> Measurements:
            each = (zip(courses, held, strict=True) for courses in data.courses)
            courses = (tuple(PPoly(c.c[-1:], c.x) if change else c for c, change in one) for one in each)
            return replace(data, courses=tuple(courses))

        named = {each.name for each, change in zip(inputs, held, strict=True) if change}
        inputs = tuple(replace(e, interpolation="zero_order") if e.name in named else e for e in inputs)
        remarks = (*self.remarks, Remark("diagnosis.held_inputs", {"inputs": sorted(named)}))
        system, learn, kept = replace(self.system, inputs=inputs), of(self.learn), of(self.kept)
        return replace(self, system=system, learn=learn, kept=kept, remarks=remarks)


def comparison_of(
    system: Dynamics, recordings: Recordings | pd.DataFrame | str | Path,
    settings: MismatchStudy | None = None, *, file: str = "the settings",
) -> Comparison:  # fmt: skip
    """Check a simulation, recordings and settings against each other.

    Parameters
    ----------
    system
        The simulation. A state needs no domain; the recordings tell where it lies.
    recordings
        With a column for each output and each input.
    settings
        What is held out, what is known of the noise, and what counts as found.
    file
        What messages about the settings call them.

    Raises
    ------
    InputError
        For the first thing that cannot be used, with its file, place and remedy.
    """
    settings = MismatchStudy() if settings is None else settings
    data = _measurements_of(recordings, system)
    for name in settings.noise:
        if name not in system.output_names:
            remedy = f"use one of {', '.join(system.output_names)}"
            raise InputError(file, "noise", f"'{name}' is no output", remedy)
    if settings.noise:
        known = [settings.noise.get(name, np.nan) ** 2 for name in system.output_names]
        data = replace(data, sensor_noise=np.array(known))
    remarks, short = [], np.diff(data.first) < MIN_SAMPLES
    if short.any():
        named = [label for label, each in zip(data.labels, short, strict=True) if each]
        remarks = [Remark("diagnosis.too_short", {"recordings": named, "least": MIN_SAMPLES})]
        data = data.select(np.flatnonzero(~short).tolist())
    if settings.without_outliers:
        inputs, cleared = data.signals(data.t, data.recording, delays=()).inputs, data.outputs.copy()
        for name, column in zip(system.output_names, cleared.T, strict=True):
            apart = outliers(data.t, column, data.recording, inputs)
            if apart.any():
                column[apart] = np.nan
                remarks.append(Remark("data.outliers", {"column": name, "samples": int(apart.sum())}))
        data = replace(data, outputs=cleared)
    near = {each.name: f"{each.error:.3g}" for each in system.parameters if each.error and not each.fixed}
    if near:
        remarks.append(Remark("diagnosis.known_to", {"errors": near}))
    learn, kept = _split(data, settings, file=file)
    for name in settings.varies:
        if not any(each.name == name and each.value and not each.fixed for each in system.parameters):
            fault = f"'{name}' is no parameter of the card that is free, with a value other than zero"
            raise InputError(file, "varies", fault, "name one that is")
        if len(learn.labels) < 2:
            fault = "there is one recording to learn from"
            raise InputError(file, "varies", fault, "give several, or leave it out")
    dictionary = dictionary_of(without=settings.without, further=settings.mechanisms, file=file)
    case = Comparison(system, learn, kept, settings, dictionary, tuple(remarks))
    return case.with_variation(settings.varies) if settings.varies else case


def _split(data: Measurements, study: MismatchStudy, *, file: str) -> tuple[Measurements, Measurements]:
    """Recordings to learn from, and those held out; of a single recording its first part and its last."""
    count = len(data.labels)
    for label in study.tests:
        if isinstance(study.held_out, float) or label not in study.held_out:
            fault, remedy = f"the recording '{label}' is not held out", "list it in held_out, too"
            raise InputError(file, "tests", fault, remedy)
    if isinstance(study.held_out, float):
        if count == 1:
            # What is held out goes on from the samples before it, which tell its state and are not scored.
            rows = len(data.t)
            at = max(round((1 - study.held_out) * rows), min(SHORTEST_PREFIX, rows - 1))
            begin = max(at - max(int(PREFIX / (1 - PREFIX) * (rows - at)), SHORTEST_PREFIX), 0)
            last = replace(
                data, first=np.array([0, rows - begin]), t=data.t[begin:], outputs=data.outputs[begin:]
            )
            return data.until(np.array([at])), last
        # Spread over all of them, so that a drift of the experiment is in both parts.
        out = min(max(round(study.held_out * count), 1), count - 1)
        chosen = set(np.linspace(0, count - 1, 2 * out + 1).round().astype(int)[1::2].tolist())
        lengths = np.diff(data.first)
        if 1.5 * lengths[[*chosen]].sum() > lengths.sum():  # a third, a choice, tells too little
            chosen = set(np.argsort(lengths, kind="stable")[:out].tolist())
    else:
        for label in study.held_out:
            if label not in data.labels:
                fault, remedy = f"no recording is called '{label}'", f"use labels such as {data.labels[0]}"
                raise InputError(file, "held_out", fault, remedy)
        chosen = {data.labels.index(label) for label in study.held_out}
        if not chosen or len(chosen) == count:
            raise InputError(file, "held_out", "one side of the split is empty", "hold out some, not all")
    return data.select([each for each in range(count) if each not in chosen]), data.select(sorted(chosen))


def read_case(card: str | Path, recordings: str | Path, study: str | Path | None) -> Comparison:
    """Read and check the files of a case.

    Raises
    ------
    InputError
        For the first thing that cannot be used, with its file, place and remedy.
    """
    system = load_system(card)
    if study is None:
        return comparison_of(system, recordings)
    return comparison_of(system, recordings, load_mismatch_study(study), file=str(study))
