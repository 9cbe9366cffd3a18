"""What a diagnosis states: the verdict in a sentence, mechanisms with their evidence, place, fit and bounds.

`Statement.as_data` is the content of ``verdict.json``, in the order of its contract.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from siq.estimation.estimation import Fit
from siq.estimation.measurements import Measurements
from siq.mismatch.candidates import PROCESS_NOISE
from siq.mismatch.held_out import HeldOutErrors, HeldOutRuns
from siq.mismatch.investigation import Investigation, MismatchVerdict
from siq.mismatch.location import Location, locate
from siq.mismatch.trials import TriedMechanism

METRIC = "normalised rms, held-out recordings"
UNKNOWN_ERRORS = HeldOutErrors(None, None, None, None)
BOUND = 1.96  # standard errors on either side of an estimate within which 95 % lie


@dataclass(frozen=True)
class Estimate:
    """A parameter's value with its standard error, None where it has none, and its unit."""

    estimate: float
    standard_error: float | None
    unit: str


@dataclass(frozen=True)
class Evidence:
    """Why a mechanism is believed; None where a test does not apply.

    Attributes
    ----------
    delta_chi2, delta_bic
        What it gains, see `siq.mismatch.trials.TriedMechanism`.
    p_white, p_cluster
        Probabilities of as much by chance, for independent errors and whatever those within a recording.
    """

    delta_chi2: float | None
    delta_bic: float | None
    p_white: float | None
    p_cluster: float | None


@dataclass(frozen=True)
class StatedMechanism:
    """A mechanism that is named, or that describes what has no name.

    Attributes
    ----------
    name, label
        Of the dictionary, and told apart from its other forms and places.
    terms
        Formula that is added, by equation; see `siq.mismatch.candidates.MechanismCandidate.changes`.
    parameters
        Those that it brings.
    evidence
        Why it is believed.
    share_of_excess
        What all mechanisms together explain of the excess over noise.
    indistinguishable_from
        Names of mechanisms that explain the recordings as well; None where none was compared.
    """

    name: str
    label: str
    terms: Mapping[str, str]
    parameters: Mapping[str, Estimate]
    evidence: Evidence
    share_of_excess: float
    indistinguishable_from: tuple[str, ...] | None = None


@dataclass(frozen=True)
class Description:
    """What is known of a mismatch that has no name.

    Attributes
    ----------
    share_described
        Share of the excess that the mechanisms in `by` describe.
    by
        Mechanisms that explain a part, and are not named.
    p_residuals_random
        Probability that what is left is random.
    random_forces_admitted
        Whether the fit needed random forces.
    """

    share_described: float
    by: tuple[StatedMechanism, ...]
    p_residuals_random: float
    random_forces_admitted: bool


@dataclass(frozen=True)
class Recalibrated:
    """A parameter of the simulation before and after the fit, with the standard error."""

    before: float
    after: float
    standard_error: float


@dataclass(frozen=True)
class UpperBound:
    """At most so large (95 %) is a parameter of a mechanism that was not found."""

    upper_bound_95: float
    unit: str
    parameter: str
    label: str


@dataclass(frozen=True)
class NotFitted:
    """A mechanism of the dictionary that could not be judged, with the reason."""

    mechanism: str
    label: str
    reason: str


@dataclass(frozen=True)
class Statement:
    """All that a diagnosis states.

    Attributes
    ----------
    verdict
        One of four.
    sentence
        The same in words.
    mechanisms
        What is named.
    description
        Of a mismatch without a name.
    location
        Where the mismatch sits, if there is one.
    recalibration
        The simulation's own parameters.
    errors
        On held-out recordings.
    excluded
        Bounds of what was not found, where nothing is missing.
    remarks
        Reservations.
    not_fitted
        What could not be judged.
    """

    verdict: MismatchVerdict
    sentence: str
    mechanisms: tuple[StatedMechanism, ...] = ()
    description: Description | None = None
    location: Location | None = None
    recalibration: Mapping[str, Recalibrated] | None = None
    errors: HeldOutErrors = UNKNOWN_ERRORS
    excluded: Mapping[str, UpperBound] | None = None
    remarks: tuple[str, ...] = ()
    not_fitted: tuple[NotFitted, ...] = ()

    def as_data(self) -> dict[str, Any]:
        """The content of ``verdict.json``; a number that is not finite is null."""
        data = {
            "verdict": str(self.verdict),
            "sentence": self.sentence,
            "mechanisms": [_mechanism_data(each) for each in self.mechanisms],
            "description": None
            if self.description is None
            else asdict(self.description) | {"by": [_mechanism_data(each) for each in self.description.by]},
            "location": None if self.location is None else self.location.as_data(),
            "recalibration": {name: asdict(each) for name, each in (self.recalibration or {}).items()},
            "fit": {"metric": METRIC, **asdict(self.errors)},
            "excluded": {label: asdict(each) for label, each in (self.excluded or {}).items()},
            "remarks": list(self.remarks),
            "not_fitted": [asdict(each) for each in self.not_fitted],
        }
        plain: dict[str, Any] = _plain(data)
        return plain


def statement_of_failure(reason: str) -> Statement:
    """What is stated of a simulation that cannot be fitted to the recordings at all.

    Parameters
    ----------
    reason
        What happened, in lower case and without a full stop.
    """
    return Statement(
        MismatchVerdict.UNEXPLAINED,
        "The simulation cannot be compared with the recordings, since no fit of it has a result.",
        remarks=(f"{reason[:1].upper()}{reason[1:]}.",),
    )


def statement_of(investigation: Investigation, data: Measurements, shown: HeldOutRuns) -> Statement:
    """What follows from an investigation.

    Parameters
    ----------
    investigation
        What was found.
    data
        The recordings that it was found in.
    shown
        The fit on those held out.
    """
    place = locate(investigation, data)
    mechanisms = mechanisms_of(investigation)
    return Statement(
        verdict=investigation.verdict,
        sentence=sentence(investigation.verdict, mechanisms, place),
        mechanisms=mechanisms,
        description=description_of(investigation),
        location=place,
        recalibration=recalibration_of(investigation),
        errors=shown.errors,
        excluded={} if investigation.verdict.mismatch else excluded(investigation),
        remarks=investigation.remarks,
        not_fitted=tuple(
            NotFitted(each.candidate.name, each.candidate.label, each.reason)
            for each in investigation.search.untried
        ),
    )


def mechanisms_of(investigation: Investigation) -> tuple[StatedMechanism, ...]:
    """What is named, each with its evidence."""
    if investigation.verdict is not MismatchVerdict.MISSING_PHYSICS:
        return ()
    if investigation.process_noise:
        return (_process_noise(investigation),)
    return tuple(
        replace(
            _stated(each.best, investigation.search.fit, investigation.share),
            indistinguishable_from=tuple(
                sorted(
                    {other.candidate.name for other in each.indistinguishable} - {each.best.candidate.name}
                )
            ),
        )
        for each in investigation.search.found
    )


def description_of(investigation: Investigation) -> Description | None:
    """What is known of a mismatch that has no name."""
    if investigation.verdict is not MismatchVerdict.UNEXPLAINED:
        return None
    search = investigation.search
    trials = tuple(_stated(each.best, search.fit, investigation.share) for each in search.found)
    return Description(
        share_described=investigation.share if trials else 0.0,
        by=trials,
        p_residuals_random=investigation.after.p_value,
        random_forces_admitted=search.fit.has_process_noise,
    )


def recalibration_of(investigation: Investigation) -> dict[str, Recalibrated]:
    """The simulation's own parameters: on the card, and in the simulation that the verdict ends with."""
    fit = investigation.final
    errors = standard_errors(fit)
    return {
        entry.name: Recalibrated(entry.value, float(fit.model.values[place]), errors[entry.name])
        for place, entry in enumerate(investigation.model.parameters)
        if entry.name in errors
    }


def standard_errors(fit: Fit) -> dict[str, float]:
    """Standard error of every free parameter, by name."""
    names = [fit.model.parameters[place].name for place in fit.model.free]
    return dict(zip(names, map(float, fit.standard_errors), strict=True))


def excluded(investigation: Investigation) -> dict[str, UpperBound]:
    """Upper bounds (95 %) of the amplitudes of mechanisms that were not found."""
    bounds: dict[str, UpperBound] = {}
    for probe, result in investigation.search.screened:
        candidate = probe.candidate
        for name, estimate, error in zip(
            candidate.amplitudes, result.amplitudes, result.standard_errors, strict=False
        ):
            bound = abs(float(estimate)) + BOUND * float(error)
            unit = next(p.unit for p in candidate.model.parameters if p.name == name)
            known = bounds.get(candidate.label)
            if np.isfinite(bound) and error > 0 and (known is None or bound > known.upper_bound_95):
                bounds[candidate.label] = UpperBound(bound, unit, name, candidate.label)
    return dict(sorted(bounds.items()))


def sentence(
    verdict: MismatchVerdict, mechanisms: tuple[StatedMechanism, ...], place: Location | None
) -> str:
    """The verdict in one sentence."""
    if verdict is MismatchVerdict.NO_MISMATCH:
        return "The simulation explains the recordings to within their noise, as it is."
    if verdict is MismatchVerdict.PARAMETER_SHIFT:
        return (
            "The simulation's equations explain the recordings to within their noise, with other parameters."
        )
    where = f" {place.sentence}" if place is not None else ""
    if verdict is MismatchVerdict.UNEXPLAINED:
        return f"The recordings differ from the simulation in a way that no mechanism accounts for.{where}"
    names = [each.name for each in mechanisms]
    if names == [PROCESS_NOISE]:
        return "Random forces drive the system that the simulation does not have."
    return f"The simulation lacks {' and '.join(names)}.{where}"


def _stated(trial: TriedMechanism, final: Fit, share: float) -> StatedMechanism:
    candidate = trial.candidate
    errors = standard_errors(final)
    known = {entry.name: entry for entry in final.model.parameters}
    return StatedMechanism(
        name=candidate.name,
        label=candidate.label,
        terms={name: str(formula) for name, formula in candidate.changes},
        parameters={
            name: Estimate(known[name].value, errors.get(name), known[name].unit)
            for name in candidate.new
            if name in known
        },
        evidence=Evidence(trial.delta_chi2, trial.delta_bic, trial.p_white, trial.p_cluster),
        share_of_excess=share,
    )


def _process_noise(investigation: Investigation) -> StatedMechanism:
    fit = investigation.search.fit
    return StatedMechanism(
        name=PROCESS_NOISE,
        label=PROCESS_NOISE,
        terms={},
        parameters={
            f"intensity_{name}": Estimate(float(value), None, f"({unit})**2/({fit.model.time_unit})")
            for name, unit, value in zip(fit.model.states, fit.model.units, fit.noise.process, strict=True)
            if value > 0
        },
        evidence=Evidence(None, None, None, None),
        share_of_excess=1.0,
        indistinguishable_from=(),
    )


def _mechanism_data(mechanism: StatedMechanism) -> dict[str, Any]:
    data = asdict(mechanism)
    if mechanism.indistinguishable_from is None:
        del data["indistinguishable_from"]
    return data


def _plain(value: Any) -> Any:
    """The same as JSON has it."""
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value
