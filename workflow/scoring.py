"""Scores: how close formulas come to exact answers, and all runs of a study as tables.

Nothing here feeds back into a method. A run without formulas has no coefficients and no error; it stays in
the tables with missing values, and where no exact answer is known the coefficients stand without one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from siq.inference.checks import prediction_errors
from siq.inference.library import candidate_library
from siq.networks.decomposition import AnyNetworks, potential_on_grid, shuffled
from siq.numerics.randomness import Purpose, generator
from siq.quasipotential.formulas import SymbolicDecomposition, exact_decomposition, term_coefficients
from siq.systems.cards import load_exact, load_system
from siq.systems.dynamics import Dynamics
from siq.systems.formulas import compile_formulas
from siq.systems.simulation import SimulationOptions, simulate_snapshots
from siq.workflow.study import PipelineSettings
from siq.workflow.tables import METHODS, Method, Outcome, Status, Step, as_table
from workflow.published import PublishedFigure
from workflow.rows import certificate_rows, concatenate

GRID_POINTS = 1_000_000  # the paper's grid has 100 points along each of three axes


def exact_answer(card: str | Path) -> SymbolicDecomposition | None:
    """The exact decomposition of the system of a card, None where the card does not know U.

    Raises
    ------
    InputError
        As `siq.systems.cards.load_system`.
    """
    quasipotential = load_exact(card)
    return None if quasipotential is None else exact_decomposition(load_system(card), quasipotential)


def _exact_values(exact: SymbolicDecomposition, components: np.ndarray) -> np.ndarray:
    """The exact U at points, components ``(d, ...)`` to ``(...)``."""
    return compile_formulas([exact.quasipotential], exact.symbols)(components)[0]


def _coefficient_table(
    run: int,
    method: str,
    identified: SymbolicDecomposition,
    exact: SymbolicDecomposition | None,
    *,
    terms: tuple[str, ...],
) -> pd.DataFrame:
    """Every coefficient of U, V, f and g beside the exact one; all terms of the library, zeros included."""
    rows: list[dict[str, object]] = []
    known = exact.components() if exact is not None else {}
    for component, formula in identified.components().items():
        estimates = term_coefficients(formula)
        truths = term_coefficients(known[component]) if component in known else None
        listed = dict.fromkeys([*terms, *estimates, *(truths or {})])
        for term in listed:
            rows.append(
                {
                    "run": run,
                    "method": method,
                    "component": component,
                    "term": term,
                    "estimate": estimates.get(term, 0.0),
                    "exact": np.nan if truths is None else truths.get(term, 0.0),
                    "standard_error": identified.standard_errors.get(component, {}).get(term, np.nan),
                }
            )
    return as_table("coefficients", rows)


def _relative_root_mean_square_error(coefficients: pd.DataFrame) -> float:
    """‖ξ - ξ*‖/‖ξ*‖ over the non-trivial terms of U, those whose exact coefficient is not zero.

    This is the paper's measure (section 3.1). It does not see false terms: see `support_is_correct`.
    """
    quasipotential = coefficients[coefficients["component"] == "U"]
    nontrivial = quasipotential[quasipotential["exact"].fillna(0.0) != 0]
    if nontrivial.empty:
        return float("nan")
    difference = nontrivial["estimate"] - nontrivial["exact"]
    return float(np.linalg.norm(difference) / np.linalg.norm(nontrivial["exact"]))


def _support_is_correct(coefficients: pd.DataFrame) -> bool | None:
    """Whether U has exactly the terms of the exact one; None where that is not known.

    The constant is left out: it follows from U being zero at its minimum.
    """
    quasipotential = coefficients[(coefficients["component"] == "U") & (coefficients["term"] != "1")]
    if quasipotential["exact"].isna().any() or quasipotential.empty:
        return None
    return bool(((quasipotential["estimate"] != 0) == (quasipotential["exact"] != 0)).all())


def _domain_grid(domain: np.ndarray, *, points: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Axes of a regular grid over the domain Ω, and its points as ``(d, n)`` with n about `points`."""
    along = max(round(points ** (1 / len(domain))), 2)
    axes = [np.linspace(lower, upper, along) for lower, upper in domain]
    return axes, np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")])


def relative_error(estimate: np.ndarray, exact: np.ndarray) -> float:
    """Relative L2 error of U on a grid, after each is shifted to be zero at its minimum."""
    estimate, exact = estimate - estimate.min(), exact - exact.min()
    return float(np.linalg.norm(estimate - exact) / np.linalg.norm(exact))


def summary_table(
    coefficients: pd.DataFrame,
    rrmse: pd.DataFrame,
    prediction: pd.DataFrame,
    published: Mapping[str, PublishedFigure],
) -> pd.DataFrame:
    """Every figure over the runs, beside the exact and the published one.

    Quantities are ``rrmse``, ``support_correct``, ``certified``, ``network_error``, ``stated_error``,
    ``prediction_error`` (over all trajectories of all runs) and every coefficient that is not
    zero in some run, exactly or in print, as ``U:x**2``. A run that has no value is not counted in `runs`,
    and therefore shows there.
    """
    rows: list[dict[str, object]] = []
    for method, errors in rrmse.groupby("method", sort=False):
        for quantity in ("rrmse", "network_error", "stated_error", "support_correct", "certified"):
            rows.append(summary_row(str(method), quantity, errors[quantity].astype("float64"), published))
        predicted = prediction[prediction["method"] == method]["error"]
        if len(predicted):
            rows.append(summary_row(str(method), "prediction_error", predicted, published))
        chosen = coefficients[coefficients["method"] == method].dropna(subset="estimate")
        runs = chosen["run"].unique()
        for (component, term), group in chosen.groupby(["component", "term"], sort=False):
            quantity = f"{component}:{term}"
            # A run with formulas that does not list a term has it with coefficient zero.
            estimates = group.set_index("run")["estimate"].reindex(runs, fill_value=0.0)
            exact = group["exact"].iloc[0]
            if (estimates != 0).any() or (pd.notna(exact) and exact != 0) or quantity in published:
                row = summary_row(str(method), quantity, estimates, published)
                row["exact"] = exact
                row["inclusion_frequency"] = float((estimates != 0).mean())
                rows.append(row)
    return as_table("summary", rows)


def summary_row(
    method: str, quantity: str, values: pd.Series, published: Mapping[str, PublishedFigure]
) -> dict[str, object]:
    """A figure over the runs, in the columns of the table `summary`, beside the published one."""
    values = values.dropna()
    figure = published.get(quantity)
    return {
        "method": method,
        "quantity": quantity,
        "exact": np.nan,
        "mean": values.mean(),
        "standard_deviation": values.std() if len(values) > 1 else np.nan,
        "median": values.median(),
        "inclusion_frequency": np.nan,
        "runs": len(values),
        "published": figure.mean if figure else np.nan,
        "published_standard_deviation": figure.standard_deviation if figure else np.nan,
        "source": figure.source if figure else "",
    }


COARSE = 50_000  # points of the grid on which the randomised network is scored
UNSEEN = 1000  # trajectories that no run learns from (paper, section 3.1)


def score_run(
    settings: PipelineSettings,
    formulas: Mapping[str, SymbolicDecomposition],
    certificates: Mapping[str, Mapping[str, Any]],
    networks: AnyNetworks | None,
    *,
    number: int,
    system: Dynamics | None = None,
    exact: SymbolicDecomposition | None = None,
) -> dict[str, Any]:
    """Scores of one run: tables, see `siq.workflow.tables.COLUMNS`, and the outcome, by name.

    Parameters
    ----------
    settings
        Of the study.
    formulas, certificates
        Of the run, by method.
    networks
        Of the run, None where there are none.
    number
        Of the run.
    system, exact
        Its card and the exact decomposition, None where there is none, or where the card does not know it.
    """
    options, tables = settings.regression, []
    errors: dict[str, dict[str, Any]] = {
        # A method without a formula stays in the table, without an error to boast of.
        str(method): {"run": number, "method": str(method), "certified": False}
        for method in Method
        if method in settings.methods or method in certificates
    }
    for method, one in certificates.items():
        errors[method] |= {"certified": one["certified"], "stated_error": one["stated_error"]}
    for method, identified in formulas.items():
        library = candidate_library(
            [symbol.name for symbol in identified.symbols], degree=options.degree, further=options.functions
        )
        table = _coefficient_table(number, method, identified, exact, terms=library.names)
        tables.append(table)
        errors[method] |= {
            "rrmse": _relative_root_mean_square_error(table),
            "support_correct": _support_is_correct(table),
        }
    if exact is not None and system is not None and networks is not None:
        draw = generator(settings.seed, number, Purpose.SHUFFLE)
        known = _network_errors(networks, system.box, exact, draw)
        for method, row in errors.items():
            row["network_error"] = known[method]
    predicted = as_table("prediction", [])
    if system is not None and settings.simulation is not None and formulas:
        predicted = _predictions(system, formulas, number, settings.simulation, settings.seed)
    missing = "there is no formula to score" if not formulas else "no exact answer is known"
    scored = bool(formulas) and exact is not None
    outcome = Outcome(number, Step.SCORE) if scored else Outcome(number, Step.SCORE, Status.SKIPPED, missing)
    return {
        "coefficients": concatenate("coefficients", tables),
        "rrmse": as_table("rrmse", list(errors.values())),
        "prediction": predicted,
        "certificates": certificate_rows(number, certificates),
        "score_outcome": [outcome],
    }


def _network_errors(
    trained: AnyNetworks, box: np.ndarray, exact: SymbolicDecomposition, draw: np.random.Generator
) -> dict[str, float]:
    """Relative L2 error on a grid over Ω of the U of the trained networks, and of randomised ones.

    It is that of the points at which they hold: networks by well know nothing elsewhere.
    """
    randomised = shuffled(trained, generator=draw)

    def error_of(networks: AnyNetworks, points: int) -> float:
        axes, grid = _domain_grid(box, points=points)
        values = 2 * potential_on_grid(networks, axes, grid)
        known = np.isfinite(values)
        return relative_error(values[known], _exact_values(exact, grid[:, known]))

    error, chance = error_of(trained, GRID_POINTS), error_of(randomised, COARSE)
    return dict.fromkeys(map(str, METHODS), error) | {str(Method.CONTROL): chance}


def _predictions(
    system: Dynamics,
    formulas: Mapping[str, SymbolicDecomposition],
    number: int,
    simulation: SimulationOptions,
    seed: int,
) -> pd.DataFrame:
    """Errors of long-term prediction of unseen trajectories of the system without noise."""
    options = replace(simulation, trajectories=UNSEEN, noise_intensity=0.0)
    unseen = simulate_snapshots(system, options=options, generator=generator(seed, Purpose.UNSEEN))
    tables = [
        pd.DataFrame(
            {
                "run": number,
                "method": method,
                "trajectory": np.arange(UNSEEN),
                "error": prediction_errors(Dynamics.of(one.symbols, one.vector_field), unseen),
            }
        )
        for method, one in formulas.items()
    ]
    return concatenate("prediction", tables)


OF_RUNS = (
    "coefficients", "rrmse", "prediction", "certificates", "record", "record_density", "landscape", "degrees",
    "training",
)  # fmt: skip
"""Tables that every run, or every block of runs, has a part of."""


def collect_runs(
    parts: Mapping[str, Sequence[pd.DataFrame]],
    outcomes: Sequence[Outcome],
    published: Mapping[str, PublishedFigure],
    *,
    benchmarks: Path,
) -> dict[str, pd.DataFrame]:
    """The tables of a study by name.

    Parameters
    ----------
    parts
        The parts of each of the tables `OF_RUNS`.
    outcomes
        Of every step of every run.
    published
        Figures to be set beside ours.
    benchmarks
        Folder of the times that the workflow measured.
    """
    tables = {name: concatenate(name, list(parts[name])) for name in OF_RUNS}
    order = list(Step)
    entries = sorted(outcomes, key=lambda one: (one.run, order.index(one.step)))
    tables["outcomes"] = as_table(
        "outcomes",
        [
            {"run": one.run, "step": str(one.step), "status": str(one.status), "reason": one.reason}
            for one in entries
        ],
    )
    tables["timings"] = timings(benchmarks, {one.run for one in entries}, drawing=str(entries[0].step))
    tables["summary"] = summary_table(
        tables["coefficients"], tables["rrmse"], tables["prediction"], published
    )
    return tables


def timings(folder: Path, runs: Iterable[int], *, drawing: str) -> pd.DataFrame:
    """Seconds of every step of every run; runs that trained side by side share their time evenly.

    `drawing` is what the outcomes call the step that draws trajectories.
    """
    known, rows = set(runs), []
    for path in sorted(folder.glob("*/*.tsv")):
        first, _, last = path.parent.name.partition("-")
        together = [run for run in range(int(first), int(last or first) + 1) if run in known]
        seconds = float(pd.read_csv(path, sep="\t")["s"].iloc[0])
        rows += [
            {
                "run": run,
                "step": drawing if path.stem == "draw" else path.stem,
                "seconds": seconds / len(together),
            }
            for run in together
        ]
    return as_table("timings", rows).sort_values(["run", "step"], ignore_index=True)
