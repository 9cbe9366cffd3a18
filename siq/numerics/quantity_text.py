"""How is a measured quantity written: a value with its error to matching digits, and its unit?"""

from __future__ import annotations

import math
import re

from siq.numerics.number_text import LARGEST_PLAIN_NUMBER, MINUS, SUPERSCRIPTS

SMALLEST_PLAIN_NUMBER = 1e-4
SIGNIFICANT = 2  # digits of an error, as is the custom
SMALLEST_SHARE = 1e-3
SMALLEST_P = 1e-12  # below which the tail of a distribution tells nothing about real errors


def measured_text(value: float, error: float | None = None, unit: str = "1", *, digits: int = 3) -> str:
    """Write a quantity as people do: ``0.310 ± 0.015 m/s²``.

    Parameters
    ----------
    value, error
        The value ends with the last digit of its error; None where no error is known.
    unit
        As cards have it, ``"m/s**2"``; ``"1"`` for a plain number.
    digits
        Significant digits of a value without an error.
    """
    known = error is not None and math.isfinite(error) and error > 0
    if not math.isfinite(value):
        return "unknown"
    size = max(abs(value), error if known and error is not None else 0.0)
    plain = size == 0 or SMALLEST_PLAIN_NUMBER <= size < LARGEST_PLAIN_NUMBER
    power = 0 if plain else math.floor(math.log10(size))
    scaled = value / 10.0**power
    if known and error is not None:
        margin = error / 10.0**power
        decimals = max(SIGNIFICANT - 1 - math.floor(math.log10(margin)), 0)
        text = f"{scaled + 0.0:.{decimals}f} ± {margin:.{decimals}f}"
    else:
        leading = math.floor(math.log10(abs(scaled))) if scaled else 0
        text = f"{scaled + 0.0:.{max(digits - 1 - leading, 0)}f}"
    text = text.replace("-", MINUS)
    written = unit_text(unit)
    if known and (power or written):
        text = f"({text})" if power else text
    if power:
        text += f" × 10{str(power).translate(SUPERSCRIPTS)}"
    return f"{text} {written}" if written else text


def unit_text(unit: str) -> str:
    """Write a unit with raised powers: ``m/s**2`` as ``m/s²``; nothing for a plain number.

    Parameters
    ----------
    unit
        As cards have it. What is no product of powers is kept as it is.
    """
    if unit in ("1", ""):
        return ""
    factors = re.sub(
        r"\*\*\s*(?:\(\s*(-?\d+)\s*\)|(-?\d+))",
        lambda power: (power[1] or power[2]).translate(SUPERSCRIPTS),
        unit,
    )
    factors = re.sub(r"(?<![A-Za-z])u(?=(?:m|s|g|N|V|A|W|K|L|J|Pa|Hz|mol|rad)(?![A-Za-z]))", "µ", factors)
    factors = factors.replace("**", "^").replace("*", "·")
    factors = re.sub(r"\b([A-Za-zµΩ°]+)⁻¹(?!\d)", r"1/\1", factors) if "/" not in factors else factors
    inverse = re.fullmatch(r"([A-Za-zµΩ°]+)⁻([²³⁴-⁹])", factors)
    return f"1/{inverse[1]}{inverse[2]}" if inverse else factors


def percent(share: float) -> str:
    """Write a share in words that do not round it to all or nothing: ``99.97 %``, ``more than 99.9 %``.

    Parameters
    ----------
    share
        Between 0 and 1.
    """
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
    return f"{p:.2g}" if p >= 0.01 else _small(p)


def p_equation(p: float) -> str:
    """Write a p-value as an equation: ``p = 0.034``, ``p < 10⁻¹²``."""
    return "p < 10⁻¹²" if p < SMALLEST_P else f"p = {p_text(p)}"


def _small(p: float) -> str:
    mantissa, power = f"{p:.1e}".split("e")
    return f"{mantissa} × 10{str(int(power)).translate(SUPERSCRIPTS)}"
