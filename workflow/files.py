"""Files of results: how each is read and written, by the name that rules have for it.

What has nothing to say is None, and an empty file. Every file is whole or not there at all.

=======================================  =====================================================================
``recordings``                           trajectories, Parquet
``field``                                the identified f, `siq.inference.field_estimate.FieldEstimate`
``model``, ``regression``                formulas and certificates by method
``networks``                             networks of a block of runs, by position
``quasipotential``                       a landscape
``card``, ``system``, ``recalibrated``   a system
``published``, ``reference``             published figures; a reference landscape
``..._outcome``                          outcomes of steps
tables                                   Parquet, with a CSV beside it
others                                   JSON, text, or a folder of figures and files by name
=======================================  =====================================================================
"""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from siq.errors import InputError
from siq.numerics.files import whole_file
from siq.workflow.tables import Outcome, Status

if TYPE_CHECKING:
    from siq.data.recordings import Recordings
    from siq.networks.decomposition import AnyNetworks
    from siq.workflow.study import PipelineSettings


LOGGER = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class _StoredNetworks:
    """The networks of a block by their position; each is read when it is asked for."""

    path: Path

    def __getitem__(self, position: int) -> AnyNetworks:
        from siq.networks.decomposition import load_networks

        return load_networks(self.path, run=position)


def read(name: str, path: str | Path) -> Any:
    """Read a file by its name, None where it is empty.

    Raises
    ------
    InputError
        When the file is not what its name says.
    """
    path = Path(path)
    if path.is_file() and not path.stat().st_size:
        return None
    if name == "recordings":
        from siq.data.recordings import read_recordings

        return read_recordings(path)
    if name == "field":
        from siq.inference.field_estimate import read_field

        return read_field(path)
    if name in ("model", "regression"):
        from siq.quasipotential.formulas import read_model

        return read_model(path)
    if name == "networks":
        return _StoredNetworks(path)
    if name in ("card", "system", "recalibrated"):
        from siq.systems.cards import load_system

        return load_system(path)
    if name == "published":
        from workflow.published import load_published

        return load_published(path)
    if name == "reference":
        from siq.quasipotential.landscape_comparison import ReferenceLandscape

        return ReferenceLandscape.read(path)
    if path.suffix == ".parquet":
        return read_table(path)
    try:
        if name.endswith("_outcome"):
            return read_outcomes(path)
        text = path.read_text(encoding="utf-8")
        return json.loads(text) if path.suffix == ".json" else text
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise InputError(path, "", "it is not a result as it was written", "make it again") from None


def read_states(path: str | Path, field: str | Path) -> Recordings | None:
    """Trajectories of a run, with velocities that were not recorded as its identified f has them."""
    from siq.inference.kalman_identification import of_all_states

    recordings, record = read("recordings", path), read("field", field)
    if recordings is None or record is None:
        return recordings
    return of_all_states(recordings, record, pair_step=None)


def write(name: str, path: str | Path, value: Any, settings: PipelineSettings) -> None:
    """Write a result by its name.

    Parameters
    ----------
    name, path
        Of the file, or of a folder.
    value
        What `read` gives back; of ``quasipotential`` the landscape; of a folder its files.
    settings
        Of the task.
    """
    path = Path(path)
    if value is None:
        path.touch()
    elif name == "recordings":
        from siq.data.recordings import write_recordings

        write_recordings(path, value)
    elif name == "field":
        from siq.inference.field_estimate import write_field

        write_field(path, value, settings.identification)
    elif name in ("model", "regression"):
        from siq.quasipotential.formulas import write_model

        write_model(path, *({str(key): one for key, one in part.items()} for part in value))
    elif name == "networks":
        from siq.networks.decomposition import save_networks

        save_networks(path, list(value))
    elif name == "quasipotential":
        from siq.quasipotential.landscape_files import write_landscape

        write_landscape(path, value)
    elif name == "reference":
        value.write(path)
    elif name.endswith("_outcome"):
        write_outcomes(path, value)
    elif isinstance(value, pd.DataFrame):
        write_table(path, value)
    elif not path.suffix:
        _write_folder(path, value)
    else:
        with whole_file(path) as partial:
            if dataclasses.is_dataclass(value) and not isinstance(value, type):
                from pydantic import TypeAdapter

                partial.write_bytes(TypeAdapter(type(value)).dump_json(value, indent=1))
            elif isinstance(value, str):
                partial.write_text(value, encoding="utf-8")
            else:
                indent = None if name == "overview" else 1
                text = json.dumps(value, indent=indent, ensure_ascii=False, allow_nan=False)
                partial.write_text(text + "\n", encoding="utf-8")


def _write_folder(folder: Path, files: Mapping[str, Any]) -> None:
    """Figures by their names, as SVG and PNG; text and bytes by names of files; what is None is left out."""
    from siq.report.plots.style import save_figure

    folder.mkdir(parents=True, exist_ok=True)
    for name, value in files.items():
        if isinstance(value, str):
            (folder / name).write_text(value, encoding="utf-8")
        elif isinstance(value, bytes):
            (folder / name).write_bytes(value)
        elif value is not None:
            save_figure(value, folder / name)


def write_outcomes(path: str | Path, outcomes: Sequence[Outcome]) -> None:
    """Write outcomes whole or not at all, and log those that are not ``ok``."""
    for one in outcomes:
        if one.status != Status.OK:
            LOGGER.warning("run %d, %s: %s, %s", one.run, one.step, one.status, one.reason)
    with whole_file(path) as partial:
        text = json.dumps([one.as_data() for one in outcomes], indent=1)
        partial.write_text(text + "\n", encoding="utf-8")


def read_outcomes(path: str | Path) -> list[Outcome]:
    """Read what `write_outcomes` wrote."""
    return [Outcome.from_data(one) for one in json.loads(Path(path).read_text(encoding="utf-8"))]


def write_table(path: str | Path, table: pd.DataFrame) -> None:
    """Write a table as Parquet to `path`, and as CSV with all digits beside it."""
    path = Path(path)
    with whole_file(path.with_suffix(".csv")) as partial:
        table.to_csv(partial, index=False)
    with whole_file(path) as partial:
        table.to_parquet(partial, index=False)


def read_table(path: str | Path) -> pd.DataFrame:
    """Read a table that `write_table` wrote; InputError when the file is missing or is not Parquet."""
    try:
        return pd.read_parquet(path)
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(path, "", "it is not a Parquet table", "make it again") from None
