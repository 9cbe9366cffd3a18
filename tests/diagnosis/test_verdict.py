"""What is stated of functions without a name."""

from __future__ import annotations

import pytest
import sympy

from siq.diagnosis.verdict import COORDINATE, _in_coordinate

P, Q = sympy.symbols("P Q", real=True)
AMPLITUDE = sympy.sqrt(P**2 + Q**2)


@pytest.mark.parametrize("power", range(6))
def test_a_formula_of_an_amplitude_is_written_in_it(power: int) -> None:
    """The square of an amplitude is ``P**2 + Q**2``, in which the amplitude itself does not occur."""
    assert _in_coordinate(AMPLITUDE**power, AMPLITUDE) == COORDINATE**power


def test_a_formula_of_a_state_is_written_in_it() -> None:
    assert _in_coordinate(3 * P**2 + sympy.sin(P), P) == 3 * COORDINATE**2 + sympy.sin(COORDINATE)
