"""Which numbers did somebody publish, to be set beside ours? They are never an input of any method."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from siq.files.documents import read_document, validate


class PublishedFigure(BaseModel):
    """A number that somebody published, to be set beside ours; it is never an input of any method.

    Attributes
    ----------
    mean, standard_deviation
        As published.
    rounding
        Half a unit of the last digit that was printed, where that matters.
    source
        Where it stands, and how many runs it is of.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    mean: float
    standard_deviation: float | None = None
    rounding: Annotated[float, Field(ge=0)] = 0.0
    source: str


class PublishedMesh(BaseModel):
    """U of two states on the nodes of a rectangular mesh that somebody published.

    Attributes
    ----------
    file
        A MATLAB file with one matrix, the first state along its rows; sought in ``SIQ_RESOURCES``.
    box
        The first and the last node along each state.
    times
        U is so many times what the file holds, up to a constant.
    source
        Where it was published.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    file: str
    box: tuple[tuple[float, float], tuple[float, float]]
    times: float = 1.0
    source: str


class PublishedFigures(BaseModel):
    """Published figures by the quantity that they are of: ``rrmse``, ``U:x**2``, ``network_error``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str
    figures: dict[str, PublishedFigure]
    mesh: PublishedMesh | None = None


def load_published(path: str | Path) -> PublishedFigures:
    """Read and check a file of published figures; raises `InputError` as `load_study` does."""
    return validate(read_document(path), PublishedFigures)
