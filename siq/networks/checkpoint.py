"""Interrupted trainings as files, which a killed job goes on from: NumPy archives, never pickles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from siq.errors import InputError, needs_extra
from siq.networks.networks import at_rest, side_by_side
from siq.networks.trained import pack, read_archive, unpack, write_archive
from siq.networks.training import HISTORY, TrainingState

with needs_extra("networks"):
    import torch


def save_checkpoint(path: str | Path, state: TrainingState, *, fingerprint: str) -> None:
    """Write the state of a training, with a fingerprint of the data and options that it belongs to."""
    arrays = pack([at_rest(state.networks, run) for run in range(state.networks.runs)])
    for name, moments in (("first", state.first_moments), ("second", state.second_moments)):
        arrays |= {f"{name}{index}": tensor.numpy() for index, tensor in enumerate(moments)}
    arrays["step"] = np.array(state.step)
    arrays["history"] = state.history[list(HISTORY)].to_numpy(dtype=float)
    arrays["fingerprint"] = np.array(fingerprint)
    write_archive(path, arrays)


def load_checkpoint(path: str | Path, *, fingerprint: str) -> TrainingState | None:
    """Read the state of an interrupted training, or None where there is none that can be continued.

    A checkpoint of other data or options has another fingerprint and is passed over, and so is one that
    is damaged: training then starts afresh, which costs time but never a wrong result.
    """
    try:
        arrays = read_archive(path)
        if str(arrays["fingerprint"]) != fingerprint:
            return None
        networks = side_by_side([unpack(arrays, run) for run in range(len(arrays["mean"]))])
        count = len(networks.parameters())
        history = pd.DataFrame(arrays["history"], columns=list(HISTORY))
        return TrainingState(
            step=int(arrays["step"]),
            networks=networks,
            first_moments=tuple(torch.from_numpy(arrays[f"first{index}"]) for index in range(count)),
            second_moments=tuple(torch.from_numpy(arrays[f"second{index}"]) for index in range(count)),
            history=history.astype({"run": "int64", "step": "int64"}),
        )
    except (InputError, KeyError, ValueError):
        return None
