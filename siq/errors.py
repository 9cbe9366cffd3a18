"""What is said when a file from outside cannot be used."""

from __future__ import annotations

from pathlib import Path


class InputError(ValueError):
    """A fault in a card, a study or a recordings file, told in one sentence.

    The sentence names the file, the place in it, what is wrong and what to do about it, so that an
    experimentalist can mend the file without reading any code. Faults of `siq` itself are never
    reported this way.

    Parameters
    ----------
    file
        The file at fault, as the user named it.
    place
        Where in the file: ``"line 12 (equations.x)"``, ``"row 7, column y"``; empty for the whole file.
    fault
        What is wrong, in lower case and without a full stop.
    remedy
        What to do, in lower case and without a full stop.
    """

    def __init__(self, file: str | Path, place: str, fault: str, remedy: str) -> None:
        where = f"{file}, {place}" if place else f"{file}"
        super().__init__(f"{where}: {fault}; {remedy}.")
        self.file = str(file)
        self.place = place
        self.fault = fault
        self.remedy = remedy


class NumericalFailure(ArithmeticError):
    """A computation that ended without a result, such as a training whose loss is not finite.

    Not the user's file but the numbers are at fault; the message says what happened. A run that fails so
    is kept in every table as failed. Compare `InputError`.
    """
