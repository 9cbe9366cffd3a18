"""Numbers as text: rounding, errors with matching digits, shares, units."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np


def listed(names: Sequence[str], word: str = "or") -> str:
    """One name or several, with a word before the last: ``friction, a spring or a delay``."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {word} {names[-1]}"


LARGEST_PLAIN_NUMBER = 1e5  # a longer row of digits is not read, but counted
SMALLEST = 1e-300  # less is what rounding left of zero: no measurement has such numbers
SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
MINUS = "−"


def number_text(value: float, *, decimals: int = 3) -> str:
    """Write a number with so many decimals, or as ``m × 10ᵉ`` where those would hide or feign digits.

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
    """Write a positive number as m × 10ᵉ: m with so many decimals, and e, which is 0 for a plain number."""
    # Two significant digits are the least that says anything about a coefficient.
    if magnitude == 0 or 10.0 ** (1 - decimals) <= magnitude < LARGEST_PLAIN_NUMBER:
        return f"{magnitude:.{decimals}f}", 0
    mantissa, exponent = f"{magnitude:.{decimals}e}".split("e")
    return mantissa, int(exponent)


SMALLEST_SHARE = 1e-3
SMALLEST_P = 1e-12  # below which the tail of a distribution tells nothing about real errors


def percent(share: float) -> str:
    """Write a share in words that do not round it to all or nothing: ``99.97 %``, ``more than 99.9 %``."""
    if share <= 0:
        return "none"
    if share >= 1:
        return "all"
    if share < SMALLEST_SHARE:
        return "less than 0.1 %"
    if share > 1 - SMALLEST_SHARE:
        return "more than 99.9 %"
    decimals = 1 if share < 0.1 or share > 0.9 else 0
    # Rounded down, so that a share of 99.96 % does not become all.
    return f"{math.floor(share * 100 * 10**decimals) / 10**decimals:g} %"


def p_text(p: float) -> str:
    """Write a p-value: ``0.034``, ``2.9 × 10⁻³``, ``less than 10⁻¹²``."""
    if p < SMALLEST_P:
        return "less than 10⁻¹²"
    return f"{p:.2g}" if p >= 0.01 else number_text(p, decimals=1)


def p_equation(p: float) -> str:
    """Write a p-value as an equation: ``p = 0.034``, ``p < 10⁻¹²``."""
    return "p < 10⁻¹²" if p < SMALLEST_P else f"p = {p_text(p)}"


EXACT_DIGITS = 4  # an error below half of the last of so many digits is left out
SMALLEST_PLAIN, LARGEST_PLAIN = -3, 4  # decimal exponents that are written without a power of ten


def value_text(
    value: float, error: float | None = None, *, unit: str = "", digits: int = EXACT_DIGITS
) -> str:
    """Write a value with its standard error, both to the digits that the error leaves.

    Such as ``"1.115 ± 0.031 µm"`` or ``"(1.047 ± 0.012) × 10⁻⁸"``. An error that does not reach the fourth
    digit of the value is not written, and neither is one that is not known (None or NaN); the value then has
    so many significant digits.

    Examples
    --------
    >>> value_text(1.11512, 0.0312)
    '1.115 ± 0.031'
    >>> value_text(0.2500001, 1e-9)
    '0.2500'
    """
    if not math.isfinite(value):
        return number_text(value)
    if abs(value) < SMALLEST:
        value = 0.0
    error = math.nan if error is None else error
    known = math.isfinite(error) and error > 0
    largest = max(abs(value), error if known else 0.0)
    if largest == 0:
        return _with_unit("0", unit)
    power = _exponent(largest, 2 if known and error > abs(value) else EXACT_DIGITS)
    scale = 10.0**power if not SMALLEST_PLAIN <= power <= LARGEST_PLAIN else 1.0
    value, error = value / scale, error / scale
    power_left = _exponent(abs(value), EXACT_DIGITS) if value else 0
    written = known and error >= 0.5 * 10.0 ** (power_left - EXACT_DIGITS + 1)
    if written or (known and value == 0):
        decimals = 1 - _exponent(error, 2)
        value, error, decimals = round(value, decimals), round(error, decimals), max(decimals, 0)
        text = f"{_plain(value, decimals)} ± {error:.{decimals}f}"
    else:
        text = _plain(value, max(digits - 1 - power_left, 0))
    if scale != 1.0:
        text = f"({text})" if "±" in text else text
        text += f" × 10{str(power).translate(SUPERSCRIPTS)}"
    elif unit and "±" in text and unit_text(unit).startswith("("):
        text = f"({text})"
    return _with_unit(text, unit)


def _plain(value: float, decimals: int) -> str:
    text = f"{abs(value):.{decimals}f}"
    return (MINUS if value < 0 and float(text) != 0 else "") + text


def _exponent(magnitude: float, digits: int) -> int:
    """The decimal exponent once the number is rounded to so many digits: 9.99 is 10."""
    return int(f"{magnitude:.{digits - 1}e}".split("e")[1])


def _with_unit(text: str, unit: str) -> str:
    shown = unit_text(unit)
    return f"{text}\u00a0{shown}" if shown else text


def range_text(low: float, high: float, *, unit: str = "") -> str:
    """Write a range by its ends, to two digits, where an error is as large as the value.

    Examples
    --------
    >>> range_text(3.14, 33.3)
    '3.1 to 33'
    """
    return _with_unit(f"{_two_digits(low)} to {_two_digits(high)}", unit)


def span_text(span: tuple[float, float, float]) -> str:
    """Write the least, the usual and the greatest of something; one number where all are alike.

    Examples
    --------
    >>> span_text((1.0, 2.5, 12000.0))
    '1 to 12,000 (usually 2.5)'
    """
    low, usual, high = (f"{value:,.0f}" if value >= 1000 else f"{value:.4g}" for value in span)
    return low if low == high else f"{low} to {high} (usually {usual})"


def _two_digits(value: float) -> str:
    power = _exponent(abs(value), 2) if value else 0
    if SMALLEST_PLAIN <= power <= LARGEST_PLAIN:
        return _plain(round(value, 1 - power), max(1 - power, 0))
    return f"{_plain(value / 10.0**power, 1)} × 10{str(power).translate(SUPERSCRIPTS)}"


def unit_text(unit: str | None) -> str:
    """A unit as it is printed: ``um^2/s`` as µm²/s, ``s**(-1)`` as 1/s; nothing for ``1``.

    What is no product of powers is kept as it is.

    Examples
    --------
    >>> unit_text("um**2/s")
    'µm²/s'
    """
    text = "" if unit is None else unit.strip()
    if text in ("1", "-", ""):
        return ""
    text = re.sub(
        r"(?:\*\*|\^)\s*(?:\(\s*(-?\d+)\s*\)|(-?\d+))",
        lambda power: (power[1] or power[2]).translate(SUPERSCRIPTS),
        text,
    )
    text = re.sub(r"(?<![A-Za-z])u(?=(?:m|s|g|N|V|A|W|K|L|l|J|Pa|Hz|M|mol|rad)(?![A-Za-z]))", "µ", text)
    text = text.replace("**", "^").replace("*", "·")
    if "/" not in text:
        text = re.sub(r"\b([A-Za-zµΩ°]+)⁻¹(?!\d)", r"1/\1", text)
    inverse = re.fullmatch(r"([A-Za-zµΩ°]+)⁻([²³⁴-⁹])", text)
    return f"1/{inverse[1]}{inverse[2]}" if inverse else text


def squared(unit: str) -> str:
    """The square of a unit: ``um`` gives ``um^2``, ``m/s`` gives ``(m/s)^2``."""
    unit = unit.strip()
    if unit in ("1", "-", ""):
        return ""
    return f"{unit}^2" if re.fullmatch(r"[^\W\d_]+|[%°]", unit) else f"({unit})^2"


def place_text(position: Sequence[float] | np.ndarray, *, digits: int = 3) -> str:
    """A point as text, its coordinates to so many digits of the largest.

    Examples
    --------
    >>> place_text([1.0, -3e-17, 0.52])
    '(1, 0, 0.52)'
    """
    size = max((abs(float(value)) for value in position), default=0.0)
    unit = 10.0 ** (_exponent(size, digits) - digits + 1) if size else 1.0
    texts = [f"{round(float(value) / unit) * unit:.{digits}g}" for value in position]
    return "(" + ", ".join("0" if float(text) == 0 else text.replace("-", MINUS) for text in texts) + ")"
