"""What is the verdict, with mechanisms and their evidence, place, fit and bounds?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from siq.diagnosis.dictionary import unit_of
from siq.diagnosis.evidence import correlation_time_left, log_evidence_of
from siq.diagnosis.held_out_fit import HeldOutRuns
from siq.diagnosis.investigation import Investigation
from siq.diagnosis.location import locate
from siq.diagnosis.mechanisms import PROCESS_NOISE
from siq.diagnosis.options import MismatchVerdict
from siq.diagnosis.search import Found
from siq.diagnosis.significance import BUDGET_SPENT, TriedMechanism
from siq.diagnosis.statement import (
    Description,
    Explanation,
    NotFitted,
    Recalibrated,
    Statement,
    UpperBound,
    sentence_of,
    stated_functions,
    words_of,
)
from siq.diagnosis.wording import Estimate, Evidence, Rival, Standing, StatedMechanism
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements

NOT_INDEPENDENT = (
    "There is one recording only. What is held out is its later part, which is no independent recording."
)
BOUND = 1.96  # standard errors on either side of an estimate within which 95 % lie


def statement_of_failure(reason: str) -> Statement:
    """What is stated of a simulation that cannot be fitted to the recordings at all.

    Parameters
    ----------
    reason
        What happened, in lower case and without a full stop.
    """
    return Statement(
        MismatchVerdict.UNEXPLAINED,
        "The simulation cannot be compared with the recordings: no fit of it to them has a result.",
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
    stated = Statement(
        verdict=investigation.verdict,
        sentence="",
        mechanisms=mechanisms_of(investigation, shown.described_fit if shown.adopted else None),
        description=description_of(investigation),
        described=stated_functions(shown, beside=names_in(investigation)),
        location=locate(investigation, data, shown.described if shown.adopted else None),
        recalibration=recalibration_of(investigation, shown),
        errors=shown.errors,
        excluded={} if investigation.verdict.mismatch else excluded(investigation),
        explanations=explanations_of(investigation, data),
        remarks=(
            *investigation.remarks,
            *left_undone(investigation),
            *(() if shown.independent else (NOT_INDEPENDENT,)),
        ),
        not_fitted=tuple(
            NotFitted(each.candidate.name, each.candidate.label, each.reason)
            for each in investigation.search.untried
        ),
        account=investigation.account,
    )
    units = {entry.name: entry.unit for entry in investigation.model.parameters}
    return replace(stated, sentence=sentence_of(stated, units), words=words_of(stated))


def left_undone(investigation: Investigation) -> tuple[str, ...]:
    """The sentence that says that an answer is partial, where it is."""
    if not investigation.account.partial:
        return ()
    left = sum(each.reason == BUDGET_SPENT for each in investigation.search.untried)
    what = f"{left} candidates were not tried" if left > 1 else "one candidate was not tried"
    if not left:
        what = "further mechanisms were not looked for"
    which = "work" if investigation.account.stopped_by == "work" else "time"
    return (
        f"This answer is partial: the {which} allowed for the case was spent, and {what}."
        " A larger budget in the study tries the rest.",
    )


def mechanisms_of(investigation: Investigation, card: Fit | None = None) -> tuple[StatedMechanism, ...]:
    """What is named, each with its evidence.

    Parameters
    ----------
    investigation
        What was found.
    card
        The fit whose estimates the new card has, where something without a name describes what names leave.
    """
    if investigation.verdict is not MismatchVerdict.MISSING_PHYSICS:
        return ()
    if investigation.process_noise:
        return (_process_noise(investigation),)
    return tuple(
        replace(
            stated,
            indistinguishable_from=tuple(
                sorted({each.name for each in stated.rivals if each.standing == "same"} - {stated.name})
            ),
        )
        for stated in _all_stated(investigation, card)
    )


def explanations_of(investigation: Investigation, data: Measurements) -> tuple[Explanation, ...]:
    """Whole explanations with their evidence: parameters, with forces, with mechanisms, with functions."""
    search = investigation.search
    fits = [("other parameters", investigation.least_squares), ("other parameters", search.recalibrated)]
    if search.found:
        fits.append((" and ".join(each.best.candidate.label for each in search.found), search.fit))
    names = names_in(investigation)
    fits += [
        (" and ".join((*names, *(part.trial.candidate.label for part in model.parts))), model.fit)
        for model in investigation.models
    ]
    found: dict[str, float] = {}
    correlated = correlation_time_left([fit for _, fit in fits], data)
    for what, fit in fits:
        if np.isfinite(fit.log_likelihood):
            forces = " and random forces" if fit.has_process_noise else ""
            found[f"{what}{forces}"] = log_evidence_of(fit, data, correlated=correlated)
    best = max(found.values(), default=0.0)
    ranked = sorted(found.items(), key=lambda each: -each[1])
    return tuple(Explanation(what, value - best) for what, value in ranked)


def names_in(investigation: Investigation) -> tuple[str, ...]:
    """Labels of the mechanisms that have a name, on top of which models of the rest are."""
    if investigation.verdict is not MismatchVerdict.MISSING_PHYSICS:
        return ()
    return tuple(each.best.candidate.label for each in investigation.search.found)


def description_of(investigation: Investigation) -> Description | None:
    """What is known of a mismatch that has no name."""
    if investigation.verdict is not MismatchVerdict.UNEXPLAINED:
        return None
    search = investigation.search
    trials = _all_stated(investigation)
    return Description(
        share_described=investigation.share if trials else 0.0,
        by=trials,
        p_residuals_random=investigation.after.p_value,
        random_forces_admitted=search.fit.has_process_noise,
        too_faint=investigation.too_faint,
        p_alike=None if investigation.naming is None else investigation.naming.p_alike,
        misleading=investigation.withdrawn,
    )


def recalibration_of(investigation: Investigation, shown: HeldOutRuns) -> dict[str, Recalibrated]:
    """The simulation's own parameters: on the card, and in the simulation that the verdict ends with."""
    fit = investigation.final
    if shown.described_fit is not None and shown.adopted:
        fit = shown.described_fit
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


def _all_stated(investigation: Investigation, card: Fit | None = None) -> tuple[StatedMechanism, ...]:
    """Every mechanism that was found, whether it is named or only describes."""
    search = investigation.search
    labels = [each.best.candidate.label for each in search.found]
    log_odds = investigation.naming.log_odds if investigation.naming is not None else ()
    return tuple(
        _stated(each, card or search.fit, investigation.share, tuple(labels[:place]), odds)
        for place, (each, odds) in enumerate(zip(search.found, log_odds, strict=True))
    )


def _stated(
    found: Found, final: Fit, share: float, beside: tuple[str, ...], log_odds: float
) -> StatedMechanism:
    trial, candidate = found.best, found.best.candidate
    standings: tuple[tuple[Standing, tuple[TriedMechanism, ...]], ...] = (
        ("same", found.indistinguishable),
        ("needless", found.needless),
        ("less", found.lesser),
    )
    rivals = [
        Rival(
            other.candidate.name,
            other.candidate.label,
            other.delta_chi2,
            len(other.candidate.new) - len(candidate.new),
            standing,
        )
        for standing, others in standings
        for other in others
    ]
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
        evidence=Evidence(trial.delta_chi2, trial.delta_bic, trial.p_white, trial.p_cluster, log_odds),
        share_of_excess=share,
        equations=candidate.equations,
        beside=beside,
        rivals=tuple(sorted(rivals, key=lambda each: -each.delta_chi2)),
    )


def _process_noise(investigation: Investigation) -> StatedMechanism:
    fit = investigation.search.fit
    return StatedMechanism(
        name=PROCESS_NOISE,
        label=PROCESS_NOISE,
        terms={},
        parameters={
            f"intensity_{name}": Estimate(
                float(value), None, unit_of("_x**2/_t", {"_x": unit, "_t": fit.model.time_unit})
            )
            for name, unit, value in zip(fit.model.states, fit.model.units, fit.noise.process, strict=True)
            if value > 0
        },
        evidence=Evidence(None, None, None, None),
        share_of_excess=1.0,
        indistinguishable_from=(),
        equations=tuple(
            name for name, value in zip(fit.model.states, fit.noise.process, strict=False) if value > 0
        ),
    )
