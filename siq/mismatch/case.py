"""What is compared with what: a simulation, recordings and settings, checked against each other."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from siq.dynamics.cards import load_system
from siq.dynamics.dynamics import Dynamics
from siq.estimation.measurements import Measurements
from siq.mismatch.dictionary import Mechanism, dictionary_of
from siq.mismatch.study import (
    MismatchStudy,
    load_mismatch_study,
    measurements_of,
    split,
    with_known_noise,
)

if TYPE_CHECKING:
    import pandas as pd

    from siq.data.recordings import Recordings


@dataclass(frozen=True)
class Comparison:
    """What is compared with what.

    Attributes
    ----------
    system
        The simulation.
    learn, kept
        Recordings to learn from, and those held out.
    settings
        How to go about it.
    dictionary
        The mechanisms that may be named.
    """

    system: Dynamics
    learn: Measurements
    kept: Measurements
    settings: MismatchStudy
    dictionary: tuple[Mechanism, ...]


def comparison_of(
    system: Dynamics,
    recordings: Recordings | pd.DataFrame | str | Path,
    settings: MismatchStudy | None = None,
    *,
    file: str = "the settings",
) -> Comparison:
    """Check a simulation, recordings and settings against each other.

    Parameters
    ----------
    system
        The simulation. A state needs no domain; the recordings tell where it lies.
    recordings
        With a column for each output and each input.
    settings
        What is held out, what is known of the noise, and what counts as found.
    file
        What messages about the settings call them.

    Raises
    ------
    InputError
        For the first thing that cannot be used, with its file, place and remedy.
    """
    settings = MismatchStudy() if settings is None else settings
    data = with_known_noise(measurements_of(recordings, system), system, settings, file=file)
    learn, kept = split(data, settings, file=file)
    dictionary = dictionary_of(without=settings.without, further=settings.mechanisms, file=file)
    return Comparison(system, learn, kept, settings, dictionary)


def read_case(card: str | Path, recordings: str | Path, study: str | Path | None) -> Comparison:
    """Read and check the files of a case.

    Raises
    ------
    InputError
        For the first thing that cannot be used, with its file, place and remedy.
    """
    system = load_system(card)
    if study is None:
        return comparison_of(system, recordings)
    return comparison_of(system, recordings, load_mismatch_study(study), file=str(study))
