"""How is a part of what is missing called: with its size, its place, and what else it may be?"""

from __future__ import annotations

from collections.abc import Sequence

from siq.mismatch.candidates import GENERIC, PROCESS_NOISE
from siq.mismatch.stated_parts import Rival, StatedFunction, StatedMechanism
from siq.numerics.measured_text import value_text
from siq.numerics.word_text import capital, listed

LISTED = 2  # names in a sentence, before the rest is counted
COUNTABLE = {"bias", "coupling", "delay", "drift", "drive", "offset"}  # last words that take an article


def named(mechanism: StatedMechanism) -> str:
    """A mechanism with its size, its place, and what else it may be.

    Such as ``dry friction of 0.310 ± 0.015 m/s² in the equation of v``.
    """
    sizes = [
        (name, value_text(entry.estimate, entry.standard_error, unit=entry.unit))
        for name, entry in mechanism.parameters.items()
    ]
    if len(sizes) == 1 and mechanism.name != GENERIC:
        what = f"{_noun(mechanism)} of {sizes[0][1]}{_place(mechanism)}"
    else:
        values = ", ".join(f"{name} = {size}" for name, size in sizes)
        what = placed(mechanism) + (f" ({values})" if sizes else "")
    return f"{what}{or_else(mechanism)}"


def placed(mechanism: StatedMechanism) -> str:
    """A mechanism with its place alone, such as ``dry friction in the equation of v``."""
    return f"{_noun(mechanism)}{_place(mechanism)}"


def or_else(mechanism: StatedMechanism) -> str:
    """What else it may be, in brackets or behind a comma; empty where nothing explains as much."""
    others = _names(_equals(mechanism), mechanism)
    if not others:
        return ""
    if len(others) > LISTED:
        return f", or one of {len(others)} others that explain the recordings as well"
    verb = "explains" if len(others) == 1 else "explain"
    return f" (or {listed(others, 'or')}, which {verb} the recordings as well)"


def alternatives(mechanism: StatedMechanism) -> tuple[str, ...]:
    """What cannot be told from a mechanism, and whether anything else explains as much."""
    if mechanism.name == PROCESS_NOISE:
        return ()
    lines = []
    same = _names(_equals(mechanism), mechanism)
    needless = _names([each for each in mechanism.rivals if each.standing == "needless"], mechanism)
    own = _own(mechanism)
    if same:
        lines.append(f"These recordings cannot tell {own} from {listed(same, 'or')}.")
    if needless:
        more = "has more parameters" if len(needless) == 1 else "have more parameters"
        lines.append(
            f"{capital(listed(needless, 'and'))} {more} than {own}, and fit{'s' * (len(needless) == 1)} no"
            " better than these would by chance."
        )
    if not same and not needless:
        others = [each for each in mechanism.rivals if each.standing == "less"]
        best = max((each.delta_chi2 for each in others), default=None)
        gain = mechanism.evidence.delta_chi2
        if best is None or gain is None:
            lines.append(f"No other mechanism promised enough to be compared with {own}.")
        else:
            next_best = f"the next best gains {best:.0f} in χ², {own} {gain:.0f}"
            lines.append(
                f"No other mechanism that was fitted explains the recordings as well as {own}:"
                f" {next_best if best >= 1 else 'the others gain nothing'}."
            )
    return tuple(lines)


def described_part(part: StatedFunction) -> str:
    """A part of the model of what has no name, with its place: ``a function of x in the equation of v``."""
    if part.equations:
        many = "s" if len(part.equations) > 1 else ""
        return f"{part.name} in the equation{many} of {listed(list(part.equations), 'and')}"
    return f"{part.name} in the measurement of {listed(list(part.outputs), 'and')}"


def _equals(mechanism: StatedMechanism) -> list[Rival]:
    return [each for each in mechanism.rivals if each.standing == "same"]


def _names(rivals: Sequence[Rival], mechanism: StatedMechanism) -> list[str]:
    """Names of rivals, each once; their labels where the name alone is that of the mechanism itself."""
    return list(
        dict.fromkeys(each.label if each.name in (mechanism.name, GENERIC) else each.name for each in rivals)
    )


def _own(mechanism: StatedMechanism) -> str:
    alike = any(each.name == mechanism.name for each in mechanism.rivals)
    return mechanism.label if alike or mechanism.name == GENERIC else mechanism.name


def _noun(mechanism: StatedMechanism) -> str:
    if mechanism.name == GENERIC:
        return f"the term {'; '.join(mechanism.terms.values())}" if mechanism.terms else "a term"
    if mechanism.name.split()[-1] not in COUNTABLE:
        return mechanism.name
    return f"{'an' if mechanism.name[0] in 'aeiou' else 'a'} {mechanism.name}"


def _place(mechanism: StatedMechanism) -> str:
    if mechanism.equations:
        many = "s" if len(mechanism.equations) > 1 else ""
        return f" in the equation{many} of {listed(list(mechanism.equations), 'and')}"
    return f" in the measurement of {listed(list(mechanism.terms), 'and')}" if mechanism.terms else ""
