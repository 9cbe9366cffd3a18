"""Words for the parts of what is missing, and for errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from siq.diagnosis.holdout import HeldOutErrors, Run
from siq.diagnosis.mechanisms import GENERIC, PROCESS_NOISE
from siq.numerics.text import LARGEST_PLAIN_NUMBER, capital, listed, number_text, value_text


@dataclass(frozen=True)
class Estimate:
    """A parameter's value with its standard error, None where it has none, and its unit."""

    estimate: float
    standard_error: float | None
    unit: str


@dataclass(frozen=True)
class Evidence:
    """Why a mechanism is believed; None where a test does not apply.

    Attributes
    ----------
    delta_chi2, delta_bic
        What it gains, see `siq.diagnosis.significance.TriedMechanism`.
    p_white, p_cluster
        Probabilities of as much by chance: if all errors are independent, and whatever errors within a
        recording have to do with each other.
    log_odds
        Logarithm of the odds that it is this mechanism, rather than a function without a name.
    """

    delta_chi2: float | None
    delta_bic: float | None
    p_white: float | None
    p_cluster: float | None
    log_odds: float | None = None


Standing = Literal["same", "needless", "less"]


@dataclass(frozen=True)
class Rival:
    """A mechanism that was fitted in the place of one that was found.

    Attributes
    ----------
    name, label
        As of `StatedMechanism`.
    delta_chi2
        What it gains, compared with the same simulation.
    further_parameters
        How many more it has than the one that was found.
    standing
        ``same``: it explains the recordings as well. ``needless``: it explains as much, with further
        parameters that gain no more than they would by chance. ``less``: it explains less.
    """

    name: str
    label: str
    delta_chi2: float
    further_parameters: int
    standing: Standing


@dataclass(frozen=True)
class StatedMechanism:
    """A mechanism that is named, or that describes what has no name.

    Attributes
    ----------
    name, label
        Of the dictionary, and told apart from its other forms and places.
    terms
        Formula that is added, by equation; see `siq.diagnosis.mechanisms.MechanismCandidate.changes`.
    parameters
        Those that it brings.
    evidence
        Why it is believed.
    share_of_excess
        What all mechanisms together explain of the excess over noise.
    indistinguishable_from
        Names of mechanisms that explain the recordings as well; None where it is not named itself.
    equations
        States in whose equations it changes something; none for a fault of the sensor.
    beside
        Labels of the mechanisms that were in place when it was judged.
    rivals
        What else was fitted in its place, the one that gains most first.
    """

    name: str
    label: str
    terms: Mapping[str, str]
    parameters: Mapping[str, Estimate]
    evidence: Evidence
    share_of_excess: float
    indistinguishable_from: tuple[str, ...] | None = None
    equations: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()
    rivals: tuple[Rival, ...] = ()


@dataclass(frozen=True)
class DescribedCurve:
    """A function of one coordinate with its band.

    Attributes
    ----------
    coordinate
        Of which it is a function.
    at, value, standard_error
        In the units of the card; each as long.
    """

    coordinate: str
    at: tuple[float, ...]
    value: tuple[float, ...]
    standard_error: tuple[float, ...]


@dataclass(frozen=True)
class DescribedSurface:
    """A function of two coordinates on a grid, with its standard errors.

    Attributes
    ----------
    coordinates
        Of which it is a function.
    at
        The grid, along the first and along the second of them, in the units of the card.
    value, standard_error
        A row for each place along the first coordinate.
    """

    coordinates: tuple[str, str]
    at: tuple[tuple[float, ...], tuple[float, ...]]
    value: tuple[tuple[float, ...], ...]
    standard_error: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class StatedFunction:
    """A part of the model of what has no name.

    Attributes
    ----------
    name, label, terms, parameters, evidence, equations, beside
        As of `StatedMechanism`.
    kind
        ``formula``: a sum of a few powers. ``curve``, ``surface``: a smooth function of one coordinate, or of
        two, as a sum of Gaussian bumps. ``mechanism``: one of the dictionary that is not certain enough for
        its name.
    outputs
        What is measured otherwise, for a fault of the sensor.
    coordinates
        What it depends on.
    curve
        Where it is a function of one coordinate, or a curve; a curve in two coordinates is the coefficient of
        the second.
    surface
        Where it is a surface.
    """

    name: str
    label: str
    kind: Literal["formula", "curve", "surface", "mechanism"]
    terms: Mapping[str, str]
    parameters: Mapping[str, Estimate]
    evidence: Evidence
    equations: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    coordinates: tuple[str, ...] = ()
    curve: DescribedCurve | None = None
    surface: DescribedSurface | None = None
    beside: tuple[str, ...] = ()


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


def as_it_is(errors: HeldOutErrors) -> str:
    """How well a simulation runs in which nothing is missing; empty where it is not known."""
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


def error_stays(errors: HeldOutErrors) -> str:
    """How far off a simulation remains to which nothing is added; empty where it is not known."""
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


def not_foreseen(errors: HeldOutErrors) -> str:
    """Which error random forces leave, that nobody can foresee; empty where it is not known."""
    if errors.noise_floor is None or errors.recalibrated is None:
        return ""
    return (
        "No simulation can foresee them, so that its error on held-out recordings remains"
        f" {_error(errors.recalibrated)} of their spread{_noise(errors)}."
    )


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
