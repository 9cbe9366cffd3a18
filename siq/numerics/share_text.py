"""How are a share and a p-value written, so that rounding makes neither all nor nothing of them?"""

from __future__ import annotations

import math

from siq.numerics.number_text import SUPERSCRIPTS

SMALLEST_SHARE = 1e-3
SMALLEST_P = 1e-12  # below which the tail of a distribution tells nothing about real errors


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
