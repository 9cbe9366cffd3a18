"""Values with errors and units, as people write them."""

from __future__ import annotations

import pytest

from siq.numerics.quantity_text import measured_text, unit_text


@pytest.mark.parametrize(
    ("value", "error", "unit", "text"),
    [
        (0.3104, 0.0153, "m/s**2", "0.310 ± 0.015 m/s²"),
        (-1.994, 0.0421, "1", "−1.994 ± 0.042"),
        (9.0, None, "1/s**2", "9.00 1/s²"),
        (1234.5, 210.0, "N/m", "1234 ± 210 N/m"),
        (2.5e-7, 1.2e-9, "kg", "(2.500 ± 0.012) × 10⁻⁷ kg"),
        (3.2e8, None, "1", "3.20 × 10⁸"),
        (0.0, None, "1", "0.00"),
        (float("nan"), None, "1", "unknown"),
        (1.5, float("nan"), "s", "1.50 s"),
    ],
)
def test_a_value_ends_with_the_last_digit_of_its_error(value, error, unit, text):
    assert measured_text(value, error, unit) == text


@pytest.mark.parametrize(
    ("unit", "text"),
    [
        ("m/s**2", "m/s²"), ("1", ""), ("", ""), ("1/(m**2*s)", "1/(m²·s)"), ("s**(-2)", "1/s²"),
        ("°C", "°C"), ("um/ms", "µm/ms"), ("s**(-1)", "1/s"), ("m**12", "m¹²"),
        ("1/(m**2*s**2)", "1/(m²·s²)"),
    ],
)  # fmt: skip
def test_units_have_raised_powers(unit, text):
    assert unit_text(unit) == text
