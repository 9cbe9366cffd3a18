"""The statement of a diagnosis: what `verdict.json` holds, as data.

The verdict, mechanisms with their parameters, errors and evidence, the place of the mismatch, the errors on
held-out recordings and bounds of what was not found. `siq.report.diagnosis_page` has the sentences: the page,
the report as text and the terminal all show these, so that none can contradict another.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any

from pydantic import BeforeValidator, TypeAdapter
from pydantic_core import to_jsonable_python

from siq.diagnosis.evidence import BUDGET_SPENT, NotFitted
from siq.diagnosis.holdout import HeldOutErrors
from siq.diagnosis.mechanisms import MECHANISM, PROCESS_NOISE, Kind
from siq.diagnosis.search import Standing
from siq.diagnosis.study import MismatchVerdict
from siq.inference.budget import UNLIMITED, Account
from siq.remarks import Remark

METRIC = "normalised rms, held-out recordings"
SHAPE = ("shape", "formula", "sizes", "like")
VERSION = 2  # of ``verdict.json``; since 2 missing physics may be modelled, see `Statement.outcome`
# JSON has no number for what is not finite: it is null there.
Number = Annotated[float, BeforeValidator(lambda value: float("nan") if value is None else value)]


@dataclass(frozen=True)
class Estimate:
    """A parameter's value with its standard error, None where it has none, and its unit."""

    estimate: Number
    standard_error: float | None
    unit: str


@dataclass(frozen=True)
class Evidence:
    """Why a mechanism is believed (`siq.diagnosis.evidence.FittedCandidate`); None where no test applies.

    The log-odds are those that it is this mechanism, rather than a function without a name.
    """

    delta_chi2: float | None
    delta_bic: float | None
    p_white: float | None
    p_cluster: float | None
    log_odds: float | None = None


@dataclass(frozen=True)
class Alternative:
    """A mechanism that was fitted in the place of one that was found; its gain is over the same simulation.

    It has so many further parameters. It explains the recordings as well (``same``); as much, with further
    parameters that gain no more than they would by chance (``needless``); or less (``less``).
    """

    name: str
    label: str
    delta_chi2: float
    further_parameters: int
    standing: Standing


@dataclass(frozen=True)
class DescribedCurve:
    """A function of one coordinate with its standard errors, in the units of the card; each as long."""

    coordinate: str
    at: tuple[float, ...]
    value: tuple[Number, ...]
    standard_error: tuple[Number, ...]


@dataclass(frozen=True)
class DescribedSurface:
    """A function of two coordinates with its standard errors, in the units of the card.

    It is given on a grid, along the first and along the second of them; values have a row for each place
    along the first.
    """

    coordinates: tuple[str, str]
    at: tuple[tuple[float, ...], tuple[float, ...]]
    value: tuple[tuple[Number, ...], ...]
    standard_error: tuple[tuple[Number, ...], ...]


@dataclass(frozen=True, kw_only=True)
class StatedTerm:
    """A mechanism that is named, or that describes what has no name; or a part of the model of the latter."""

    #: Of the dictionary; told apart from its other forms and places; and the kind of physics that it is
    name: str
    label: str
    family: str = ""
    variant: str = ""
    #: ``mechanism``: one of the dictionary. ``formula``: a sum of a few powers. ``curve``, ``surface``: a
    #: smooth function of one coordinate, or of two, as a sum of Gaussian bumps.
    kind: Kind = MECHANISM
    #: What is added, by equation; see `siq.diagnosis.mechanisms.MechanismCandidate.changes`; and what it
    #: brings
    terms: Mapping[str, str]
    parameters: Mapping[str, Estimate]
    #: Why it is believed, and labels of what was in place when it was judged
    evidence: Evidence
    #: Of a mechanism that was found: what all mechanisms together explain of the excess over noise; names of
    #: mechanisms that explain the recordings as well, None where it is not named itself; and what else was
    #: fitted in its place, the one that gains most first
    share_of_excess: float = 0.0
    indistinguishable_from: tuple[str, ...] | None = None
    #: States in whose equations it changes something; or what is measured otherwise, for a fault of a sensor
    equations: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    #: Of a part of a model: what it depends on; and its values, where it is a function of one coordinate or a
    #: surface. A curve in two coordinates is the coefficient of the second.
    coordinates: tuple[str, ...] = ()
    curve: DescribedCurve | None = None
    surface: DescribedSurface | None = None
    #: Of a curve: the simplest formula within its errors (`siq.diagnosis.smooth_functions.FORMS`), its
    #: coefficients in the order of the formula, and the mechanism of the dictionary that is such a function.
    #: Where no formula is, the shape is ``rising`` or ``falling`` or nothing. Of a hidden state it is
    #: ``late`` or ``ringing``, with the time of it.
    shape: str = ""
    formula: str = ""
    sizes: Mapping[str, Estimate] = field(default_factory=dict)
    like: str = ""
    beside: tuple[str, ...] = ()
    rivals: tuple[Alternative, ...] = ()

    def alternative_names(self, standing: Standing) -> list[str]:
        """Names of alternatives, each once; their labels where the name alone is the mechanism's own."""
        names = (
            each.label if each.name == self.name else each.name
            for each in self.rivals
            if each.standing == standing
        )
        return list(dict.fromkeys(names))


@dataclass(frozen=True)
class Description:
    """What is known of a mismatch that has no name."""

    #: Share of the excess that these mechanisms describe, which explain a part and are not named.
    share_described: float
    by: tuple[StatedTerm, ...]
    #: p-value of the test that what is left is noise: how often noise alone would look as structured.
    p_residuals_random: float
    random_forces_admitted: bool  #: whether the fit needed process noise
    #: Whether the mechanisms explain enough, and a function without a name is nearly as likely.
    too_faint: bool = False
    #: Whether the mechanisms are not named since recordings held out do not bear them out.
    misleading: bool = False


@dataclass(frozen=True)
class Recalibrated:
    """A parameter of the simulation before and after the fit, with its standard error and unit."""

    before: float
    after: float
    standard_error: Number
    unit: str = "1"


@dataclass(frozen=True)
class UpperBound:
    """At most so large (95 %) is a parameter of a mechanism that was not found."""

    upper_bound_95: float
    unit: str
    parameter: str
    label: str


@dataclass(frozen=True)
class Location:
    """Where a mismatch sits."""

    equations: dict[str, float]  #: share of each in the excess, largest first; none for a fault of a sensor
    coordinate: str  #: along which it acts
    #: The part of the coordinate's range where it can be seen, by coordinate.
    region: dict[str, tuple[float, float]]
    time: tuple[float, float] | None  #: first and last time of it, where it acts along time only
    #: Labels of those that show it, and how many it was sought in.
    recordings: tuple[str, ...]
    recordings_total: int = 0
    outputs: tuple[str, ...] = ()  #: what is measured otherwise, for a fault of a sensor
    unit: str = "1"  #: of the coordinate


@dataclass(frozen=True)
class Statement:
    """All that a diagnosis states."""

    #: One of four, and what is named.
    verdict: MismatchVerdict
    mechanisms: tuple[StatedTerm, ...] = ()
    #: Of a mismatch without a name; and the model of it that is part of the new card, empty where nothing
    #: that was added helped. A model that leaves nothing to be explained is missing physics, too.
    description: Description | None = None
    described: tuple[StatedTerm, ...] = ()
    location: Location | None = None  #: where the mismatch sits, if there is one
    #: The simulation's own parameters, and errors on held-out recordings.
    recalibration: Mapping[str, Recalibrated] = field(default_factory=dict)
    errors: HeldOutErrors = field(default_factory=HeldOutErrors)
    #: Bounds of what was not found, where nothing is missing.
    excluded: Mapping[str, UpperBound] = field(default_factory=dict)
    #: Reservations, and what could not be judged.
    remarks: tuple[Remark, ...] = ()
    not_fitted: tuple[NotFitted, ...] = ()
    #: Logarithms of the marginal likelihoods of whole explanations, less that of the likeliest, which is the
    #: first; see `siq.diagnosis.evidence.log_evidences`.
    explanations: Mapping[str, float] = field(default_factory=dict)
    account: Account = UNLIMITED  #: the work that it took, and whether something was left undone

    @property
    def partial(self) -> bool:
        """Whether the budget was spent before all was tried."""
        return self.account.partial

    @property
    def not_tried(self) -> tuple[str, ...]:
        """Labels of the mechanisms that the budget did not reach."""
        return tuple(each.label for each in self.not_fitted if each.remark == BUDGET_SPENT)

    @property
    def random_forces(self) -> bool:
        """Whether process noise is all that is missing."""
        return [each.name for each in self.mechanisms] == [PROCESS_NOISE]

    @property
    def outcome(self) -> str:
        """The verdict, but that missing physics is ``named``, ``modelled`` or ``process noise``."""
        if self.verdict != MismatchVerdict.MISSING_PHYSICS:
            return str(self.verdict)
        return PROCESS_NOISE if self.random_forces else "named" if self.mechanisms else "modelled"

    @property
    def final_simulation(self) -> str:
        """Which simulation the verdict ends with: ``before``, ``recalibrated`` or ``augmented``."""
        if self.verdict == MismatchVerdict.NO_MISMATCH:
            return "before"
        missing = self.verdict == MismatchVerdict.MISSING_PHYSICS and not self.random_forces
        return "augmented" if self.described or missing else "recalibrated"

    @property
    def sentence(self) -> str:
        """The verdict as a colleague would say it, with the numbers."""
        from siq.report.diagnosis_page import sentences_of  # which stands above this module

        return str(sentences_of(self)["sentence"])

    def as_data(self) -> dict[str, Any]:
        """The content of ``verdict.json``, sentences included; a number that is not finite is null."""
        from siq.report.diagnosis_page import sentences_of  # which stands above this module

        data: dict[str, Any] = to_jsonable_python(
            self, inf_nan_mode="null", fallback=lambda value: value.item()
        )
        by = (data["description"] or {}).get("by", ())
        for each in (*data["mechanisms"], *by):
            for name in ("kind", "coordinates", "curve", "surface", *SHAPE):
                del each[name]
        for each in data["described"]:
            for name in ("share_of_excess", "indistinguishable_from", "rivals"):
                del each[name]
        for each in by:
            del each["indistinguishable_from"]
        data["explanations"] = [
            {"what": what, "log_evidence": value} for what, value in data["explanations"].items()
        ]
        for each, stated in zip(data["not_fitted"], self.not_fitted, strict=True):
            each["reason"] = stated.reason
        data |= {"version": VERSION, "outcome": self.outcome}
        data["fit"] = {"metric": METRIC} | data.pop("errors")
        data |= {"partial": self.partial, "not_tried": list(self.not_tried), "budget": data.pop("account")}
        data["remark_codes"] = data.pop("remarks")
        sentences = sentences_of(self)
        location = sentences.pop("location")
        if self.location is not None:
            data["location"]["sentence"] = location
        return data | sentences

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> Statement:
        """The statement that `as_data` wrote."""
        known = dict(data) | {
            "errors": data["fit"],
            "account": data["budget"] | {"allowed": data["budget"]["allowed"] or float("inf")},
            "remarks": data["remark_codes"],
            "explanations": {each["what"]: each["log_evidence"] for each in data["explanations"]},
        }
        return TypeAdapter(cls).validate_python({each.name: known[each.name] for each in fields(cls)})
