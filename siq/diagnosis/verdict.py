"""The verdict: from an investigation and the runs held out to the statement of a diagnosis.

What is named, with parameters, errors, evidence and alternatives; the model of what has no name; in which
equation the mismatch sits, along which coordinate and where, in which recordings; bounds of what was not
found.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import sympy

from siq.data.correlation import correlation_time_of
from siq.diagnosis.dictionary import Roles, unit_of, units_of
from siq.diagnosis.evidence import BUDGET_SPENT, NUMERICAL_ERRORS, FittedCandidate, log_evidences, residuals
from siq.diagnosis.holdout import NEARLY_ALL, simulated
from siq.diagnosis.investigation import HeldOutRuns
from siq.diagnosis.mechanisms import PROCESS_NOISE, SURFACE, fresh_names, places_of
from siq.diagnosis.naming import Investigation
from siq.diagnosis.residual_structure import Remainder, Structure, remaining_forces
from siq.diagnosis.search import FitContext
from siq.diagnosis.smooth_functions import FORMS, A, B, C, Smoothness, Z
from siq.diagnosis.statement import (
    Alternative,
    DescribedCurve,
    DescribedSurface,
    Description,
    Estimate,
    Evidence,
    Location,
    Recalibrated,
    StatedTerm,
    Statement,
    UpperBound,
)
from siq.diagnosis.study import MismatchVerdict
from siq.diagnosis.terms import Place
from siq.diagnosis.unnamed_models import AugmentedModel
from siq.inference.design import next_experiment
from siq.inference.kalman_filter import Noise
from siq.inference.maximum_likelihood import Fit
from siq.inference.recalibration import wald_probability
from siq.remarks import Remark
from siq.systems.dynamics import symbol
from siq.systems.formulas import compile_values

COORDINATE = sympy.Symbol("coordinate", positive=True)  # positive, so that the root of its square is itself
GRID_POINTS = 25  # places along either coordinate of a curve or surface, for its figure
BOUND_ERRORS = 1.96  # standard errors on either side of an estimate within which 95 % lie
VISIBLE_SHARE = 0.1  # of the largest value of a curve
VISIBLE_ERRORS = 2.0  # standard errors beyond which a curve differs from zero
MOTION_SHARE = 0.75  # of what the time or an input explains, from which on it is rather a state
# Log-odds that an experiment should promise, in those that a name takes: forecasts count all horizons alike,
# and the far ones see one sample in four, in sixteen, in 64.
EXPECTED = 4.0
AFFECTED_SHARE = 0.5  # of its fair share of the excess, from which on a recording counts as affected


def statement_of_failure(reason: str) -> Statement:
    """What is stated of a simulation that cannot be fitted to the recordings at all, for a reason."""
    return Statement(MismatchVerdict.UNEXPLAINED, remarks=(Remark("diagnosis.no_fit", {"reason": reason}),))


def statement_of(investigation: Investigation, shown: HeldOutRuns) -> Statement:
    """What follows from an investigation, and from the runs of recordings held out."""
    search, verdict, described = investigation.search, investigation.verdict, shown.described
    named = verdict.names
    final = investigation.final if named else shown.recalibration
    kept = final.model is investigation.context.model  # the card's own values
    if described is not None:
        final, kept = shown.fit, False
    # What describes the rest may take a part of what is named over.
    found = _found_mechanisms(investigation, investigation.final if named else search.fit)
    names = tuple(each.best.candidate.label for each in search.found) if named else ()
    parts = () if described is None else described.parts
    labels = [each.candidate.label for each in parts]
    errors, remarks, errors_seen = final.error_of, list(investigation.remarks), shown.errors
    left, context = investigation.remainder.after, investigation.context
    if verdict is MismatchVerdict.UNEXPLAINED and described is not None:
        # A model that leaves no more than sensor and randomness do, and not most of the recordings, is an
        # explanation, though it has no name.
        rest = Remainder.of(context.data, described.fit, described.fit, context.roles)
        change = errors_seen.change("without", "augmented")
        most = errors_seen.augmented is not None and errors_seen.augmented**2 < 0.5  # of the spread's square
        to_noise = not (rest.doubtful or described.fit.has_process_noise)
        # Evidence is enough where it is certain, and recordings held out do not speak against it.
        certain = to_noise and described.log_evidence >= context.study.search.least_log_odds
        nearly = not rest.doubtful or errors_seen.at_noise("augmented", random=True)
        nearly = nearly and change == "better" and errors_seen.share_gained >= NEARLY_ALL
        if most and (nearly or (certain and change != "worse")):
            verdict, left = MismatchVerdict.MISSING_PHYSICS, rest.after
    elif verdict is MismatchVerdict.PARAMETER_SHIFT and not context.study.varies:
        # Other parameters have to mend it, by more than chance or down to the noise, or leave only noise.
        # Where each recording has its own, their mean mends none that was held out.
        seen, change = not errors_seen.at_noise("before"), errors_seen.change("before", "recalibrated")
        to_noise = seen and change == "same" and errors_seen.at_noise("recalibrated")
        if shown.together and not to_noise:
            remarks.append(Remark("diagnosis.one_set_of_parameters"))
        elif not (change == "better" or to_noise):
            verdict = MismatchVerdict.UNEXPLAINED if seen else MismatchVerdict.NO_MISMATCH
            remarks.append(Remark("diagnosis.shift_mends_nothing", {"seen": seen}))
    if investigation.account.partial:
        untried = sum(each.remark == BUDGET_SPENT for each in search.untried)
        stopped_by = investigation.account.stopped_by
        remarks.append(Remark("diagnosis.partial", {"untried": untried, "stopped_by": stopped_by}))
    forced = investigation.final if described is None else described.fit
    if verdict.mismatch and forced.has_process_noise and not investigation.process_noise:
        with suppress(*NUMERICAL_ERRORS):
            remarks += remaining_forces(forced, context.data, context.roles)
    # What has no name is no mechanism to be told apart from others.
    remarks += _experiment_to_tell(investigation) if described is None or investigation.verdict.names else []
    remarks += [_variation_of(name, final, context.data.labels) for name in context.study.varies]
    if kept and errors:
        remarks.append(Remark("diagnosis.values_stay"))
    if not shown.independent:
        remarks.append(Remark("diagnosis.one_recording"))
    return Statement(
        verdict=verdict,
        mechanisms=found if investigation.verdict.names else (),
        description=Description(
            share_described=investigation.remainder.share if found else 0.0,
            by=found,
            p_residuals_random=left.p_value,
            random_forces_admitted=(search.fit if described is None else described.fit).has_process_noise,
            too_faint=investigation.too_faint,
            misleading=investigation.withdrawn,
        )
        if verdict.mismatch and not investigation.verdict.names
        else None,
        described=tuple(
            _stated_function(part, final, (*names, *labels[:place]), context)
            for place, part in enumerate(parts)
        ),
        location=_locate(investigation, described) if investigation.verdict.mismatch else None,
        recalibration={
            entry.name: Recalibrated(
                entry.value, float(final.model.values[place]), errors[entry.name], entry.unit
            )
            for place, entry in enumerate(investigation.context.model.parameters)
            if entry.name in errors and not kept and not entry.name.startswith("_")
        },
        errors=errors_seen,
        excluded={} if verdict.mismatch else _excluded(investigation),
        explanations=_explanations(investigation, names),
        remarks=tuple(remarks),
        not_fitted=search.untried,
        account=investigation.account,
    )


def _experiment_to_tell(investigation: Investigation) -> list[Remark]:
    """The recording that would tell what was found from what explains the recordings as well."""
    data = investigation.context.data
    for each in investigation.search.found:
        fit, name = each.best.fit, each.best.candidate.name
        alike = [
            other
            for other in each.others.get("same", ())
            if other.candidate.name != name and other.fit.model.dimension == fit.model.dimension
        ]
        # Nobody can begin at a hidden state that a mechanism brings.
        if alike and fit.model.dimension == investigation.context.model.dimension:
            plan = None
            with suppress(*NUMERICAL_ERRORS):
                run = simulated(fit, data, noise=fit.noise, substeps=fit.substeps)
                missed, outputs = np.nan_to_num(data.outputs - run), run.shape[1]
                recording = np.repeat(data.recording, outputs)
                plan = next_experiment(
                    fit, [other.fit for other in alike], data,
                    correlated=correlation_time_of(missed.ravel(), recording, outputs=outputs),
                    variance=np.maximum((missed**2).mean(axis=0), fit.noise.measurement),
                    enough=EXPECTED * investigation.context.study.search.least_log_odds,
                )  # fmt: skip
            names = {"name": name, "others": list(dict.fromkeys(other.candidate.name for other in alike))}
            return [] if plan is None else [replace(plan, values=names | dict(plan.values))]
    return []


def _variation_of(name: str, fit: Fit, labels: Sequence[str]) -> Remark:
    """Values of a parameter by recording, and the probability that they are as different by chance."""
    free = [fit.model.parameters[place] for place in fit.model.free]
    each = np.array([[p.name in (name, f"_{name}_{k + 1}") for p in free] for k in range(len(labels))], float)
    values, covariance = each @ [p.value for p in free], each @ fit.covariance @ each.T
    apart = np.eye(len(labels)) - 1 / len(labels)
    known = {
        "unit": next(p.unit for p in free if p.name == name),
        "runs": list(zip(values.tolist(), np.sqrt(np.diag(covariance)).tolist(), strict=True)),
        "p": wald_probability(apart @ values, apart @ covariance @ apart),
    }
    return Remark("diagnosis.varies", {"name": name, "labels": list(labels)} | known)


def _explanations(investigation: Investigation, names: tuple[str, ...]) -> dict[str, float]:
    """Whole explanations with their evidence: parameters, with forces, with mechanisms, with functions."""
    search, data = investigation.search, investigation.context.data
    fits = [("other parameters", investigation.least_squares), ("other parameters", search.recalibrated)]
    if search.found:
        fits.append((" and ".join(each.best.candidate.label for each in search.found), search.fit))
    fits += [
        (" and ".join((*names, *(part.candidate.label for part in model.parts))), model.fit)
        for model in investigation.models
    ]
    known = [each for each in fits if np.isfinite(each[1].log_likelihood)]
    evidence = {
        f"{what}{' and process noise' if fit.has_process_noise else ''}": value
        for (what, fit), value in zip(known, log_evidences([fit for _, fit in known], data), strict=True)
    }
    best = max(evidence.values(), default=0.0)
    return {what: value - best for what, value in sorted(evidence.items(), key=lambda each: -each[1])}


def _excluded(investigation: Investigation) -> dict[str, UpperBound]:
    """Upper bounds (95 %) of the amplitudes of mechanisms that were not found."""
    bounds: dict[str, UpperBound] = {}
    for each in investigation.search.screened:
        candidate = each.term.candidate
        units = {one.name: one.unit for one in candidate.model.parameters}
        for name, estimate, error in zip(
            candidate.amplitudes, each.amplitudes, each.standard_errors, strict=False
        ):
            bound = abs(float(estimate)) + BOUND_ERRORS * float(error)
            known = bounds.get(candidate.label)
            if np.isfinite(bound) and error > 0 and (known is None or bound > known.upper_bound_95):
                bounds[candidate.label] = UpperBound(bound, units[name], name, candidate.label)
    return dict(sorted(bounds.items()))


def _found_mechanisms(investigation: Investigation, card: Fit) -> tuple[StatedTerm, ...]:
    """Every mechanism that was found, whether it is named or only describes; the estimates are the card's."""
    search = investigation.search
    if investigation.process_noise:
        fit = search.fit
        entries = zip(fit.model.states, fit.model.units, fit.noise.process, strict=True)
        driven = [entry for entry in entries if entry[2] > 0]
        return (
            StatedTerm(
                name=PROCESS_NOISE, label=PROCESS_NOISE, terms={},
                parameters={
                    f"intensity_{name}": Estimate(
                        float(value), None, unit_of("_x**2/_t", {"_x": unit, "_t": fit.model.time_unit})
                    )
                    for name, unit, value in driven
                },
                evidence=Evidence(None, None, None, None), share_of_excess=1.0, indistinguishable_from=(),
                equations=tuple(name for name, _, _ in driven),
            ),
        )  # fmt: skip
    labels = [each.best.candidate.label for each in search.found]
    stated = []
    for place, (found, odds) in enumerate(zip(search.found, investigation.log_odds, strict=True)):
        trial, candidate = found.best, found.best.candidate
        rivals = [
            Alternative(
                other.candidate.name, other.candidate.label, other.delta_chi2,
                len(other.candidate.new) - len(candidate.new), standing,
            )
            for standing, others in found.others.items()
            for other in others
        ]  # fmt: skip
        alike = {each.name for each in rivals if each.standing == "same"} - {candidate.name}
        stated.append(
            _stated(
                trial, card, log_odds=odds, share_of_excess=investigation.remainder.share,
                indistinguishable_from=tuple(sorted(alike)) if investigation.verdict.names else None,
                beside=tuple(labels[:place]), rivals=tuple(sorted(rivals, key=lambda each: -each.delta_chi2)),
            )
        )  # fmt: skip
    return tuple(stated)


def _stated(trial: FittedCandidate, fit: Fit, *, log_odds: float | None = None, **further: Any) -> StatedTerm:
    """What was fitted, with the estimates of a fit that has it."""
    candidate, errors = trial.candidate, fit.error_of
    known = {entry.name: entry for entry in fit.model.parameters}
    seen = () if candidate.equations else fit.model.output_names
    measured = tuple(name for name, _ in candidate.changes if name in seen)
    return StatedTerm(
        name=candidate.name, label=candidate.label, family=candidate.family, variant=candidate.variant,
        terms={name: str(formula) for name, formula in candidate.changes},
        parameters={
            name: Estimate(known[name].value, errors.get(name), known[name].unit)
            for name in candidate.new
            if name in known
        },
        evidence=Evidence(trial.delta_chi2, trial.delta_bic, trial.p_white, trial.p_cluster, log_odds),
        **{"equations": candidate.equations, "outputs": measured, **further},
    )  # fmt: skip


def _stated_function(
    part: FittedCandidate, fit: Fit, beside: tuple[str, ...], context: FitContext
) -> StatedTerm:
    """A part of the model of what has no name, with its curve or surface and their standard errors."""
    candidate = part.candidate
    place, smooth = candidate.place, candidate.smooth
    known = {entry.name: entry.value for entry in fit.model.parameters}
    errors = fit.error_of
    amplitudes = np.array([known[name] for name in candidate.amplitudes])
    curve = surface = None
    shape: dict[str, Any] = {}
    at: list[np.ndarray] = []
    if smooth is not None:
        at = [np.linspace(lower, upper, GRID_POINTS) for lower, upper in smooth.limits.T]
        courses = np.stack([each.ravel() for each in np.meshgrid(*at, indexing="ij")])
        values, weights = smooth.along(amplitudes, courses)
    elif place is not None and len(place.words) == 1:  # a formula: what a unit of each coefficient is
        at = [place.knots]
        name, formula = candidate.changes[0]
        factor = dict((*place.equations, *place.outputs))[name]
        slopes = (formula.diff(symbol(amplitude)) / factor for amplitude in candidate.amplitudes)
        terms = [_in_coordinate(each, place.coordinates[0]) for each in slopes]
        columns = compile_values(terms, [COORDINATE])(at[0])
        weights = np.stack([np.broadcast_to(each, at[0].shape) for each in columns], axis=1).astype(float)
        values = weights @ amplitudes
    if place is not None and at:
        rows = [list(errors).index(name) for name in candidate.amplitudes]
        variances = np.einsum("kc,cd,kd->k", weights, fit.covariance[np.ix_(rows, rows)], weights)
        sides, deviations = [len(each) for each in at], np.sqrt(np.maximum(variances, 0.0))
        shaped = [each.reshape(sides).tolist() for each in (values, deviations)]
        if candidate.kind == SURFACE:
            grid = (tuple(at[0].tolist()), tuple(at[1].tolist()))
            surface = DescribedSurface(
                (place.words[0], place.words[1]), grid, *(tuple(map(tuple, each)) for each in shaped)
            )
        else:
            curve = DescribedCurve(place.words[0], tuple(at[0].tolist()), *map(tuple, shaped))
            shape = _shape_of(part, curve, place, fit, context)
    elif candidate.begins:  # a hidden state
        name = candidate.shapes[0]
        time = Estimate(known[name], errors.get(name), fit.model.time_unit)
        shape = {"shape": "late" if len(candidate.shapes) == 1 else "ringing", "sizes": {name: time}}
    measured = [name for name, _ in candidate.changes if name in fit.model.output_names]
    return _stated(
        part, fit, kind=candidate.kind, outputs=() if candidate.equations else tuple(measured),
        coordinates=tuple(candidate.coordinate.split(", ")) if place is None else place.words, curve=curve,
        surface=surface, beside=beside, **shape,
    )  # fmt: skip


def _shape_of(
    part: FittedCandidate, curve: DescribedCurve, place: Place, fit: Fit, context: FitContext
) -> dict[str, Any]:
    """The simplest formula that a curve may be, and the mechanism that is such a function.

    Where there is no such formula, whether it rises or falls all the way, as far as its errors tell.
    """
    asked, fits = None, []
    with suppress(*NUMERICAL_ERRORS):
        asked = Smoothness.of(fit, context.data, place, known=part)
        fits = [] if asked is None else asked.fitting_forms()
    if asked is None or not fits:
        value, error = np.array(curve.value), np.array(curve.standard_error)
        apart = np.subtract.outer(value, value)
        seen = np.tril(np.sign(apart) * (np.abs(apart) > VISIBLE_ERRORS * np.hypot.outer(error, error)))
        sides = {(1.0, 0.0): "rising", (0.0, -1.0): "falling"}
        return {"shape": sides.get((float(seen.max()), float(seen.min())), "")}
    form, found = fits[0]
    extra, power = len(place.words) - 1, form.power
    names = dict(zip(found, fresh_names("s", len(found), fit.model.names), strict=True))
    units = {each: place.unit(fit.model, power if each == A else 0, extra) for each in found}
    units[C] = units_of(fit.model).get(place.words[0], "1")
    written = {Z: symbol(place.words[0])} | {each: symbol(name) for each, name in names.items()}
    known = asked.fitting_forms(_known_forms(place, fit, context))
    return {
        "shape": form.name,
        "formula": str(form.formula.xreplace(written)),
        "sizes": {
            name: Estimate(float(found[each][0]), float(found[each][1]), units[each])
            for each, name in names.items()
        },
        "like": known[0][0].name if known else "",
    }


def _known_forms(place: Place, fit: Fit, context: FitContext) -> list[Any]:
    """Mechanisms that are functions of a place's coordinate in its equation, as forms."""
    found, model = [], context.model
    (name, factor), *further = (*place.equations, *place.outputs)
    values = {symbol(each.name): sympy.Float(each.value, 17) for each in fit.model.parameters}
    for each in context.candidates if name in model.states and not further else ():
        own = [*map(symbol, (*each.amplitudes, *each.shapes))]
        if each.equations != (name,) or each.begins or not each.amplitudes or len(own) > 2:
            continue
        row = model.states.index(name)
        change = sympy.simplify((each.model.equations[row] - model.equations[row]) / factor)
        letters = dict(zip(own, (A, B) if len(each.amplitudes) == 2 else (A, C), strict=False))
        term = _in_coordinate(change, place.coordinates[0]).xreplace(values | letters | {COORDINATE: Z})
        linear = not any(term.diff(one).has(A, B) for one in (A, B))
        if linear and {*letters.values()} <= term.free_symbols <= {Z, *letters.values()}:
            tried = [c for one in each.searches for c in places_of(one, context.data, model, fit.x)]
            shares = tuple(c / float(np.ptp(place.knots)) for c in tried)
            signs = tuple(letters[symbol(one)] for one in each.positive & set(each.amplitudes))
            found.append(FORMS[0]._replace(name=each.name, formula=term, tried=shares, positive=signs))
    return found


def _in_coordinate(term: sympy.Expr, coordinate: sympy.Expr) -> sympy.Expr:
    """A formula in `COORDINATE`, in the place of the formula that the coordinate is.

    The square of ``sqrt(P**2 + Q**2)`` has no root in it, so that what stands under the root is replaced.
    """
    if isinstance(coordinate, sympy.Pow) and coordinate.exp == sympy.Rational(1, 2):
        return term.subs(coordinate.base, COORDINATE**2)
    return term.subs(coordinate, COORDINATE)


def _locate(investigation: Investigation, described: AugmentedModel | None = None) -> Location:
    """In which equation a mismatch sits, along which coordinate and where, and in which recordings.

    What has no name is where the model of it stands. Where nothing describes it, it is sought in all
    equations by what they leave unexplained.
    """
    curves, search = investigation.remainder.before.curves, investigation.search
    data = investigation.context.data
    candidate, outputs = None, tuple[str, ...]()
    if investigation.verdict.names and search.found:
        candidate = search.found[0].best.candidate
    elif not investigation.verdict.names and (model := described or next(iter(investigation.models), None)):
        candidate = model.parts[0].candidate
    if candidate is not None:
        equations, coordinate = candidate.equations, candidate.coordinate
        if not equations:  # it changes nothing but what sensors read
            measured = set(candidate.model.output_names)
            outputs = tuple(name for name, _ in candidate.changes if name in measured)
    elif curves:
        equations, coordinate = _most_telling(investigation.remainder.before, investigation.context.roles)
    else:
        equations, coordinate = (), "unknown"
    there = (each for each in curves if set(each.term.targets) & set(equations))
    curve = next((each for each in there if each.term.words[0] == coordinate), None)
    if investigation.process_noise:
        driven = zip(investigation.context.model.states, search.fit.noise.process, strict=False)
        equations, coordinate, curve = tuple(name for name, q in driven if q > 0), "random", None
    region = {}
    if curve is not None:  # where the missing part is seen beyond its error
        size, knots = np.abs(curve.amplitudes), curve.term.knots
        seen = (size > VISIBLE_ERRORS * curve.standard_errors) & (size > VISIBLE_SHARE * size.max())
        knots = knots[seen] if seen.any() else knots
        region = {curve.term.words[0]: (float(knots.min()), float(knots.max()))}
    # What any one equation could explain, as a share of the excess over noise.
    gains: dict[str, float] = {}
    for each in curves:
        for name in each.term.targets:
            gains[name] = max(gains.get(name, 0.0), each.gain)
    total = max(investigation.remainder.before.total - investigation.remainder.before.freedom, 1e-300)
    # Recordings whose residuals, process noise not admitted, exceed noise by a fair share of the excess.
    recalibrated = search.recalibrated
    still = Noise(search.fit.noise.measurement, np.zeros(recalibrated.model.dimension))
    white, _, left = residuals(recalibrated, data, still)
    counts = np.bincount(white.recording, white.known, minlength=len(data.labels))
    excess = np.maximum(np.bincount(white.recording, left**2, minlength=len(data.labels)) - counts, 0.0)
    affected = data.labels
    if excess.sum() > 0:
        shares = excess / excess.sum(), AFFECTED_SHARE * (counts / counts.sum())
        affected = tuple(label for label, own, fair in zip(data.labels, *shares, strict=True) if own > fair)
    return Location(
        equations={name: float(min(max(gains.get(name, 0.0) / total, 0.0), 1.0)) for name in equations},
        coordinate=coordinate, region=region, outputs=outputs,
        time=(float(data.t.min()), float(data.t.max())) if coordinate == "t" else None,
        recordings=affected, recordings_total=len(data.labels),
        unit=units_of(investigation.context.model).get(coordinate, "1"),
    )  # fmt: skip


def _most_telling(structure: Structure, roles: Roles) -> tuple[tuple[str, ...], str]:
    """The equation in which something is missing, and the coordinate along which it shows best.

    Where its own motion tells nearly as much as that of others, it is its own; and where any motion tells
    most of what the time or an input tells, it is the motion, since these move a system, too. Where no
    coordinate tells nearly all, a force depends on the course of the motion, position and velocity both.
    """
    best = structure.curves[0]
    equations, coordinate = best.term.targets, best.term.words[0]
    own = next((pair for pair in roles.motions if pair[1] in equations), equations)
    if coordinate in (*own, "amplitude"):
        return equations, coordinate
    motion = {*roles.states, *(name for pair in roles.motions for name in pair), "amplitude"}
    others, share = (own, NEARLY_ALL) if coordinate in motion else (motion, MOTION_SHARE)
    for curve in structure.curves:
        there = set(equations) <= set(curve.term.targets)
        if there and curve.term.words[0] in others and curve.gain >= share * best.gain:
            return curve.term.targets, curve.term.words[0]
    if len(own) > len(equations) and best.gain < NEARLY_ALL * (structure.total - structure.freedom):
        return equations, ", ".join(own)
    return equations, coordinate
