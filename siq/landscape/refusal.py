"""Why is there no landscape, and what is known all the same?"""

from __future__ import annotations

from siq.data.record_states import RecordStates
from siq.dynamics.dynamics import Dynamics
from siq.errors import NumericalFailure


class NoLandscape(NumericalFailure):
    """Recordings that no landscape was found of; what they show by themselves is kept.

    The message says why, what would make it an answer, and what is known all the same.

    Parameters
    ----------
    reason
        Why there is none and what to do about it, without a full stop.
    states
        The two states between which the recordings hop by themselves; None where nothing is known of that.
    dynamics
        f and D, where these were identified and only their landscape is missing.
    """

    def __init__(
        self, reason: str, states: RecordStates | None = None, dynamics: Dynamics | None = None
    ) -> None:
        super().__init__(" ".join(told_without_landscape(reason, states)))
        self.reason = reason
        self.states = states
        self.dynamics = dynamics


def told_without_landscape(reason: str, states: RecordStates | None) -> list[str]:
    """The sentences that stand where a landscape would: what is known without one, and why there is none."""
    seen = "" if states is None else states.sentence()
    missing = f"{'But no' if seen else 'No'} landscape was found: {reason}."
    return [seen, missing] if seen else [missing]
