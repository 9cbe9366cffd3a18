"""Sparse regression of derivatives (PySINDy), plain and in its weak form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.discrepancies.added import Polynomial, products
from benchmarks.discrepancies.answers import Answer, Term
from benchmarks.discrepancies.refit import refitted, runs_better
from benchmarks.discrepancies.regression import Equation, Found, chosen_terms, joint, powers
from benchmarks.discrepancies.states import SeenStates, seen_states
from siq.diagnosis.study import Comparison
from siq.inference.maximum_likelihood import Fit
from siq.inference.measurements import Measurements
from siq.inference.recalibration import recalibrate
from siq.systems.dynamics import Dynamics

WINDOW = 8.0  # samples, at least, of half a window of the weak form; by default a twentieth of a recording
WINDOWS = 0.5  # for each sample
SEED = 0  # of where windows lie
WORSE = "what was found runs worse than the card along the recordings that it was learned from"
UNSEEN = "a state cannot be had from what was measured"
Report = Callable[[Answer], None]


def plain(case: Comparison, seconds: float, report: Report) -> Answer:
    """Derivatives of smoothing splines, regressed on a library of degree three."""
    return _regressed(case, report, weak=False)


def weak(case: Comparison, seconds: float, report: Report) -> Answer:
    """Integrals against test functions in the place of derivatives."""
    return _regressed(case, report, weak=True)


def _regressed(case: Comparison, report: Report, *, weak: bool) -> Answer:
    recalibrated, _ = recalibrate(case.system, case.learn)
    model = recalibrated.model
    seen = seen_states(model, case.learn)
    if seen is None:
        return Answer(
            applied=False, values=values_of(model), fault="a state cannot be had from what was measured"
        )
    exponents = powers(len(seen.coordinates))
    equations = (weak_equations if weak else plain_equations)(model, case.learn, seen, exponents)
    report(Answer(values=values_of(model)))
    answer = said(model, equations, [chosen_terms(each) for each in equations], exponents)
    report(answer)
    return _kept(answer, recalibrated, case.learn, seen)


def _kept(answer: Answer, card: Fit, data: Measurements, seen: SeenStates) -> Answer:
    """The answer with refitted coefficients; without them where the card runs better than any of them."""
    if not isinstance(answer.added, Polynomial):
        return answer
    values = np.array([answer.values[each.name] for each in card.model.parameters])
    model, added = refitted(card, card.model.with_values(values), answer.added, data)
    if not runs_better(card.model, model, added, data, seen.first_states(data, card)):
        return answer.model_copy(update={"values": values_of(card.model), "added": None, "fault": WORSE})
    coefficients = {
        (model.states[state], tuple(added.exponents[term])): added.coefficients[state][term]
        for state, term in np.argwhere(np.array(added.coefficients) != 0)
    }
    terms = tuple(
        each.model_copy(update={"coefficient": coefficients[each.equation, each.exponents]})
        for each in answer.terms
    )
    return answer.model_copy(update={"values": values_of(model), "added": added, "terms": terms})


def values_of(model: Dynamics) -> dict[str, float]:
    """The parameters' values by name."""
    return {each.name: float(each.value) for each in model.parameters}


def dynamic(model: Dynamics) -> list[int]:
    """Places of the equations that something can be missing in: all but ``x' = v``."""
    return [place for place, kinematic in enumerate(model.kinematic) if not kinematic]


def plain_equations(
    model: Dynamics, data: Measurements, seen: SeenStates, exponents: np.ndarray
) -> list[Equation]:
    """What the card leaves of the derivatives of smoothed states, at the samples."""
    rates = model.functions.rates(seen.x, seen.signals, model.values)
    _, slopes = model.functions.slopes(seen.x, seen.signals, model.values)
    library, rows = products(exponents, seen.coordinates), seen.inside
    return [
        Equation(
            place, (seen.rates - rates)[place, rows], slopes[place][:, rows].T, library[:, rows].T,
            seen.block[rows], seen.fold[rows],
        )
        for place in dynamic(model)
    ]  # fmt: skip


def weak_equations(
    model: Dynamics, data: Measurements, seen: SeenStates, exponents: np.ndarray
) -> list[Equation]:
    """What the card leaves of integrals of derivatives against test functions, by PySINDy's own weights."""
    from pysindy.feature_library import PolynomialLibrary, WeakPDELibrary

    np.random.seed(SEED)  # noqa: NPY002 (PySINDy draws its windows from numpy's global generator)
    rates = model.functions.rates(seen.x, seen.signals, model.values)
    _, slopes = model.functions.slopes(seen.x, seen.signals, model.values)
    library = products(exponents, seen.coordinates)
    d, p = rates.shape[0], slopes.shape[1]
    # Library, rates and slopes are known functions of the states already: the weak form only integrates them.
    columns = np.concatenate([rates, slopes.reshape(d * p, -1), library]).T
    integrals, derivatives, middles = [], [], []
    for begin, end in zip(data.first[:-1], data.first[1:], strict=True):
        rows = slice(begin, end)
        t = data.t[rows]
        half = max((t[-1] - t[0]) / 20, WINDOW * float(np.median(np.diff(t))))
        windows = WeakPDELibrary(
            function_library=PolynomialLibrary(degree=1, include_bias=False), spatiotemporal_grid=t,
            K=max(int(WINDOWS * len(t)), 10), H_xt=min(half, 0.45 * (t[-1] - t[0])),
        )  # fmt: skip
        weights, inside = windows.fullweights0, windows.inds_k
        integrals.append(np.stack([w @ columns[rows][k[0]] for w, k in zip(weights, inside, strict=True)]))
        derivatives.append(windows.convert_u_dot_integral(seen.x[:, rows].T))
        middles.append(begin + np.array([int(np.mean(k[0])) for k in inside]))
    summed, driven, middle = map(np.concatenate, (integrals, derivatives, middles))
    return [
        Equation(
            place, driven[:, place] - summed[:, place], summed[:, d + place * p : d + (place + 1) * p],
            summed[:, d + d * p :], seen.block[middle], seen.fold[middle],
        )
        for place in dynamic(model)
    ]  # fmt: skip


def said(model: Dynamics, equations: list[Equation], found: list[Found], exponents: np.ndarray) -> Answer:
    """The answer of a regression: terms of the equations that are better foreseen with them.

    Where nothing is detected the card stays as it was recalibrated.
    """
    strongest = max(range(len(found)), key=lambda k: found[k].evidence)
    evidence = found[strongest].evidence
    detected = [one.detected for one in found]
    if not any(detected):
        return Answer(evidence=evidence, values=values_of(model))
    strongest = int(max(np.flatnonzero(detected), key=lambda k: found[k].evidence))
    coefficients, change = joint(equations, found)
    values = model.values
    values[list(model.free)] += change
    kept = np.flatnonzero(np.any(coefficients != 0, axis=0))
    whole = np.zeros((model.dimension, len(kept)))
    for row, equation in zip(coefficients, equations, strict=True):
        whole[equation.state] = row[kept]
    terms = tuple(
        Term(
            equation=model.states[state],
            exponents=tuple(map(int, exponents[kept[k]])),
            coefficient=whole[state, k],
        )
        for state, k in np.argwhere(whole != 0)
    )
    return Answer(
        detected=True,
        evidence=evidence,
        equations=tuple(
            model.states[each.state] for each, one in zip(equations, found, strict=True) if one.detected
        ),
        coordinates=along(model, strongest_term(found[strongest], exponents)),
        terms=terms,
        values=values_of(model.with_values(values)),
        added=Polynomial(exponents=exponents[kept].tolist(), coefficients=whole.tolist()),
    )


def strongest_term(found: Found, exponents: np.ndarray) -> np.ndarray:
    """Exponents of the term that does most; a constant only where nothing else was chosen."""
    size = np.where(found.support, found.contributions, -1.0)
    size = np.where(exponents.any(axis=1), size, size / 1e12)
    return exponents[int(np.where(found.support, size, -1.0).argmax())]


def along(model: Dynamics, exponents: np.ndarray) -> tuple[str, ...]:
    """The states and inputs that a product depends on."""
    names = (*model.states, *(each.name for each in model.inputs))
    return tuple(name for name, power in zip(names, exponents, strict=True) if power)
