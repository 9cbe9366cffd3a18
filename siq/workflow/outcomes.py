"""Outcomes: what became of each step of each run, and how this is said in files."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from siq.numerics.files import whole_file

logger = logging.getLogger(__name__)


class Step(StrEnum):
    """The steps of a run, in the order of the table `outcomes`; a run either simulates or resamples."""

    SIMULATE = "simulate"
    RESAMPLE = "resample"
    IDENTIFY = "identify"
    TRAIN = "train"
    REGRESS = "regress"
    REFINE = "refine"
    SCORE = "score"
    LANDSCAPE = "landscape"


class Status(StrEnum):
    """How a step ended: a result, one with a reservation, none, or never begun as a step before failed."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"
    SKIPPED = "skipped"


class Method(StrEnum):
    """Whose formulas they are.

    ``regression`` is the published method, ``refined`` ours. ``randomised network`` is no method but the
    control, a network with its weights in random order, refined as the real one is: no other V than the
    refined one may come of it with a certificate.
    """

    REGRESSION = "regression"
    REFINED = "refined"
    CONTROL = "randomised network"


METHODS = (Method.REGRESSION, Method.REFINED)
"""The paper's formulas, and ours, in the order of the tables."""


@dataclass(frozen=True)
class Outcome:
    """What became of one step of one run.

    Attributes
    ----------
    run
        Its number.
    step, status
        Which step, and how it ended.
    reason
        Why it is not ``ok``, in words; of one that is, what has to be known of it.
    details
        What else the step says of itself, as plain data.
    """

    run: int
    step: Step
    status: Status = Status.OK
    reason: str = ""
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def usable(self) -> bool:
        """Whether the step left a result, be it with a reservation."""
        return self.status in (Status.OK, Status.WARNING)

    def as_data(self) -> dict[str, Any]:
        """As it stands in the file."""
        plain = {"run": self.run, "step": str(self.step), "status": str(self.status), "reason": self.reason}
        return plain | dict(self.details)


def outcome_of_data(data: Mapping[str, Any]) -> Outcome:
    """The outcome that `Outcome.as_data` gave."""
    details = {key: value for key, value in data.items() if key not in ("run", "step", "status", "reason")}
    return Outcome(int(data["run"]), Step(data["step"]), Status(data["status"]), data["reason"], details)


def why_no_landscape(outcomes: Iterable[Outcome]) -> str:
    """Why steps left no landscape: what the one said that came as far as any, without a full stop."""
    outcomes = [one for one in outcomes if one.reason]
    for status in (Status.FAILED, Status.WARNING, Status.SKIPPED):
        mine = [one for one in outcomes if one.status == status]
        for one in sorted(mine, key=lambda each: each.step != Step.LANDSCAPE):
            return one.reason.removeprefix("not certified: ").rstrip(".")
    return "the recorded states lead to no stable state"


def write_outcomes(path: str | Path, outcomes: Sequence[Outcome]) -> None:
    """Write outcomes whole or not at all, and log those that are not ``ok``."""
    for one in outcomes:
        if one.status != Status.OK:
            logger.warning("run %d, %s: %s, %s", one.run, one.step, one.status, one.reason)
    with whole_file(path) as partial:
        text = json.dumps([one.as_data() for one in outcomes], indent=1)
        partial.write_text(text + "\n", encoding="utf-8")


def read_outcomes(path: str | Path) -> list[Outcome]:
    """Read what `write_outcomes` wrote."""
    return [outcome_of_data(one) for one in json.loads(Path(path).read_text(encoding="utf-8"))]
