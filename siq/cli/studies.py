"""Which study belongs to a file of recordings: the shortest one, and one with comments to begin from."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

from siq.data.inspection import Inspection, inspect_recordings
from siq.data.recordings import read_recordings
from siq.errors import InputError
from siq.numerics.files import whole_file
from siq.version import DISTRIBUTION

GENERATED = Path(".snakemake", "siq")
"""Where studies lie that were written for a file of recordings: no result, and of use to nobody else."""


def is_study(path: Path) -> bool:
    """Whether a file is a study, and no recordings."""
    return path.suffix.lower() in (".yaml", ".yml")


def name_for(path: Path) -> str:
    """A name for the results of a file or folder of recordings: its own, without what no name may have."""
    resolved = path.resolve()
    stem = resolved.name if resolved.is_dir() else resolved.stem
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", stem).strip("-.") or "recordings"


def own_path(path: Path, *, start: Path | None = None) -> str:
    """A path as one writes it in a folder: relative where both lie on one drive."""
    try:
        return Path(os.path.relpath(path, start or Path.cwd())).as_posix()
    except ValueError:  # another drive
        return path.resolve().as_posix()


def write_generated(path: Path, name: str) -> Path:
    """Write the shortest study for recordings, once they have been read.

    Parameters
    ----------
    path
        A file of recordings, or a folder of files.
    name
        Of the study.

    Returns
    -------
    pathlib.Path
        The study.

    Raises
    ------
    InputError
        When the recordings cannot be used.
    """
    read_recordings(path)  # before anything starts or is written
    study = GENERATED / f"{name}.yaml"
    text = f"name: {_scalar(name)}\nrecordings: {{file: {_scalar(own_path(path, start=study.parent))}}}\n"
    with whole_file(study) as partial:
        partial.write_text(text, encoding="utf-8")
    return study


def init_study(path: Path, *, output: Path | None = None, replace: bool = False) -> Path:
    """Write a study with comments for a file of recordings.

    Parameters
    ----------
    path
        A file of recordings, or a folder of files.
    output
        Where to write it; by default named as the recordings, in the folder in which you are.
    replace
        Whether a file that is there may be replaced.

    Returns
    -------
    pathlib.Path
        The study.

    Raises
    ------
    InputError
        When the recordings cannot be used, or the study is there already.
    """
    if is_study(path):
        raise InputError(path, "", "this is a study already", f"run it by: siq run {path}")
    found = inspect_recordings(path)
    study = Path(f"{name_for(path)}.yaml") if output is None else output
    if study.exists() and not replace:
        raise InputError(
            study, "", "the file is there already", "name another by -o, or replace it by --force"
        )
    with whole_file(study) as partial:
        partial.write_text(commented_study(found, path, study), encoding="utf-8")
    return study


def commented_study(found: Inspection, path: Path, study: Path) -> str:
    """The text of a study that runs as it is; what is commented out can be used by taking the # away."""
    states = [state.name for state in found.states]
    unit = found.recordings.time_unit or "in the unit of t"
    step = f"{1.5 * found.steps.usual:.3g}" if found.steps is not None else "0.01"
    units = {state.unit for state in found.states}
    diffusion = ", ".join("1.0" for _ in states)
    looked_at = "".join(f"# {line}".rstrip() + "\n" for line in found.text().splitlines())
    needed = (
        "\n  # Your states have different units: where no random forces are seen, D has to be given."
        if len(units) > 1
        else ""
    )
    return f"""\
# A study: what siq is to answer, from which recordings. Run it by: siq run {own_path(study)}
# Relative paths start from the folder of this file. What is left out takes its default.
#
{looked_at}
name: {_scalar(name_for(path))}                # names the folder of the results
title: {_scalar("Landscape of " + name_for(path))}      # what the page is headed

recordings:
  file: {_scalar(own_path(path, start=study.resolve().parent))}
  # The columns to use, in this order; by default all of them.
  # states: [{", ".join(states)}]
  # Samples further apart than this ({unit}) are no neighbours; by default 1.5 usual steps.
  # pair_step: {step}
  # How noise acts on the states: D, one number for each state, or a matrix. By default it is estimated from
  # the noise in the recordings, or taken as one for each state where they show none.{needed}
  # diffusion: [{diffusion}]

# More runs, each on recordings drawn anew from yours, show how far the answer depends on the sample.
# runs: 5
# seed: 0

# Formulas of a higher degree than what is tried by default, where the page says that none is certified.
# refinement: {{formula_degree: 6}}

# Only the formula, no wells, barriers and paths:
# landscape: false

# The published method with two networks, beside ours; needs pip install '{DISTRIBUTION}[networks]'.
# training: {{}}
"""


def _scalar(text: str) -> str:
    """A text as YAML writes it: plain where that is safe, otherwise in quotes."""
    plain = re.fullmatch(r"[A-Za-z./_][\w./ -]*", text, flags=re.ASCII) and text == text.strip()
    words = {"true", "false", "null", "yes", "no", "on", "off", "y", "n", "~"}
    return text if plain and text.lower() not in words else json.dumps(text, ensure_ascii=False)
