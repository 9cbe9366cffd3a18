"""What a diagnosis states, as objects and as data: `Statement.as_data` is the content of ``verdict.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from siq.estimation.budget import UNLIMITED, Account
from siq.mismatch.candidates import PROCESS_NOISE
from siq.mismatch.held_out_errors import HeldOutErrors
from siq.mismatch.location import Location
from siq.mismatch.possible_verdicts import MismatchVerdict
from siq.mismatch.stated_parts import StatedFunction, StatedMechanism
from siq.mismatch.tried import BUDGET_SPENT

METRIC = "normalised rms, held-out recordings"
UNKNOWN_ERRORS = HeldOutErrors()


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
        p-value of the test that what is left is noise: how often noise alone would look as structured.
    random_forces_admitted
        Whether the fit needed random forces.
    too_faint
        Whether the mechanisms in `by` explain enough, and are not named since a function without a name is
        nearly as likely.
    p_alike
        Probability that as many mechanisms explain as much of an effect that has no name; None where nothing
        is left.
    misleading
        Whether the mechanisms in `by` are not named since recordings held out are foreseen worse with them.
    """

    share_described: float
    by: tuple[StatedMechanism, ...]
    p_residuals_random: float
    random_forces_admitted: bool
    too_faint: bool = False
    p_alike: float | None = None
    misleading: bool = False


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
class Explanation:
    """A whole explanation of the recordings, and how likely it makes them.

    Attributes
    ----------
    what
        What it consists of.
    log_evidence
        Logarithm of its marginal likelihood, less that of the likeliest; see
        `siq.mismatch.evidence.log_evidence_of`.
    """

    what: str
    log_evidence: float


@dataclass(frozen=True)
class Statement:
    """All that a diagnosis states.

    Attributes
    ----------
    verdict
        One of four.
    sentence
        The same as a colleague would say it, with the numbers.
    mechanisms
        What is named.
    description
        Of a mismatch without a name.
    described
        The model of what has no name that is part of the new card; empty where nothing that was added helped.
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
    words
        Further sentences by what they are about; see `siq.mismatch.sentences.words_of`.
    explanations
        Whole explanations that were compared, the likeliest first.
    account
        The work that it took, and whether something was left undone.
    """

    verdict: MismatchVerdict
    sentence: str
    mechanisms: tuple[StatedMechanism, ...] = ()
    description: Description | None = None
    described: tuple[StatedFunction, ...] = ()
    location: Location | None = None
    recalibration: Mapping[str, Recalibrated] | None = None
    errors: HeldOutErrors = UNKNOWN_ERRORS
    excluded: Mapping[str, UpperBound] | None = None
    remarks: tuple[str, ...] = ()
    not_fitted: tuple[NotFitted, ...] = ()
    words: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    explanations: tuple[Explanation, ...] = ()
    account: Account = UNLIMITED

    @property
    def partial(self) -> bool:
        """Whether the budget was spent before all was tried."""
        return self.account.partial

    @property
    def not_tried(self) -> tuple[str, ...]:
        """Labels of the mechanisms that the budget did not reach."""
        return tuple(each.label for each in self.not_fitted if each.reason == BUDGET_SPENT)

    @property
    def random_forces(self) -> bool:
        """Whether random forces are all that is missing."""
        return [each.name for each in self.mechanisms] == [PROCESS_NOISE]

    def as_data(self) -> dict[str, Any]:
        """The content of ``verdict.json``; a number that is not finite is null."""
        errors = asdict(self.errors)
        del errors["squares"]
        data = {
            "verdict": str(self.verdict),
            "sentence": self.sentence,
            "mechanisms": [_mechanism_data(each) for each in self.mechanisms],
            "description": None
            if self.description is None
            else asdict(self.description) | {"by": [_mechanism_data(each) for each in self.description.by]},
            "described": [asdict(each) for each in self.described],
            "location": None if self.location is None else self.location.as_data(),
            "recalibration": {name: asdict(each) for name, each in (self.recalibration or {}).items()},
            "fit": {"metric": METRIC, **errors},
            "excluded": {label: asdict(each) for label, each in (self.excluded or {}).items()},
            "remarks": list(self.remarks),
            "not_fitted": [asdict(each) for each in self.not_fitted],
            "explanations": [asdict(each) for each in self.explanations],
            "partial": self.partial,
            "not_tried": list(self.not_tried),
            "budget": asdict(self.account),
            "words": {about: list(lines) for about, lines in self.words.items()},
        }
        plain: dict[str, Any] = _plain(data)
        return plain


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
