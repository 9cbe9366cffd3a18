"""How is a number written for a reader?"""

from __future__ import annotations

import math

LARGEST_PLAIN_NUMBER = 1e5  # a longer row of digits is not read, but counted
SMALLEST = 1e-300  # less is what rounding left of zero: no measurement has such numbers
SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
MINUS = "−"


def number_text(value: float, *, decimals: int = 3) -> str:
    """Write a number with so many decimals, or as ``m × 10ᵉ`` where those would hide or feign digits.

    Parameters
    ----------
    value
        The number.
    decimals
        Decimals of the plain number, or of the mantissa m.

    Returns
    -------
    str
        Such as ``"−2.001"``, ``"4.500 × 10⁻⁴"``; ``"—"`` for a missing value.
    """
    if math.isnan(value):
        return "—"
    if math.isinf(value):
        return f"{MINUS if value < 0 else ''}∞"
    if abs(value) < SMALLEST:
        value = 0.0
    mantissa, exponent = mantissa_and_exponent(abs(value), decimals)
    sign = MINUS if value < 0 else ""
    return f"{sign}{mantissa}" + (f" × 10{str(exponent).translate(SUPERSCRIPTS)}" if exponent else "")


def mantissa_and_exponent(magnitude: float, decimals: int) -> tuple[str, int]:
    """Write a positive number as m × 10ᵉ: m with so many decimals, and e, which is 0 for a plain number.

    Parameters
    ----------
    magnitude
        The number without its sign.
    decimals
        Decimals of m.
    """
    # Two significant digits are the least that says anything about a coefficient.
    if magnitude == 0 or 10.0 ** (1 - decimals) <= magnitude < LARGEST_PLAIN_NUMBER:
        return f"{magnitude:.{decimals}f}", 0
    mantissa, exponent = f"{magnitude:.{decimals}e}".split("e")
    return mantissa, int(exponent)
