"""What is concealed, as a polynomial, and what does an oracle do with it?"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import sympy

from benchmarks.discrepancies.added import Added
from benchmarks.discrepancies.regression import DEGREE
from benchmarks.discrepancies.simulation import Simulation
from benchmarks.proof.foreign_scores.oracle import free_errors, true_simulation
from benchmarks.proof.keys import CaseKey, Truth
from benchmarks.proof.oracle import oracle_of, true_model
from siq.diagnosis.study import Comparison
from siq.systems.dynamics import Dynamics, symbol

Terms = frozenset[tuple[str, tuple[int, ...]]]
FAINT = 1e-9  # of a coefficient in the largest, below which it is rounding


@dataclass(frozen=True)
class TrueCase:
    """What scores are held against.

    Attributes
    ----------
    key, truth
        What is concealed, and where the system was.
    noise
        Deviation of each output's noise, shape ``(m,)``.
    model
        The oracle's simulation: the true one, fitted; where process noise are concealed, the card's with true
        parameters.
    delta_chi2
        What the concealed effect gains it; NaN where nothing is concealed, or process noise are.
    terms
        The effect as products of powers up to the degree of the library; None where it is no such sum.
    """

    key: CaseKey
    truth: Truth
    noise: np.ndarray
    model: Dynamics
    delta_chi2: float
    terms: Terms | None

    def error(self, case: Comparison, model: Dynamics, added: Added | None = None) -> float:
        """Normalised error of a free run of held-out recordings; infinite where it runs away."""
        try:
            with np.errstate(all="ignore"):
                squares = free_errors(
                    model, case.kept, self.noise, self.truth, simulator=partial(Simulation, added=added)
                )
        except (ArithmeticError, ValueError, np.linalg.LinAlgError):
            return np.inf
        error = float(np.sqrt(squares.mean()))
        return error if np.isfinite(error) else np.inf


def true_case(case: Comparison, key: CaseKey, truth: Truth, starts: np.ndarray | None) -> TrueCase:
    """The oracle of the case's own proof, and the concealed effect as terms.

    Parameters
    ----------
    case
        As every method had it.
    key, truth
        What it conceals.
    starts
        True first states of the recordings learned from, which the second generator's oracle begins with;
        None for the first generator's.
    """
    model, delta_chi2 = true_model(case.system, key)[0], np.nan
    if starts is not None:
        found = true_simulation(case, key, truth, starts)
        model, delta_chi2 = found.true.model, found.delta_chi2
    elif key.kind != "process noise":
        oracle = oracle_of(case, key)
        model, delta_chi2 = oracle.model or model, oracle.delta_chi2
    noise = np.array([key.sensors.noise.get(name, np.nan) for name in case.system.output_names])
    steps = np.array([key.sensors.steps.get(name, 0.0) for name in case.system.output_names])
    said = np.nanstd(case.learn.outputs, axis=0) * 10 ** (-(key.noise_db or 40.0) / 20)
    noise = np.sqrt(np.where(np.isfinite(noise), noise, said) ** 2 + steps**2 / 12)
    return TrueCase(key, truth, noise, model, delta_chi2, effect_terms(case.system, key))


def effect_terms(system: Dynamics, key: CaseKey) -> Terms | None:
    """The concealed effect as products of powers of states and inputs, by equation."""
    if not key.effect.changes_equations or key.effect.outputs or key.effect.states:
        return None
    true, _ = true_model(system, key)
    names = (*system.states, *(each.name for each in system.inputs))
    values = {symbol(each.name): sympy.Float(each.value) for each in true.parameters}
    found: set[tuple[str, tuple[int, ...]]] = set()
    for state, mine, theirs in zip(system.states, system.equations, true.equations, strict=True):
        difference = sympy.expand((theirs - mine).xreplace(values))
        if difference == 0:
            continue
        try:
            terms = sympy.Poly(difference, *map(symbol, names)).terms()
        except sympy.PolynomialError:
            return None
        if any(coefficient.free_symbols for _, coefficient in terms):
            return None
        largest = max(abs(float(coefficient)) for _, coefficient in terms)
        kept = [powers for powers, coefficient in terms if abs(float(coefficient)) > FAINT * largest]
        if any(sum(powers) > DEGREE for powers in kept):
            return None
        found |= {(state, tuple(map(int, powers))) for powers in kept}
    return frozenset(found) or None
