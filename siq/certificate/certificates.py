"""What does a certificate say, and when does it certify?

No formula is certified without a test that shares nothing with its fit but f: `INDEPENDENT` names those.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from siq.certificate.tests import Verdict

INDEPENDENT = ("characteristics",)  # tests of V that share nothing with a fit of V but f and D


@dataclass(frozen=True)
class Certificate:
    """Whether a method's formulas may be believed, and why.

    Attributes
    ----------
    tests
        By name.
    error
        Relative error of V that has to be stated; infinite where unknown.
    reason
        What refused it, or what to know of it, in words.
    scope
        ``region``: one formula for the recorded region; ``wells``: one for each attractor.
    tested_on
        The points, in words.
    """

    tests: Mapping[str, Verdict]
    error: float
    reason: str
    scope: str = "region"
    tested_on: str = ""

    @property
    def independent(self) -> tuple[str, ...]:
        """The tests made that share nothing with the fit of V but f and D."""
        return tuple(name for name in INDEPENDENT if name in self.tests)

    @property
    def certified(self) -> bool:
        """Whether every test passed, one of them an independent one."""
        return bool(self.independent) and all(verdict.passed for verdict in self.tests.values())

    def as_data(self) -> dict[str, Any]:
        """As it stands in model.json."""
        return {
            "certified": self.certified,
            "scope": self.scope,
            "stated_error": float(self.error) if np.isfinite(self.error) else None,
            "reason": self.reason,
            "tested_on": self.tested_on,
            "independent": list(self.independent),
            "tests": {name: verdict.as_data() for name, verdict in self.tests.items()},
        }


def uncertified(reason: str) -> dict[str, Any]:
    """The certificate of formulas that could not be tested."""
    return {"certified": False, "scope": "region", "stated_error": None, "reason": reason, "tests": {}}


def position_text(position: np.ndarray) -> str:
    """A state as it stands in the reasons of a certificate."""
    return np.array2string(position, precision=4, suppress_small=True, separator=", ")
