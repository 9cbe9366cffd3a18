"""What is stated of functions without a name, and of parameters that differ."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import sympy
from scipy.integrate import solve_ivp

import siq
from siq.diagnosis.dictionary import roles_of
from siq.diagnosis.holdout import HeldOutErrors
from siq.diagnosis.investigation import HeldOutRuns
from siq.diagnosis.naming import Investigation
from siq.diagnosis.residual_structure import Remainder
from siq.diagnosis.search import FitContext, Search
from siq.diagnosis.study import MismatchStudy, MismatchVerdict, _measurements_of
from siq.diagnosis.verdict import COORDINATE, _in_coordinate, statement_of
from siq.inference.budget import Budget
from siq.inference.recalibration import recalibrate
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter, symbol

P, Q = sympy.symbols("P Q", real=True)
AMPLITUDE = sympy.sqrt(P**2 + Q**2)


@pytest.mark.parametrize("power", range(6))
def test_a_formula_of_an_amplitude_is_written_in_it(power: int) -> None:
    """The square of an amplitude is ``P**2 + Q**2``, in which the amplitude itself does not occur."""
    assert _in_coordinate(AMPLITUDE**power, AMPLITUDE) == COORDINATE**power


def test_a_formula_of_a_state_is_written_in_it() -> None:
    assert _in_coordinate(3 * P**2 + sympy.sin(P), P) == 3 * COORDINATE**2 + sympy.sin(COORDINATE)


@pytest.mark.parametrize(
    ("before", "recalibrated", "floor", "verdict"),
    [
        (0.5, 0.1, 0.1, MismatchVerdict.PARAMETER_SHIFT),
        (0.5, 0.5, 0.1, MismatchVerdict.UNEXPLAINED),
        (0.1, 0.1, 0.1, MismatchVerdict.NO_MISMATCH),
        (0.5, 0.9, 0.1, MismatchVerdict.UNEXPLAINED),
        (0.12, 0.1, 0.1, MismatchVerdict.PARAMETER_SHIFT),  # to the noise, where chance is not ruled out
    ],
)
def test_parameters_have_shifted_only_where_that_mends_the_simulation(
    before: float, recalibrated: float, floor: float, verdict: MismatchVerdict
) -> None:
    draw, t = np.random.default_rng(3), np.arange(0, 4, 0.1)
    x, k = symbol("x"), symbol("k")
    model = Dynamics(("x",), (-k * x,), Diffusion.identity(1), parameters=(Parameter("k", 1.0),))
    table = pd.DataFrame({"recording": "r", "t": t, "x": np.exp(-t) + 0.01 * draw.normal(size=len(t))})
    data, roles = _measurements_of(table, model), roles_of(model)
    _, fit = recalibrate(model, data)
    context = FitContext(model, data, roles, (), MismatchStudy(), Budget())
    found = Investigation(
        context, Search(fit, (), fit, ()), Remainder.of(data, fit, fit, roles),
        MismatchVerdict.PARAMETER_SHIFT, fit,
    )  # fmt: skip
    alike = draw.chisquare(1, 600)
    off = {"before": before, "recalibrated": recalibrated, "augmented": recalibrated}
    squares = {name: error**2 * alike / alike.mean() for name, error in off.items()}
    if before == 0.12:  # all of the difference in one stretch
        squares["before"] = squares["recalibrated"].copy()
        squares["before"][:50] *= (before / recalibrated) ** 2 * 12 - 11
    errors = HeldOutErrors.of(squares, noise_floor=floor)
    runs = HeldOutRuns(data.outputs, data.outputs, data.outputs, fit, fit, errors)
    assert (errors.change("before", "recalibrated") == "better") == (before == 0.5 and recalibrated == 0.1)
    statement = statement_of(found, runs)
    assert statement.verdict is verdict
    assert ("diagnosis.shift_mends_nothing" in [each.code for each in statement.remarks]) == (
        verdict is not MismatchVerdict.PARAMETER_SHIFT
    )
    assert ("do not mend it" in statement.sentence) == (verdict is MismatchVerdict.UNEXPLAINED)
    statement = statement_of(found, replace(runs, together=True))
    assert statement.verdict is MismatchVerdict.PARAMETER_SHIFT


@pytest.mark.parametrize("law", ["-x**3", "-x**3 + 0.5*x**2"])
def test_parameters_that_the_recordings_to_learn_from_do_not_tell_have_shifted(law: str) -> None:
    """Small swings do not tell c, and the one held out is large: the error is no physics that is missing."""
    draw, t = np.random.default_rng(5), np.arange(0, 4, 0.1)
    x, k, c = sympy.symbols("x k c", real=True)
    added = sympy.lambdify(x, 2 * sympy.sympify(law, {"x": x}))
    parts = []
    for label, begin in (("a", 0.1), ("b", -0.1), ("c", 0.05), ("large", 2.0)):
        run = solve_ivp(lambda _, y: -1.3 * y + added(y), (0, 4), [begin], t_eval=t, rtol=1e-9)
        parts.append(
            pd.DataFrame({"recording": label, "t": t, "x": run.y[0] + 0.002 * draw.normal(size=len(t))})
        )
    model = Dynamics(
        ("x",), (-k * x - c * x**3,), Diffusion.identity(1), outputs=(("x", x),),
        parameters=(Parameter("k", 1.0), Parameter("c", 1.9)),
    )  # fmt: skip
    found = siq.diagnose(model, pd.concat(parts), settings=MismatchStudy(held_out=("large",)))
    codes = [each.code for each in found.statement.remarks]
    shifted = law == "-x**3"
    assert found.verdict is (MismatchVerdict.PARAMETER_SHIFT if shifted else MismatchVerdict.UNEXPLAINED)
    assert ("diagnosis.one_set_of_parameters" in codes) == shifted
