"""What a publication has: numbers, formulas, a mesh."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import scipy.interpolate
import scipy.io
import sympy
from pydantic import BaseModel, ConfigDict, Field

from siq.errors import InputError
from siq.numerics.files import read_document, validate
from siq.quasipotential.landscape_comparison import Potential
from siq.systems.formulas import compile_formulas, parse_formula


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


def _component_terms(figures: Mapping[str, PublishedFigure], component: str) -> dict[str, PublishedFigure]:
    """The published coefficients of a component (``U``, ``g_x``) by term."""
    begin = f"{component}:"
    return {key.removeprefix(begin): one for key, one in figures.items() if key.startswith(begin)}


def published_formula(
    figures: Mapping[str, PublishedFigure], component: str, symbols: Sequence[sympy.Symbol]
) -> sympy.Expr | None:
    """A published formula from its printed coefficients, None where none was published."""
    terms = _component_terms(figures, component)
    names = {symbol.name: symbol for symbol in symbols}
    if not terms:
        return None
    return sympy.Add(*(sympy.Float(one.mean, 17) * parse_formula(term, names) for term, one in terms.items()))


def published_potentials(
    figures: Mapping[str, PublishedFigure],
    symbols: Sequence[sympy.Symbol],
    *,
    draws: int,
    generator: np.random.Generator,
) -> list[Potential]:
    """The published U as a function of points in rows: as printed, and with digits that are not printed.

    Parameters
    ----------
    figures
        The published figures; those of U are its coefficients.
    symbols
        The d states.
    draws
        How often the missing digits are drawn, uniformly within the rounding.
    generator
        Draws them.

    Returns
    -------
    list of functions
        ``1 + draws`` of them, the printed one first; none where no U was published.
    """
    terms = _component_terms(figures, "U")
    if not terms:
        return []
    names = {symbol.name: symbol for symbol in symbols}
    functions = compile_formulas([parse_formula(term, names) for term in terms], tuple(symbols))
    printed = np.array([one.mean for one in terms.values()])
    half = np.array([one.rounding for one in terms.values()])
    choices = [printed, *(printed + half * generator.uniform(-1, 1, (draws, len(half))))]

    def potential(coefficients: np.ndarray) -> Potential:
        return lambda x: np.asarray(coefficients @ functions(np.ascontiguousarray(x.T)))

    return [potential(one) for one in choices]


def mesh_potential(path: str | Path, mesh: PublishedMesh) -> Potential:
    """A published mesh as a function of points in rows, NaN where it does not reach.

    Raises
    ------
    InputError
        When the file holds no single matrix.
    """
    try:
        matrices = [one for one in scipy.io.loadmat(path).values() if isinstance(one, np.ndarray)]
        (values,) = [one for one in matrices if one.ndim == 2 and min(one.shape) > 1]
    except (OSError, ValueError, NotImplementedError) as error:
        raise InputError(path, "", f"it holds no single matrix ({type(error).__name__})", "mend it") from None
    axes = [np.linspace(*ends, count) for ends, count in zip(mesh.box, values.shape, strict=True)]
    between = scipy.interpolate.RegularGridInterpolator(axes, mesh.times * values, bounds_error=False)
    return lambda x: np.asarray(between(x))
