from __future__ import annotations

import pytest

from siq.numerics.text import number_text


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
