"""What is said of the error on recordings held out, whichever way it went?"""

from __future__ import annotations

from siq.mismatch.held_out_errors import HeldOutErrors, Run
from siq.numerics.number_text import LARGEST_PLAIN_NUMBER, number_text


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
