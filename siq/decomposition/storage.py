"""Networks and interrupted trainings as files: NumPy archives of plain arrays, never pickles."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from siq.decomposition.networks import Layer, Networks
from siq.decomposition.training import HISTORY, TrainingState
from siq.errors import InputError
from siq.files import whole_file


def save_networks(path: str | Path, networks: Networks) -> None:
    """Write networks whole or not at all."""
    _write(path, _pack(networks))


def load_networks(path: str | Path) -> Networks:
    """Read networks that `save_networks` wrote.

    Raises
    ------
    InputError
        When the file is missing or is no such archive.
    """
    try:
        return _unpack(_read(path))
    except KeyError:
        raise InputError(path, "", "it is not an archive of networks", "make it again") from None


def save_checkpoint(path: str | Path, state: TrainingState, *, fingerprint: str) -> None:
    """Write the state of a training, with a fingerprint of the data and options that it belongs to."""
    arrays = _pack(state.networks)
    for name, moments in (("first", state.first_moments), ("second", state.second_moments)):
        arrays |= {f"{name}{index}": tensor.numpy() for index, tensor in enumerate(moments)}
    arrays["step"] = np.array(state.step)
    arrays["history"] = state.history[list(HISTORY)].to_numpy(dtype=float)
    arrays["fingerprint"] = np.array(fingerprint)
    _write(path, arrays)


def load_checkpoint(path: str | Path, *, fingerprint: str) -> TrainingState | None:
    """Read the state of an interrupted training, or None where there is none that can be continued.

    A checkpoint of other data or options has another fingerprint and is passed over, and so is one that
    is damaged: training then starts afresh, which costs time but never a wrong result.
    """
    try:
        arrays = _read(path)
        if str(arrays["fingerprint"]) != fingerprint:
            return None
        networks = _unpack(arrays)
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


def _pack(networks: Networks) -> dict[str, np.ndarray]:
    arrays = {
        "sizes": np.array(json.dumps([len(networks.potential), len(networks.circulatory)])),
        "mean": networks.mean,
        "scale": networks.scale,
        "potential_scale": networks.potential_scale,
        "circulatory_scale": networks.circulatory_scale,
        "diffusion": networks.diffusion,
    }
    for name, layers in (("potential", networks.potential), ("circulatory", networks.circulatory)):
        for index, (weights, biases) in enumerate(layers):
            arrays[f"{name}_weights{index}"] = weights
            arrays[f"{name}_biases{index}"] = biases
    return {name: np.asarray(array) for name, array in arrays.items()}


def _unpack(arrays: dict[str, np.ndarray]) -> Networks:
    potential, circulatory = json.loads(str(arrays["sizes"]))

    def layers(name: str, count: int) -> tuple[Layer, ...]:
        return tuple(
            (
                torch.from_numpy(arrays[f"{name}_weights{index}"]),
                torch.from_numpy(arrays[f"{name}_biases{index}"]),
            )
            for index in range(count)
        )

    scales = ("mean", "scale", "potential_scale", "circulatory_scale", "diffusion")
    return Networks(
        potential=layers("potential", potential),
        circulatory=layers("circulatory", circulatory),
        **{name: torch.from_numpy(arrays[name]) for name in scales},
    )


def _write(path: str | Path, arrays: dict[str, np.ndarray]) -> None:
    with whole_file(path) as partial, partial.open("wb") as file:  # given a name, savez would add .npz
        np.savez(file, allow_pickle=False, **arrays)


def _read(path: str | Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, NotImplementedError, zipfile.BadZipFile):
        raise InputError(path, "", "it is not an archive of networks", "make it again") from None
