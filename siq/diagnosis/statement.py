"""The statement of a diagnosis: the content of ``verdict.json``.

The page, the report as text and the terminal all show these, so that none can contradict another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
import sympy

from siq.diagnosis.function_sites import FORMULA
from siq.diagnosis.held_out_fit import HeldOutRuns
from siq.diagnosis.holdout import HeldOutErrors
from siq.diagnosis.location import Location
from siq.diagnosis.mechanisms import PROCESS_NOISE
from siq.diagnosis.options import MismatchVerdict
from siq.diagnosis.significance import BUDGET_SPENT
from siq.diagnosis.smooth_functions import CURVE, SURFACE, Smooth
from siq.diagnosis.unnamed_models import MECHANISM, Part
from siq.diagnosis.wording import (
    LISTED,
    DescribedCurve,
    DescribedSurface,
    Estimate,
    Evidence,
    StatedFunction,
    StatedMechanism,
    alternatives,
    as_it_is,
    described_part,
    error_stays,
    gained,
    named,
    not_foreseen,
    or_else,
    placed,
)
from siq.inference.budget import UNLIMITED, Account
from siq.inference.maximum_likelihood import Fit
from siq.numerics.text import (
    SMALLEST_SHARE,
    capital,
    listed,
    number_text,
    p_equation,
    p_text,
    percent,
    value_text,
)
from siq.systems.dynamics import Dynamics, symbol
from siq.systems.formulas import compile_values

COORDINATE = sympy.Symbol("coordinate", positive=True)  # positive, so that the root of its square is itself
GRID = 25  # places along either coordinate of a surface, for its figure
_KINDS: Mapping[str, Literal["formula", "curve", "surface", "mechanism"]] = {
    FORMULA: "formula",
    CURVE: "curve",
    SURFACE: "surface",
    MECHANISM: "mechanism",
}


def stated_functions(shown: HeldOutRuns, *, beside: tuple[str, ...] = ()) -> tuple[StatedFunction, ...]:
    """The parts of the model that is in the new card; none where nothing that was added helped.

    Parameters
    ----------
    shown
        The free runs, with the model.
    beside
        Labels of mechanisms with a name, which were in place before.
    """
    if shown.described is None or shown.described_fit is None or not shown.adopted:
        return ()
    labels = [each.trial.candidate.label for each in shown.described.parts]
    return tuple(
        _stated(part, shown.described_fit, (*beside, *labels[:place]))
        for place, part in enumerate(shown.described.parts)
    )


def _stated(part: Part, fit: Fit, beside: tuple[str, ...]) -> StatedFunction:
    trial, candidate = part.trial, part.trial.candidate
    errors = dict(
        zip(
            (fit.model.parameters[place].name for place in fit.model.free),
            map(float, fit.standard_errors),
            strict=True,
        )
    )
    known = {entry.name: entry for entry in fit.model.parameters}
    changed = [name for name, _ in candidate.changes]
    return StatedFunction(
        name=candidate.name,
        label=candidate.label,
        kind=_KINDS[part.kind],
        terms={name: str(formula) for name, formula in candidate.changes},
        parameters={
            name: Estimate(known[name].value, errors.get(name), known[name].unit) for name in candidate.new
        },
        evidence=Evidence(trial.delta_chi2, trial.delta_bic, trial.p_white, trial.p_cluster),
        equations=candidate.equations,
        outputs=tuple(name for name in changed if name in fit.model.output_names)
        if not candidate.equations
        else (),
        coordinates=part.place.words if part.place is not None else tuple(candidate.coordinate.split(", ")),
        curve=curve_of(part, fit),
        surface=surface_of(part, fit),
        beside=beside,
    )


def curve_of(part: Part, fit: Fit) -> DescribedCurve | None:
    """A function of one coordinate at the knots of its place, with its standard errors.

    None for a formula in two coordinates, for a surface, and for a mechanism.
    """
    place, smooth = part.place, part.smooth
    if place is None or (part.kind != CURVE and len(place.words) > 1):
        return None
    if smooth is not None:
        lower, upper = smooth.limits[:, 0]
        knots = np.linspace(lower, upper, GRID)
        values, errors = _along(smooth, part, fit, knots[None])
    else:
        knots = place.knots
        weights = _terms(part, fit.model, knots)
        values, errors = weights @ _amplitudes(part, fit), _errors(weights, part, fit)
    return DescribedCurve(
        place.words[0], tuple(map(float, knots)), tuple(map(float, values)), tuple(map(float, errors))
    )


def surface_of(part: Part, fit: Fit) -> DescribedSurface | None:
    """A surface on a grid that covers the recordings, with its standard errors; None for anything else."""
    smooth = part.smooth
    if smooth is None or part.kind != SURFACE:
        return None
    at = [np.linspace(lower, upper, GRID) for lower, upper in smooth.limits.T]
    courses = np.stack([each.ravel() for each in np.meshgrid(*at, indexing="ij")])
    values, errors = _along(smooth, part, fit, courses)
    first, second = (tuple(map(float, each)) for each in at)

    def rows(flat: np.ndarray) -> tuple[tuple[float, ...], ...]:
        return tuple(tuple(map(float, row)) for row in flat.reshape(GRID, GRID))

    words = smooth.ground.words
    return DescribedSurface((words[0], words[1]), (first, second), rows(values), rows(errors))


def _along(smooth: Smooth, part: Part, fit: Fit, courses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A smooth function along courses ``(c, k)`` of its coordinates, and its standard errors, ``(k,)``."""
    values, derivatives = smooth.along(_amplitudes(part, fit), courses)
    return values, _errors(derivatives, part, fit)


def _amplitudes(part: Part, fit: Fit) -> np.ndarray:
    known = {each.name: each.value for each in fit.model.parameters}
    return np.array([known[name] for name in part.trial.candidate.amplitudes])


def _errors(weights: np.ndarray, part: Part, fit: Fit) -> np.ndarray:
    """Standard errors of weighted sums ``(k, c)`` of the amplitudes of a part, shape ``(k,)``."""
    free = [fit.model.parameters[each].name for each in fit.model.free]
    rows = [free.index(name) for name in part.trial.candidate.amplitudes]
    variances = np.einsum("kc,cd,kd->k", weights, fit.covariance[np.ix_(rows, rows)], weights)
    return np.sqrt(np.maximum(variances, 0.0))


def _terms(part: Part, model: Dynamics, knots: np.ndarray) -> np.ndarray:
    """What a unit of each coefficient of a formula is at the knots, shape ``(k, c)``."""
    assert part.place is not None
    candidate = part.trial.candidate
    name, formula = candidate.changes[0]
    factor = dict((*part.place.equations, *part.place.outputs))[name]
    columns = []
    for amplitude in candidate.amplitudes:
        term = in_coordinate(formula.diff(symbol(amplitude)) / factor, part.place.coordinate)
        value = compile_values([term], [COORDINATE], common=False)(knots)[0]
        columns.append(np.broadcast_to(np.asarray(value, dtype=float), knots.shape))
    return np.stack(columns, axis=1)


def in_coordinate(term: sympy.Expr, coordinate: sympy.Expr) -> sympy.Expr:
    """A formula in `COORDINATE`, in the place of the formula that the coordinate is.

    The square of ``sqrt(P**2 + Q**2)`` has no root in it, so that what stands under the root is replaced.
    """
    if isinstance(coordinate, sympy.Pow) and coordinate.exp == sympy.Rational(1, 2):
        return term.subs(coordinate.base, COORDINATE**2)
    return term.subs(coordinate, COORDINATE)


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
        `siq.diagnosis.evidence.log_evidence_of`.
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
        Further sentences by what they are about; see `words_of`.
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


NOTICED = 1.96  # standard errors beyond which a parameter counts as changed
LOOKS_RANDOM = 2e-3  # the p-value below which a name is refused; siq.diagnosis.residual_structure.DOUBTFUL


def sentence_of(statement: Statement, units: Mapping[str, str]) -> str:
    """What the page opens with: the verdict, how large, and what it does to the held-out error.

    Parameters
    ----------
    statement
        All but its own sentence.
    units
        Of the simulation's own parameters, by name.
    """
    errors = statement.errors
    if statement.verdict is MismatchVerdict.NO_MISMATCH:
        return f"The simulation explains the recordings as it is. {as_it_is(errors)}".strip()
    if statement.verdict is MismatchVerdict.PARAMETER_SHIFT:
        said = shifted(statement.recalibration or {}, units)
        gain = gained(errors, "before", "recalibrated", it="With the new values", them="them")
        return (
            f"The simulation's equations explain the recordings, but with other parameters: {said}. {gain}"
        ).strip()
    if statement.verdict is MismatchVerdict.UNEXPLAINED:
        return f"{_unexplained(statement)} {_described(statement)}".strip()
    if statement.random_forces:
        return f"{_random_forces(statement.mechanisms[0])} {not_foreseen(errors)}".strip()
    what = " and ".join(named(each) for each in statement.mechanisms)
    they = len(statement.mechanisms) > 1
    # What is credited to physics is only what neither the simulation as given nor other parameters can do.
    gain = gained(
        errors, "without", "named" if statement.described else "augmented",
        it=f"With {'them' if they else 'it'}", them="them" if they else "it",
    )  # fmt: skip
    return f"The simulation lacks {what}. {gain} {_rest(statement)}".strip()


def words_of(statement: Statement) -> dict[str, tuple[str, ...]]:
    """The other sentences, by what they are about.

    Returns
    -------
    dict
        ``alternatives``: what cannot be told apart, and whether anything else would do. ``explained``: how
        much of the difference is explained. ``left``: what that leaves.
    """
    description = statement.description
    mechanisms = statement.mechanisms if description is None else description.by
    return {
        "alternatives": tuple(line for each in mechanisms for line in alternatives(each)),
        "explained": explained(mechanisms),
        "left": () if description is None else left_over(description),
    }


def explained(mechanisms: Sequence[StatedMechanism]) -> tuple[str, ...]:
    """How much of the excess over noise mechanisms explain, all of them together."""
    if not mechanisms or mechanisms[0].name == PROCESS_NOISE:
        return ()
    share = percent(mechanisms[0].share_of_excess)
    who = capital(listed([each.label for each in mechanisms], "and"))
    verb = "explains" if len(mechanisms) == 1 else "together explain"
    return (f"{who} {verb} {share} of the difference that other parameters cannot explain.",)


def left_over(description: Description) -> tuple[str, ...]:
    """Why a mismatch has no name: what is left, and whether it looks like noise."""
    p = description.p_residuals_random
    lines = []
    if description.by and description.misleading:
        lines.append(
            "It is not named: with it, recordings held out are foreseen worse than without, so that it stands"
            " in for something else."
        )
    elif description.by and description.too_faint:
        lines.append(
            "It is not named, since a smooth function that the dictionary does not have is nearly as likely."
        )
    elif description.by and description.p_alike is not None:
        lines.append(
            "It is not named: of effects that have no name, mechanisms explain as much with a probability of"
            f" {p_text(description.p_alike)}."
        )
    elif description.by:
        lines.append("It is not named: what explains only a part may be standing in for something else.")
    if p >= LOOKS_RANDOM:
        lines.append(f"What is left looks like noise ({p_equation(p)}).")
    else:
        lines.append(
            f"What is left is not noise: noise alone would look as structured with a probability of"
            f" {p_text(p)} (the p-value)."
        )
    if description.random_forces_admitted:
        lines.append("Random forces had to stand in for it in the fit.")
    return tuple(lines)


def shifted(recalibration: Mapping[str, Recalibrated], units: Mapping[str, str]) -> str:
    """Which parameters differ from those on the card, the most certain first, with both values."""
    changes = {
        name: abs(each.after - each.before) / each.standard_error if each.standard_error > 0 else float("inf")
        for name, each in recalibration.items()
        if each.after != each.before
    }
    ranked = sorted(changes, key=lambda name: -changes[name])
    if not ranked:
        return "which of them cannot be said"
    certain = [name for name in ranked if changes[name] > NOTICED]

    def change(name: str) -> str:
        each, unit = recalibration[name], units.get(name, "1")
        after = value_text(each.after, each.standard_error, unit=unit)
        return f"{name} is {after}, where the card has {_value(each.before)}"

    if not certain:
        return f"none of them stands out by itself, and most of all {change(ranked[0])}"
    shown = "; ".join(change(name) for name in certain[: LISTED + 1])
    more = len(certain) - LISTED - 1
    return shown if more <= 0 else f"{shown}; and {more} more differ{'s' * (more == 1)}"


def _rest(statement: Statement) -> str:
    """What describes the rest that mechanisms with a name leave, and what that does to the held-out error."""
    if not statement.described:
        return ""
    parts = listed([described_part(each) for each in statement.described], "and")
    verb = "describe" if len(statement.described) > 1 else "describes"
    # The names are what it is compared with, and not the simulation without them.
    gain = gained(statement.errors, "named", "augmented", it="With that, too", them="that")
    return f"What is left has no name; {parts} {verb} it. {gain}".strip()


def _described(statement: Statement) -> str:
    """What the model of something without a name does to the held-out error, or that nothing was gained."""
    errors = statement.errors
    if errors.noise_floor is None or statement.description is None:
        return error_stays(errors)
    if not statement.described:
        return (
            "Neither a mechanism nor a function of its coordinates improves the prediction of recordings"
            f" held out, so that the simulation stays as it was. {error_stays(errors)}"
        ).strip()
    gain = gained(errors, "without", "augmented", it="With it", them="it")
    named = {each.label for each in statement.description.by}
    if all(each.label in named for each in statement.described):
        return gain
    what = " and ".join(described_part(each) for each in statement.described)
    many = len(statement.described) > 1
    return f"{capital(what)} {'describe' if many else 'describes'} it. {gain}".strip()


def _random_forces(mechanism: StatedMechanism) -> str:
    sizes = [
        f"{value_text(entry.estimate, entry.standard_error, unit=entry.unit, digits=3)} on"
        f" {name.removeprefix('intensity_')}"
        for name, entry in mechanism.parameters.items()
    ]
    size = f", with an intensity of {listed(sizes, 'and')}" if sizes else ""
    return f"The system is driven by random forces that the simulation does not have{size}."


def _unexplained(statement: Statement) -> str:
    description = statement.description
    if statement.errors.noise_floor is None and description is None:
        return statement.sentence
    begin = "The recordings differ from the simulation by more than noise and wrong parameters"
    if description is None or not description.by:
        return f"{begin}, and no mechanism in the dictionary accounts for it."
    what = " and ".join(placed(each) for each in description.by)
    what += or_else(description.by[0]) if len(description.by) == 1 else ""
    share = percent(description.share_described)
    if description.misleading:
        return f"{begin}. It looks like {what}, but recordings held out are foreseen worse with that."
    if description.too_faint:
        return f"{begin}. It looks like {what}, which is not certain enough to be named."
    if description.share_described > 1 - SMALLEST_SHARE:
        return (
            f"{begin}. {capital(what)} would account for {share} of it, but not convincingly enough to be"
            " named."
        )
    amount = "no part" if share == "none" else share
    return (
        f"{begin}, and nothing explains it fully. The best description is {what}: it covers {amount} of it."
    )


def _value(value: float) -> str:
    text = f"{value:.6g}"
    return number_text(value) if "e" in text else text.replace("-", "−")
