"""What does the certificate promise, in plain words, and which tests did it make?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd

from siq.numerics.number_text import number_text
from siq.report.page import Badge
from siq.steps.outcomes import Method

TESTS = {
    "identity": "the formulas add up to the identified f",
    "hamilton_jacobi": "U solves its equation at points that were held out",
    "branch": "U has the right curvature at every stable state",
    "descent": "U falls along recordings that were held out",
    "error": "the error that remains is small enough to be stated",
    "existence": "stable states and saddles exist, whatever f its uncertainty allows for",
    "characteristics": "an independent calculation, along characteristics of f, gives the same U",
    "agreement": "two routes to U lead to the same one",
    "prediction": "f predicts recordings that were held out",
    "record": "the record hops, and is spread, as f and D say",
    "same_as_refined": "it is the same U as the one above",
}
"""What each test asks, as a reader is told."""

FAILURES = {
    "identity": "the formulas do not add up to the identified f",
    "hamilton_jacobi": "U does not solve its equation at points that were held out",
    "branch": "U does not have the curvature at the stable states that f asks for",
    "descent": "U does not fall along recordings that were held out",
    "error": "the error that remains is too large to be stated",
    "existence": "the recordings do not tell whether all stable states and saddles exist",
    "characteristics": "an independent calculation, along characteristics of f, gives another U",
    "agreement": "two routes to U lead to different ones",
    "prediction": "f does not predict recordings that were held out",
    "record": "the record hops, or is spread, otherwise than f and D say",
}
"""The same where the answer is no."""

PERCENT = 1e-4  # a smaller share is written with a power of ten


def share_text(share: float) -> str:
    """A relative error: ``3.7 %``, ``4.2 × 10⁻⁶``.

    Examples
    --------
    >>> share_text(0.0371)
    '3.7 %'
    """
    if share < PERCENT:
        return number_text(share, decimals=1)
    percent = 100 * share
    return f"{percent:.2g} %" if percent < 99.5 else f"{percent:.0f} %"


def certificate_badge(
    certificate: Mapping[str, Any] | None,
    *,
    certified: int,
    runs: int,
    refusals: Mapping[str, str],
    given: bool = False,
) -> Badge:
    """The badge of a study.

    Parameters
    ----------
    certificate
        That of the formulas that are shown, as in `model.json`; None where there is no formula.
    certified, runs
        How many runs are certified, of how many.
    refusals
        Why the others are not, by test.
    given
        Whether f was given as equations.
    """
    if certificate is None:
        return Badge("no formula", False, ["There is nothing that a certificate could be given for."])
    made = len(certificate.get("tests", {}))
    if not certificate["certified"]:
        return Badge("not certified", False, _refused(certificate, certified, runs, refusals, given))
    error = certificate["stated_error"]
    within = "" if error is None else f" to within {share_text(error)} of its height"
    promise = [
        f"All {made} tests passed. One of them computes U once more, by a method that shares nothing with the"
        f" fit but f, and finds the same{within}.",
        "This does not promise anything outside the domain, nor that these equations are those of nature."
        if given
        else "This does not promise anything outside the recorded region, nor that all states that matter"
        " were recorded.",
    ]
    if runs > 1:
        promise.append(f"{certified} of {runs} runs are certified.")
    return Badge("certified", True, promise)


def _refused(
    certificate: Mapping[str, Any], certified: int, runs: int, refusals: Mapping[str, str], given: bool
) -> list[str]:
    failed = [name for name, test in certificate.get("tests", {}).items() if not test["passed"]]
    lines = []
    if failed:
        told = "; ".join(FAILURES.get(name, name.replace("_", " ")) for name in failed)
        lines.append(f"{told[0].upper()}{told[1:]}.")
    elif reason := str(certificate.get("reason") or "; ".join(refusals.values())):
        lines.append(f"{reason[0].upper()}{reason[1:]}.".replace("..", "."))
    tests = certificate.get("tests", {})
    if given or tests.get("prediction", {}).get("passed"):
        lines.append(
            "Positions, depths and times above follow from f, along its most likely ways out. It is U as a"
            " formula"
            " that failed."
        )
    lines.append(
        "Do not rely on the formula before you have checked it in another way."
        if given
        else "A formula that fails a test may belong to another landscape that fits the recordings just as"
        " well. Do not"
        " rely on it before you have checked it in another way."
    )
    if runs > 1:
        lines.append(f"{certified} of {runs} runs are certified.")
    return lines


def certificate_line(certificate: Mapping[str, Any] | None) -> str:
    """The certificate in one sentence, for text."""
    if certificate is None:
        return "No test was made of these formulas."
    if certificate["certified"]:
        error = certificate["stated_error"]
        return "The formulas are certified" + (
            "." if error is None else f": U is right to within {share_text(error)} of its height."
        )
    return f"The formulas are not certified: {certificate['reason']}."


def tests_table(certificates: pd.DataFrame, run: int, method: Method) -> pd.DataFrame:
    """The tests of the formulas that are shown: what was asked, the figure, its limit, the verdict."""
    mine = certificates[(certificates["run"] == run) & (certificates["method"] == method)]
    return pd.DataFrame(
        {
            "test": [str(name).replace("_", " ") for name in mine["test"]],
            "what it asks": [TESTS.get(str(name), "") for name in mine["test"]],
            "found": mine["value"].to_numpy(),
            "limit": mine["limit"].to_numpy(),
            "passed": mine["passed"].to_numpy(),
            "reason": mine["reason"].to_numpy(),
        }
    )
