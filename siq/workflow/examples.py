"""Studies that ``siq`` writes: the shortest for recordings, one with comments, and examples to try."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from siq.data.inspection import Inspection, inspect as inspect_recordings
from siq.data.preparation import ANGLES, unusual
from siq.data.recordings import read_recordings
from siq.errors import DISTRIBUTION, Fault, InputError
from siq.numerics.files import whole_file
from siq.systems.cards import check_title

STUDIES = (".yaml", ".yml")  # what files end in that are studies, and no recordings
GENERATED = Path(".snakemake", "siq")
"""Where studies lie that were written for a file of recordings: neither results nor of use elsewhere."""


def name_for(path: Path) -> str:
    """A name for the results of a file or folder of recordings: its own, without what no name may have."""
    resolved = path.resolve()
    stem = resolved.name if resolved.is_dir() else resolved.stem
    name = re.sub(r"[^A-Za-z0-9_.-]+", "-", stem).strip("-._") or "recordings"
    try:
        return check_title(name)
    except Fault:  # too long: what it begins with, and what tells it from others
        return f"{name[:10]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def _own_path(path: Path, *, start: Path | None = None) -> str:
    """A path as one writes it in a folder: relative where both lie on one drive."""
    try:
        return Path(os.path.relpath(path, start or Path.cwd())).as_posix()
    except ValueError:  # another drive
        return path.resolve().as_posix()


def write_generated(path: Path, name: str) -> tuple[Path, str]:
    """Write the shortest study for a file of recordings, or a folder of files, once they have been read.

    Returned are the study, and the path of the recordings as one writes it in the folder in which one is.
    """
    found = unusual(read_recordings(path))  # before anything starts or is written
    study = GENERATED / f"{name}.yaml"
    text = f"name: {_scalar(name)}\nrecordings: {{file: {_scalar(_own_path(path, start=study.parent))}}}\n"
    turns = [one.values for one in found if one.code in ANGLES and not one.values.get("wide")]
    if turns:
        angles = ", ".join(f"{one['name']}: [0, {str(one['turn']).replace('2π', '2*pi')}]" for one in turns)
        text += f"identification: {{angles: {{{angles}}}}}\n"
    _write({study: text}, replace=True, remedy="")
    return study, _own_path(path)


def init_study(path: Path, *, output: Path | None = None, replace: bool = False) -> Path:
    """Write a study with comments for a file of recordings, or a folder of files.

    By default it is named as the recordings, in the folder in which you are. Fails with `InputError` when the
    recordings cannot be used, or the study is there already and is not to be replaced.
    """
    if path.suffix.lower() in STUDIES:
        raise InputError(path, "", "this is a study already", f"run it by: siq run {path}")
    found = inspect_recordings(path)
    study = Path(f"{name_for(path)}.yaml") if output is None else output
    text = _commented_study(found, path, study)
    _write({study: text}, replace=replace, remedy="name another by -o, or replace it by --force")
    return study


def _commented_study(found: Inspection, path: Path, study: Path) -> str:
    """The text of a study that runs as it is; what is commented out can be used by taking the # away."""
    states = [state.name for state in found.states]
    unit = found.recordings.time_unit or "in the unit of t"
    step = f"{1.5 * found.steps.usual:.3g}" if found.steps is not None else "0.01"
    units = {state.unit for state in found.states}
    diffusion = ", ".join("1.0" for _ in states)
    looked_at = "".join(f"# {line}".rstrip() + "\n" for line in found.text().splitlines())
    needed = (
        "\n  # Your states have different units: where no process noise is seen, D has to be given."
        if len(units) > 1
        else ""
    )
    return _text("commented").format(
        study=_own_path(study), looked_at=looked_at, name=_scalar(name_for(path)),
        title=_scalar("Landscape of " + name_for(path)), unit=unit, step=step, needed=needed,
        file=_scalar(_own_path(path, start=study.resolve().parent)), states=", ".join(states),
        diffusion=diffusion, distribution=DISTRIBUTION,
    )  # fmt: skip


def _text(name: str) -> str:
    """One of the studies that are written, as it stands in the folder beside this module."""
    return next(Path(__file__).with_name("studies").glob(f"{name}.*")).read_text(encoding="utf-8")


def _scalar(text: str) -> str:
    """A text as YAML writes it: plain where that is safe, otherwise in quotes."""
    plain = re.fullmatch(r"[A-Za-z./_][\w./ -]*", text, flags=re.ASCII) and text == text.strip()
    words = {"true", "false", "null", "yes", "no", "on", "off", "y", "n", "~"}
    return text if plain and text.lower() not in words else json.dumps(text, ensure_ascii=False)


def write_example(name: str, folder: Path, *, replace: bool = False) -> tuple[list[Path], str]:
    """Write the example ``double-well`` or ``mismatch`` into a folder: its files, and what to try with them.

    When a file is there already and is not to be replaced, this is an `InputError`, and none is written.
    """
    if name == "double-well":
        study = folder / "double-well.yaml"
        files = {folder / "double-well.csv": double_well_recordings(), study: _text("double-well")}
        command = f"siq run {study}"
    else:
        case = folder / "spring"
        files = {case / "recordings.csv": _spring_recordings(), case / "system.yaml": _text("spring")}
        command = f"siq diagnose {case}"
    _write(files, replace=replace, remedy="name another --folder, or give --force")
    return list(files), command


def _write(files: Mapping[Path, str], *, replace: bool, remedy: str) -> None:
    """Write texts, or none of them where one is there already and may not be replaced."""
    for file in files:
        if file.exists() and not replace:
            raise InputError(file, "", "the file is there already", remedy)
    for file, text in files.items():
        with whole_file(file) as partial:
            partial.write_text(text, encoding="utf-8")


def double_well_recordings(recordings: int = 4, samples: int = 20_000, *, seed: int = 1) -> str:
    """Recordings of a bead in two traps as a CSV file, with the noise of a camera.

    Ten steps of the simulation lead to each sample.
    """
    generator, step, within, strength, camera = np.random.default_rng(seed), 0.0025, 10, 0.3, 0.01
    inner = step / within
    x = generator.choice([-0.5, 0.5], recordings)
    recorded = np.empty((samples, recordings))
    for sample in range(samples):
        recorded[sample] = x
        for push in generator.normal(scale=np.sqrt(strength * inner), size=(within, recordings)):
            x = x + inner * (8 * x - 32 * x**3) + push
    recorded += generator.normal(scale=camera, size=recorded.shape)
    t = np.arange(samples) * step
    return _csv(
        "recording,t [s],x [um]", [(f"trace-{k + 1}", t, recorded[:, k : k + 1]) for k in range(recordings)]
    )


def _spring_recordings(recordings: int = 8, samples: int = 120, *, seed: int = 3) -> str:
    """Recordings of a spring that hardens as a CSV file, with the noise of a sensor."""
    generator, step, within = np.random.default_rng(seed), 0.1, 50
    parts = []
    for number in range(recordings):
        x, v = generator.uniform(-1.5, 1.5, 2)
        rows = np.empty((samples, 2))
        for sample in range(samples):
            rows[sample] = (x, v)
            for _ in range(within):
                v += step / within * (-x - 0.2 * v - 0.8 * x**3)
                x += step / within * v
        rows += generator.normal(scale=0.01, size=rows.shape)
        parts.append((f"release-{number + 1}", np.arange(samples) * step, rows))
    return _csv("recording,t [s],x [mm],v [mm/s]", parts)


def _csv(header: str, parts: list[tuple[str, np.ndarray, np.ndarray]]) -> str:
    text = io.StringIO()
    text.write(header + "\n")
    for label, t, values in parts:
        row = ",".join([label, "%.6g", *["%.6f"] * values.shape[1]])
        np.savetxt(text, np.column_stack([t, values]), fmt=row)
    return text.getvalue()
