"""How would a colleague say it? The sentences of a diagnosis, made from its numbers and from nothing else.

The page, the report as text and the terminal all show these, so that none can contradict another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from siq.mismatch.candidates import PROCESS_NOISE
from siq.mismatch.error_sentences import as_it_is, error_stays, gained, not_foreseen
from siq.mismatch.part_words import LISTED, alternatives, described_part, named, or_else, placed
from siq.mismatch.possible_verdicts import MismatchVerdict
from siq.mismatch.stated_parts import StatedMechanism
from siq.mismatch.statement import Description, Recalibrated, Statement
from siq.numerics.measured_text import value_text
from siq.numerics.number_text import number_text
from siq.numerics.share_text import SMALLEST_SHARE, p_equation, p_text, percent
from siq.numerics.word_text import capital, listed

NOTICED = 1.96  # standard errors beyond which a parameter counts as changed
LOOKS_RANDOM = 2e-3  # the p-value below which a name is refused; siq.mismatch.remainder.DOUBTFUL


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
        return f"The simulation explains the recordings as it is. {as_it_is(errors)}".strip()
    if statement.verdict is MismatchVerdict.PARAMETER_SHIFT:
        said = shifted(statement.recalibration or {}, units)
        gain = gained(errors, "before", "recalibrated", it="With the new values", them="them")
        return (
            f"The simulation's equations explain the recordings, but with other parameters: {said}. {gain}"
        ).strip()
    if statement.verdict is MismatchVerdict.UNEXPLAINED:
        return f"{_unexplained(statement)} {_described(statement)}".strip()
    if statement.random_forces:
        return f"{_random_forces(statement.mechanisms[0])} {not_foreseen(errors)}".strip()
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


def explained(mechanisms: Sequence[StatedMechanism]) -> tuple[str, ...]:
    """How much of the excess over noise mechanisms explain, all of them together."""
    if not mechanisms or mechanisms[0].name == PROCESS_NOISE:
        return ()
    share = percent(mechanisms[0].share_of_excess)
    who = capital(listed([each.label for each in mechanisms], "and"))
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


def _rest(statement: Statement) -> str:
    """What describes the rest that mechanisms with a name leave, and what that does to the held-out error."""
    if not statement.described:
        return ""
    parts = listed([described_part(each) for each in statement.described], "and")
    verb = "describe" if len(statement.described) > 1 else "describes"
    # The names are what it is compared with, and not the simulation without them.
    gain = gained(statement.errors, "named", "augmented", it="With that, too", them="that")
    return f"What is left has no name; {parts} {verb} it. {gain}".strip()


def _described(statement: Statement) -> str:
    """What the model of something without a name does to the held-out error, or that nothing was gained."""
    errors = statement.errors
    if errors.noise_floor is None or statement.description is None:
        return error_stays(errors)
    if not statement.described:
        return (
            "Neither a mechanism nor a function of its coordinates improves the prediction of recordings"
            f" held out, so that the simulation stays as it was. {error_stays(errors)}"
        ).strip()
    gain = gained(errors, "without", "augmented", it="With it", them="it")
    named = {each.label for each in statement.description.by}
    if all(each.label in named for each in statement.described):
        return gain
    what = " and ".join(described_part(each) for each in statement.described)
    many = len(statement.described) > 1
    return f"{capital(what)} {'describe' if many else 'describes'} it. {gain}".strip()


def _random_forces(mechanism: StatedMechanism) -> str:
    sizes = [
        f"{value_text(entry.estimate, entry.standard_error, unit=entry.unit, digits=3)} on"
        f" {name.removeprefix('intensity_')}"
        for name, entry in mechanism.parameters.items()
    ]
    size = f", with an intensity of {listed(sizes, 'and')}" if sizes else ""
    return f"The system is driven by random forces that the simulation does not have{size}."


def _unexplained(statement: Statement) -> str:
    description = statement.description
    if statement.errors.noise_floor is None and description is None:
        return statement.sentence
    begin = "The recordings differ from the simulation by more than noise and wrong parameters"
    if description is None or not description.by:
        return f"{begin}, and no mechanism in the dictionary accounts for it."
    what = " and ".join(placed(each) for each in description.by)
    what += or_else(description.by[0]) if len(description.by) == 1 else ""
    share = percent(description.share_described)
    if description.misleading:
        return f"{begin}. It looks like {what}, but recordings held out are foreseen worse with that."
    if description.too_faint:
        return f"{begin}. It looks like {what}, which is not certain enough to be named."
    if description.share_described > 1 - SMALLEST_SHARE:
        return (
            f"{begin}. {capital(what)} would account for {share} of it, but not convincingly enough to be"
            " named."
        )
    amount = "no part" if share == "none" else share
    return (
        f"{begin}, and nothing explains it fully. The best description is {what}: it covers {amount} of it."
    )


def _value(value: float) -> str:
    text = f"{value:.6g}"
    return number_text(value) if "e" in text else text.replace("-", "−")
