"""How is a measured value written: with its error, to matching digits, and with its unit?"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from siq.numerics.number_text import MINUS, SMALLEST, SUPERSCRIPTS, number_text

EXACT_DIGITS = 4  # an error below half of the last of so many digits is left out
SMALLEST_PLAIN, LARGEST_PLAIN = (
    -3,
    4,
)  # decimal exponents between which a number is written without a power of ten


def value_text(
    value: float, error: float | None = None, *, unit: str = "", digits: int = EXACT_DIGITS
) -> str:
    """Write a value with its standard error, both to the digits that the error leaves.

    Parameters
    ----------
    value, error
        The value and its standard error; None or NaN where it is not known.
    unit
        As `unit_text` takes it.
    digits
        Significant digits of a value without an error.

    Returns
    -------
    str
        Such as ``"1.115 ± 0.031 µm"`` or ``"(1.047 ± 0.012) × 10⁻⁸"``. An error that does not reach the
        fourth digit of the value is not written, and neither is one that is not known.

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


def _two_digits(value: float) -> str:
    power = _exponent(abs(value), 2) if value else 0
    if SMALLEST_PLAIN <= power <= LARGEST_PLAIN:
        return _plain(round(value, 1 - power), max(1 - power, 0))
    return f"{_plain(value / 10.0**power, 1)} × 10{str(power).translate(SUPERSCRIPTS)}"


def unit_text(unit: str | None) -> str:
    """A unit as it is printed: ``um^2/s`` as µm²/s, ``s**(-1)`` as 1/s; nothing for ``1``.

    Parameters
    ----------
    unit
        As cards and headings have it. What is no product of powers is kept as it is.

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
    rounded = [round(float(value) / unit) * unit for value in position]
    texts = [f"{value:.{digits}g}" for value in rounded]
    return "(" + ", ".join("0" if float(text) == 0 else text.replace("-", MINUS) for text in texts) + ")"
