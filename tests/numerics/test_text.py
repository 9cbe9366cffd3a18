from __future__ import annotations

import math

import pytest

from siq.numerics.text import number_text, range_text, squared, unit_text, value_text


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (1.11512, 0.0312, "1.115 ± 0.031"),
        (-1.9941, 0.0423, "−1.994 ± 0.042"),
        (485.2, 132.0, "490 ± 130"),
        (33.2, 16.4, "33 ± 16"),
        (99.96, 0.96, "99.96 ± 0.96"),
        (0.2500001, 1e-9, "0.2500"),  # the error does not reach the digits that are shown
        (0.25, math.nan, "0.2500"),
        (1.047e-8, 1.2e-10, "(1.047 ± 0.012) × 10⁻⁸"),
        (1234567.0, 890.0, "(1.23457 ± 0.00089) × 10⁶"),
        (9.9999996, math.nan, "10.00"),
        (0.0, 0.01, "0.000 ± 0.010"),
        (0.0, math.nan, "0"),
        (5e-324, math.nan, "0"),
        (math.nan, 1.0, "—"),
        (2.5e-7, 1.2e-9, "(2.500 ± 0.012) × 10⁻⁷"),
        (1.5, None, "1.500"),
    ],
)
def test_a_value_has_the_digits_that_its_error_leaves(value, error, text):
    assert value_text(value, error) == text


def test_a_unit_stands_behind_value_and_error_alike():
    assert value_text(1.11512, 0.0312, unit="um^2/s") == "1.115 ± 0.031\u00a0µm²/s"
    assert value_text(2.0, unit="1") == "2.000"


@pytest.mark.parametrize(
    ("unit", "text"),
    [
        ("um", "µm"),
        ("um^2/s", "µm²/s"),
        ("m/s**2", "m/s²"),
        ("s^-1", "1/s"),
        ("s**(-2)", "1/s²"),
        ("m**12", "m¹²"),
        ("1/(m**2*s**2)", "1/(m²·s²)"),
        ("um/ms", "µm/ms"),
        ("°C", "°C"),
        ("1", ""),
        (None, ""),
        ("min", "min"),
    ],
)
def test_units_are_typeset(unit, text):
    assert unit_text(unit) == text


def test_the_square_of_a_unit_keeps_what_it_is_of():
    assert unit_text(squared("um")) == "µm²"
    assert unit_text(squared("m/s")) == "(m/s)²"
    assert squared("1") == ""


def test_a_range_has_two_digits_at_both_ends():
    assert range_text(3.14, 33.3, unit="s") == "3.1 to 33\u00a0s"
    assert range_text(995.0, 12345678.0) == "1000 to 1.2 × 10⁷"


def test_what_rounding_left_of_zero_is_written_as_zero():
    assert number_text(4.94066e-324) == "0.000"
    assert number_text(1e-30) == "1.000 × 10⁻³⁰"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.0, "1.000"),
        (-2.0012, "−2.001"),
        (0.0, "0.000"),
        (0.0123, "0.012"),
        (0.00999999, "1.000 × 10⁻²"),
        (8.87e-4, "8.870 × 10⁻⁴"),
        (-1.5e12, "−1.500 × 10¹²"),
        (float("nan"), "—"),
        (float("-inf"), "−∞"),
    ],
)
def test_number_text(value: float, text: str) -> None:
    assert number_text(value) == text
