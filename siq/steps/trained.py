"""The networks of one run, as the steps after the training take them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from siq.networks.trained import TrainedNetworks, load_networks
from siq.steps.outcomes import Outcome, Status, Step, read_outcomes

POSITION = "position"
"""In the details of an outcome: where the run stands among the networks of its block."""


@dataclass(frozen=True)
class TrainedRun:
    """The networks of a run, None where its training left none, and why."""

    networks: TrainedNetworks | None
    outcome: Outcome

    @property
    def missing(self) -> str:
        """Why there are no networks, in words."""
        return f"the training gave no networks ({self.outcome.reason})"


def not_trained(number: int) -> TrainedRun:
    """A run for which no networks were asked."""
    return TrainedRun(None, Outcome(number, Step.TRAIN, Status.SKIPPED, "no networks were asked for"))


def read_trained(networks: str | Path | None, outcome: str | Path | None, *, number: int) -> TrainedRun:
    """The networks of run `number` from those of its block; no files where no networks were asked for."""
    if networks is None or outcome is None:
        return not_trained(number)
    mine = next(one for one in read_outcomes(outcome) if one.run == number)
    if not mine.usable:
        return TrainedRun(None, mine)
    return TrainedRun(load_networks(networks, run=mine.details[POSITION]), mine)
