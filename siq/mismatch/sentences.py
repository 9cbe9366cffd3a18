"""How would a colleague say it? The sentences of a diagnosis, made from its numbers and from nothing else.

The page, the report as text and the terminal all show these, so that none can contradict another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from siq.mismatch.candidates import GENERIC, PROCESS_NOISE
from siq.mismatch.held_out_errors import HeldOutErrors, Run
from siq.mismatch.investigation import MismatchVerdict
from siq.mismatch.statement import (
    Description,
    Recalibrated,
    Rival,
    StatedFunction,
    StatedMechanism,
    Statement,
)
from siq.numerics.measured_text import value_text
from siq.numerics.number_text import LARGEST_PLAIN_NUMBER, number_text
from siq.numerics.share_text import SMALLEST_SHARE, p_equation, p_text, percent

NOTICED = 1.96  # standard errors beyond which a parameter counts as changed
LISTED = 2  # names in a sentence, before the rest is counted
LOOKS_RANDOM = 2e-3  # the p-value below which a name is refused; siq.mismatch.remainder.DOUBTFUL
COUNTABLE = {"bias", "coupling", "delay", "drift", "drive", "offset"}  # last words that take an article


def sentence_of(statement: Statement, units: Mapping[str, str]) -> str:
    """What the page opens with: the verdict, how large, and what it does to the held-out error.

    Parameters
    ----------
    statement
        All but its own sentence.
    units
        Of the simulation's own parameters, by name.
    """
    errors = statement.errors
    if statement.verdict is MismatchVerdict.NO_MISMATCH:
        return f"The simulation explains the recordings as it is. {_as_it_is(errors)}".strip()
    if statement.verdict is MismatchVerdict.PARAMETER_SHIFT:
        said = shifted(statement.recalibration or {}, units)
        gain = gained(errors, "before", "recalibrated", it="With the new values", them="them")
        return (
            f"The simulation's equations explain the recordings, but with other parameters: {said}. {gain}"
        ).strip()
    if statement.verdict is MismatchVerdict.UNEXPLAINED:
        return f"{_unexplained(statement)} {_described(statement)}".strip()
    if statement.random_forces:
        return f"{_random_forces(statement.mechanisms[0])} {_not_foreseen(errors)}".strip()
    what = " and ".join(named(each) for each in statement.mechanisms)
    they = len(statement.mechanisms) > 1
    # What is credited to physics is only what neither the simulation as given nor other parameters can do.
    gain = gained(
        errors, "without", "named" if statement.described else "augmented",
        it=f"With {'them' if they else 'it'}", them="them" if they else "it",
    )  # fmt: skip
    return f"The simulation lacks {what}. {gain} {_rest(statement)}".strip()


def words_of(statement: Statement) -> dict[str, tuple[str, ...]]:
    """The other sentences, by what they are about.

    Returns
    -------
    dict
        ``alternatives``: what cannot be told apart, and whether anything else would do. ``explained``: how
        much of the difference is explained. ``left``: what that leaves.
    """
    description = statement.description
    mechanisms = statement.mechanisms if description is None else description.by
    return {
        "alternatives": tuple(line for each in mechanisms for line in alternatives(each)),
        "explained": explained(mechanisms),
        "left": () if description is None else left_over(description),
    }


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
        listed = ", ".join(f"{name} = {size}" for name, size in sizes)
        what = f"{_noun(mechanism)}{_place(mechanism)}" + (f" ({listed})" if sizes else "")
    return f"{what}{_or_else(mechanism)}"


def _or_else(mechanism: StatedMechanism) -> str:
    others = _names(_equals(mechanism), mechanism)
    if not others:
        return ""
    if len(others) > LISTED:
        return f", or one of {len(others)} others that explain the recordings as well"
    verb = "explains" if len(others) == 1 else "explain"
    return f" (or {_listed(others, 'or')}, which {verb} the recordings as well)"


def alternatives(mechanism: StatedMechanism) -> tuple[str, ...]:
    """What cannot be told from a mechanism, and whether anything else explains as much."""
    if mechanism.name == PROCESS_NOISE:
        return ()
    lines = []
    same = _names(_equals(mechanism), mechanism)
    needless = _names([each for each in mechanism.rivals if each.standing == "needless"], mechanism)
    own = _own(mechanism)
    if same:
        lines.append(f"These recordings cannot tell {own} from {_listed(same, 'or')}.")
    if needless:
        more = "has more parameters" if len(needless) == 1 else "have more parameters"
        lines.append(
            f"{_capital(_listed(needless, 'and'))} {more} than {own}, and fit{'s' * (len(needless) == 1)} no"
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


def explained(mechanisms: Sequence[StatedMechanism]) -> tuple[str, ...]:
    """How much of the excess over noise mechanisms explain, all of them together."""
    if not mechanisms or mechanisms[0].name == PROCESS_NOISE:
        return ()
    share = percent(mechanisms[0].share_of_excess)
    who = _capital(_listed([each.label for each in mechanisms], "and"))
    verb = "explains" if len(mechanisms) == 1 else "together explain"
    return (f"{who} {verb} {share} of the difference that other parameters cannot explain.",)


def left_over(description: Description) -> tuple[str, ...]:
    """Why a mismatch has no name: what is left, and whether it looks like noise."""
    p = description.p_residuals_random
    lines = []
    if description.by and description.misleading:
        lines.append(
            "It is not named: with it, recordings held out are foreseen worse than without, so that it stands"
            " in for something else."
        )
    elif description.by and description.too_faint:
        lines.append(
            "It is not named, since a smooth function that the dictionary does not have is nearly as likely."
        )
    elif description.by and description.p_alike is not None:
        lines.append(
            "It is not named: of effects that have no name, mechanisms explain as much with a probability of"
            f" {p_text(description.p_alike)}."
        )
    elif description.by:
        lines.append("It is not named: what explains only a part may be standing in for something else.")
    if p >= LOOKS_RANDOM:
        lines.append(f"What is left looks like noise ({p_equation(p)}).")
    else:
        lines.append(
            f"What is left is not noise: noise alone would look as structured with a probability of"
            f" {p_text(p)} (the p-value)."
        )
    if description.random_forces_admitted:
        lines.append("Random forces had to stand in for it in the fit.")
    return tuple(lines)


def shifted(recalibration: Mapping[str, Recalibrated], units: Mapping[str, str]) -> str:
    """Which parameters differ from those on the card, the most certain first, with both values."""
    changes = {
        name: abs(each.after - each.before) / each.standard_error if each.standard_error > 0 else float("inf")
        for name, each in recalibration.items()
        if each.after != each.before
    }
    ranked = sorted(changes, key=lambda name: -changes[name])
    if not ranked:
        return "which of them cannot be said"
    certain = [name for name in ranked if changes[name] > NOTICED]

    def change(name: str) -> str:
        each, unit = recalibration[name], units.get(name, "1")
        after = value_text(each.after, each.standard_error, unit=unit)
        return f"{name} is {after}, where the card has {_value(each.before)}"

    if not certain:
        return f"none of them stands out by itself, and most of all {change(ranked[0])}"
    shown = "; ".join(change(name) for name in certain[: LISTED + 1])
    more = len(certain) - LISTED - 1
    return shown if more <= 0 else f"{shown}; and {more} more differ{'s' * (more == 1)}"


def gained(errors: HeldOutErrors, without: Run, with_it: Run, *, it: str, them: str) -> str:
    """What the error on held-out recordings says, whichever way it went; empty where it is not known.

    Parameters
    ----------
    errors
        All of them.
    without, with_it
        Without and with what was found.
    it, them
        What was found, as the sentence begins (``"With it"``) and goes on (``"it"``).
    """
    noise = _noise(errors)
    change, first, second = errors.change(without, with_it), errors.error(without), errors.error(with_it)
    if first is None or second is None:
        if change == "unknown":
            known = errors.noise_floor is not None
            return (
                f"The simulation runs away on the held-out recordings, {it.lower()} or without."
                if known
                else ""
            )
        if change == "worse":
            return (
                f"{it}, the simulation runs away on the held-out recordings; its error was {_error(first)}"
                " of their spread."
            )
        return (
            f"{it}, the error on held-out recordings is {_error(second)} of their spread; without"
            f" {them}, the simulation runs away{noise}."
        )
    if change == "better" and _error(first) != _error(second):
        before = f"{_error(first)} of their spread"
        if without == "without" and errors.before is None:
            before += " (with its own parameters refitted; as given, the simulation runs away)"
        elif without == "without" and errors.change("before", "without") == "better":
            before = (
                f"{_error(errors.before)} of their spread ({_error(first)} with its own parameters refitted)"
            )
        return f"{it}, the error on held-out recordings falls from {before} to {_error(second)}{noise}."
    if errors.at_noise(without) and change != "worse":
        return (
            f"The held-out recordings are too noisy to show it: their error is {_error(first)} without {them}"
            f" and {_error(second)} with {them}{noise}."
        )
    if change == "same" and second < first and _error(first) != _error(second):
        return (
            f"{it}, the error on held-out recordings falls from {_error(first)} of their spread to"
            f" {_error(second)}, no more than it may by chance{noise}."
        )
    what = (
        "does not improve the prediction of recordings held out"
        if change != "worse"
        else "makes the prediction of recordings held out worse"
    )
    return (
        f"This explains the recordings that it was found in, but {what}: their error is {_error(first)}"
        f" without {them} and {_error(second)} with {them}{noise}."
    )


def _as_it_is(errors: HeldOutErrors) -> str:
    if errors.noise_floor is None:
        return ""
    if errors.before is None:
        return "On the held-out recordings, however, it runs away."
    if errors.at_noise("before"):
        return f"Its error on held-out recordings is {_error(errors.before)} of their spread{_noise(errors)}."
    return (
        f"On held-out recordings, however, its error is {_error(errors.before)}, more than noise alone"
        f" ({_error(errors.noise_floor)}): they may differ from those that it was compared with."
    )


def _error_stays(errors: HeldOutErrors) -> str:
    if errors.noise_floor is None:
        return ""
    if errors.before is None and errors.recalibrated is None:
        return "The simulation runs away on the held-out recordings."
    given = "runs away" if errors.before is None else f"is off by {_error(errors.before)} of their spread"
    fitted = "runs away" if errors.recalibrated is None else _error(errors.recalibrated)
    by = "" if errors.recalibrated is None else "by "
    return (
        f"On held-out recordings the simulation {given} as given, and {by}{fitted} with its own parameters"
        f" refitted{_noise(errors)}."
    )


def _rest(statement: Statement) -> str:
    """What describes the rest that mechanisms with a name leave, and what that does to the held-out error."""
    if not statement.described:
        return ""
    parts = _listed([described_part(each) for each in statement.described], "and")
    verb = "describe" if len(statement.described) > 1 else "describes"
    # The names are what it is compared with, and not the simulation without them.
    gain = gained(statement.errors, "named", "augmented", it="With that, too", them="that")
    return f"What is left has no name; {parts} {verb} it. {gain}".strip()


def _described(statement: Statement) -> str:
    """What the model of something without a name does to the held-out error, or that nothing was gained."""
    errors = statement.errors
    if errors.noise_floor is None or statement.description is None:
        return _error_stays(errors)
    if not statement.described:
        return (
            "Neither a mechanism nor a function of its coordinates improves the prediction of recordings"
            f" held out, so that the simulation stays as it was. {_error_stays(errors)}"
        ).strip()
    gain = gained(errors, "without", "augmented", it="With it", them="it")
    named = {each.label for each in statement.description.by}
    if all(each.label in named for each in statement.described):
        return gain
    what = " and ".join(described_part(each) for each in statement.described)
    many = len(statement.described) > 1
    return f"{_capital(what)} {'describe' if many else 'describes'} it. {gain}".strip()


def described_part(part: StatedFunction) -> str:
    """A part of the model of what has no name, with its place: ``a function of x in the equation of v``."""
    if part.equations:
        many = "s" if len(part.equations) > 1 else ""
        return f"{part.name} in the equation{many} of {_listed(list(part.equations), 'and')}"
    return f"{part.name} in the measurement of {_listed(list(part.outputs), 'and')}"


def _not_foreseen(errors: HeldOutErrors) -> str:
    if errors.noise_floor is None or errors.recalibrated is None:
        return ""
    return (
        "No simulation can foresee them, so that its error on held-out recordings remains"
        f" {_error(errors.recalibrated)} of their spread{_noise(errors)}."
    )


def _random_forces(mechanism: StatedMechanism) -> str:
    sizes = [
        f"{value_text(entry.estimate, entry.standard_error, unit=entry.unit, digits=3)} on"
        f" {name.removeprefix('intensity_')}"
        for name, entry in mechanism.parameters.items()
    ]
    size = f", with an intensity of {_listed(sizes, 'and')}" if sizes else ""
    return f"The system is driven by random forces that the simulation does not have{size}."


def _unexplained(statement: Statement) -> str:
    description = statement.description
    if statement.errors.noise_floor is None and description is None:
        return statement.sentence
    begin = "The recordings differ from the simulation by more than noise and wrong parameters"
    if description is None or not description.by:
        return f"{begin}, and no mechanism in the dictionary accounts for it."
    what = " and ".join(f"{_noun(each)}{_place(each)}" for each in description.by)
    what += _or_else(description.by[0]) if len(description.by) == 1 else ""
    share = percent(description.share_described)
    if description.misleading:
        return f"{begin}. It looks like {what}, but recordings held out are foreseen worse with that."
    if description.too_faint:
        return f"{begin}. It looks like {what}, which is not certain enough to be named."
    if description.share_described > 1 - SMALLEST_SHARE:
        return (
            f"{begin}. {_capital(what)} would account for {share} of it, but not convincingly enough to be"
            " named."
        )
    amount = "no part" if share == "none" else share
    return (
        f"{begin}, and nothing explains it fully. The best description is {what}: it covers {amount} of it."
    )


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
        return f" in the equation{many} of {_listed(list(mechanism.equations), 'and')}"
    return f" in the measurement of {_listed(list(mechanism.terms), 'and')}" if mechanism.terms else ""


def _listed(names: Sequence[str], word: str) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {word} {names[-1]}"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _noise(errors: HeldOutErrors) -> str:
    return "" if errors.noise_floor is None else f" (noise alone: {_error(errors.noise_floor)})"


def _error(value: float | None) -> str:
    """An error as a share of the recordings' spread."""
    if value is None:
        return "unknown"
    share = 100 * value
    if share >= 1e3 or 0 < share < 1e-3:
        text = f"{share:.0f}" if 1e3 <= share < LARGEST_PLAIN_NUMBER else number_text(share, decimals=2)
    else:
        text = f"{share:#.3g}".rstrip(".")
    return f"{text} %"


def _value(value: float) -> str:
    text = f"{value:.6g}"
    return number_text(value) if "e" in text else text.replace("-", "−")
