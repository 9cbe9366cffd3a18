"""Errors: a value or a file that cannot be used, a computation without a result, a missing package.

And the version, for people who tell of one.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

DISTRIBUTION = "quasipotential"  # what pip installs; the name `siq` is another project's there
LONGEST_FAULT = 1000  # letters: some messages list all names that could be meant


class Fault(ValueError):
    """A value that cannot be used, told by code that does not know which file it came from.

    Whoever knows the file makes an `InputError` of it: ``raise error.at(file, place) from None``.

    Parameters
    ----------
    fault
        What is wrong, in lower case and without a full stop.
    remedy
        What to do, in lower case and without a full stop.
    """

    def __init__(self, fault: str, remedy: str) -> None:
        super().__init__(f"{fault}; {remedy}")
        self.fault = fault
        self.remedy = remedy

    def at(self, file: str | Path, place: str = "") -> InputError:
        """An `InputError` of the fault, with the file and the place in it."""
        return InputError(file, place, self.fault, self.remedy)


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
        # What a file says may have lines, or no end.
        told = " ".join(fault.split())
        told = told if len(told) <= LONGEST_FAULT else f"{told[: LONGEST_FAULT - 1]}…"
        super().__init__(f"{where}: {told}; {remedy}.")
        self.file = str(file)
        self.place = place
        self.fault = fault
        self.remedy = remedy


class NumericalFailure(ArithmeticError):
    """A computation that ended without a result, such as a training whose loss is not finite.

    Not the user's file but the numbers are at fault; the message says what happened. A run that fails so
    is kept in every table as failed. Compare `InputError`.

    Parameters
    ----------
    claim
        Which claim on the recordings fails, by its name in a certificate, where that is the reason.
    """

    def __init__(self, *told: object, claim: str = "") -> None:
        super().__init__(*told)
        self.claim = claim


class MissingExtra(ImportError):
    """A package that only a part of `siq` needs is not installed.

    The message names it, and what to install.

    Parameters
    ----------
    extra
        The group of optional packages, as in pyproject.toml: ``"networks"``, ``"plots"``, ``"workflow"``.
    package
        The one that is missing.
    """

    def __init__(self, extra: str, package: str) -> None:
        super().__init__(
            f"'{package}' is not installed; install it by: pip install '{DISTRIBUTION}[{extra}]'.",
            name=package,
        )
        self.extra = extra


def suggestion(name: str, known: Iterable[str], *, otherwise: str) -> str:
    """The remedy for an unknown name: the known one that is most like it, or what to do instead.

    Parameters
    ----------
    name
        As the user wrote it.
    known
        What it could have been.
    otherwise
        The remedy where none of these is like it.

    Examples
    --------
    >>> suggestion("zetta", ["zeta", "gamma"], otherwise="declare it")
    "perhaps you meant 'zeta'"
    """
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"perhaps you meant '{near[0]}'" if near else otherwise


@contextmanager
def needs_extra(extra: str) -> Iterator[None]:
    """Say which extra is missing when an import within the block fails.

    Parameters
    ----------
    extra
        The group of optional packages, as in pyproject.toml.

    Raises
    ------
    MissingExtra
        When a package cannot be found. One of `siq` itself is no extra: that error goes through.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "siq"):
            raise
        raise MissingExtra(extra, package) from None


def version() -> str:
    """The version in pyproject.toml: of the checkout that this file lies in, else of the installation."""
    checkout = Path(__file__).parents[1] / "pyproject.toml"
    if checkout.is_file():
        import tomllib  # here, so that `siq --help` answers at once

        project = tomllib.loads(checkout.read_text(encoding="utf-8")).get("project", {})
        if project.get("name") == DISTRIBUTION:
            return str(project["version"])
    from importlib.metadata import version as installed

    return installed(DISTRIBUTION)
