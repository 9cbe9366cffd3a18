"""What the page of a study says of its landscape beyond the first screen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from siq.numerics.text import range_text, unit_text, value_text
from siq.quasipotential.rates import NoiseStrength, exit_time
from siq.report.landscape_answer import time_text
from siq.report.landscape_summary import SaidLandscape, well_name
from siq.report.page import ReportTable
from siq.workflow.outcomes import Status, Step


def landscape_sentences(landscape: pd.DataFrame, outcomes: pd.DataFrame) -> list[str]:
    """Why there is no landscape, where f was followed and led to no attractor.

    Parameters
    ----------
    landscape, outcomes
        The tables of these names.
    """
    asked = outcomes[
        (outcomes["step"] == Step.LANDSCAPE) & outcomes["status"].isin([Status.WARNING, Status.FAILED])
    ]
    without = asked[~asked["run"].isin(landscape[landscape["kind"] == "attractor"]["run"])]
    if without.empty:
        return []
    which = (
        ""
        if len(without) == outcomes["run"].nunique()
        else f" of {len(without)} of {outcomes['run'].nunique()} runs"
    )
    return [f"There is no landscape{which}: {without['reason'].iloc[0]}."]


def landscape_tables(
    overview: Mapping[str, Any] | None,
    landscape: pd.DataFrame,
    *,
    noises: Sequence[float],
    folder: Path,
) -> list[ReportTable]:
    """The ways out of the wells, all equilibria, times for other noises, and barriers over the runs.

    Parameters
    ----------
    overview
        The landscape that is shown, as plain data; None where there is none.
    landscape
        The table of that name, of all runs; empty where the study asked for none.
    noises
        Noise strengths that the study gives.
    folder
        Where the whole tables are.
    """
    tables = []
    if overview is not None and overview["wells"]:
        said = SaidLandscape(overview)
        file = f"{folder}/landscape.csv" if len(landscape) else ""
        if overview["transitions"]:
            tables.append(_ways(said, file))
        tables.append(_equilibria(said, file))
        if overview.get("parting"):
            tables.append(_parting(said, file))
        if noises and any(way["prefactor"] is not None for way in overview["transitions"]):
            tables.append(_times(said, noises))
    if len(landscape) and landscape["run"].nunique() > 1:
        tables.append(_over_runs(landscape, folder))
    return tables


def _ways(said: SaidLandscape, file: str) -> ReportTable:
    """One row for every way out of every well."""
    unit = unit_text(said.energy_unit)
    barrier = "barrier ΔU" + (f" ({unit})" if unit else "")
    time = "mean time" + (f" ({unit_text(said.time_unit)})" if unit_text(said.time_unit) else "")
    rows, numbers = [], []
    for way in said.data["transitions"]:
        known = way["barrier"] is not None
        exit_ = said.exits(way["start"])[
            [one for one in said.data["transitions"] if one["start"] == way["start"]].index(way)
        ]
        mean = None if said.noise is None or not known else exit_time(exit_, said.noise)
        beyond = f"out of the {said.region}" if way["end"] is None else well_name(way["end"])
        rows.append(
            {
                "way": f"{well_name(way['start'])} to {beyond}",
                "over the saddle at": _place(said, way["saddle"]) + _of_cycle(said, way),
                barrier: value_text(exit_.barrier, exit_.standard_error) if known else "",
                "the same by the path alone": value_text(way["minimum_action"])
                if way["minimum_action"] is not None
                else "",
                time: "" if mean is None else time_text(mean, "1", decorated=False),
                "to be known": "; ".join(way["notes"]),
            }
        )
        if said.given:
            del rows[-1]["the same by the path alone"]
        numbers.append(
            {
                "start": well_name(way["start"]),
                "end": "" if way["end"] is None else well_name(way["end"]),
                **{f"saddle_{name}": value for name, value in zip(said.states, way["saddle"], strict=True)},
                "barrier": way["barrier"], "barrier_error": way.get("error"),
                "minimum_action": way["minimum_action"], "prefactor": way["prefactor"],
                "mean_time": np.nan if mean is None else mean.value,
                "data_error": np.nan if mean is None else mean.data_error,
                "law_error": np.nan if mean is None else mean.law_error,
            }
        )  # fmt: skip
    explained = {
        barrier: "the least action of the way, which needs no formula of U"
        if said.given
        else "by the formula of the well and the end of the way; its error is that of f, and the"
        " difference between formula and way",
        "the same by the path alone": "the least action of the way, without any formula of U",
        time: "prefactor · exp(ΔU/ε), until the next well is reached over this saddle alone",
    }
    return ReportTable(
        "Every way out of every well.", pd.DataFrame(rows), explained, file, data=pd.DataFrame(numbers),
        rows_named=True,
    )  # fmt: skip


def _of_cycle(said: SaidLandscape, way: Mapping[str, Any]) -> str:
    if "over_cycle" not in way:
        return ""
    return f", on an unstable cycle of period {value_text(way['over_cycle'], unit=said.time_unit, digits=4)}"


def _parting(said: SaidLandscape, file: str) -> ReportTable:
    """The unstable cycles, a row for each."""
    unit = f" ({unit_text(said.time_unit)})" if unit_text(said.time_unit) else ""
    rows = []
    for one in said.data["parting"]:
        points = np.array(one["points"])
        reach = [range_text(*ends) for ends in zip(points.min(axis=0), points.max(axis=0), strict=True)]
        multipliers = ", ".join(_rate(*value) for value in one["multipliers"])
        rows.append(
            dict(zip(said.states, reach, strict=True))
            | {
                f"period{unit}": value_text(one["period"], digits=4),
                "Floquet multipliers": multipliers,
            }
        )
    return ReportTable("Unstable cycles, which part basins.", pd.DataFrame(rows), {}, file)


def _place(said: SaidLandscape, position: Sequence[float]) -> str:
    values, _ = said.settled(np.array(position, dtype=float), np.zeros(len(position)))
    return "(" + ", ".join(value_text(value) for value in values) + ")"


def _equilibria(said: SaidLandscape, file: str) -> ReportTable:
    letters = {tuple(one["attractor"]): well_name(index) for index, one in enumerate(said.data["wells"])}
    kinds = {"attractor": "stable state", "saddle": "saddle", "repeller": "unstable in all directions"}
    unit = f" (1/{unit_text(said.time_unit)})" if unit_text(said.time_unit) else ""
    position = f"({', '.join(said.states)})" if len(said.states) > 1 else said.states[0]
    if len(set(said.units)) == 1 and unit_text(said.units[0]):
        position += f" ({unit_text(said.units[0])})"
    rows = [
        {
            "": letters.get(tuple(one["position"]), ""),
            "what": kinds.get(one["kind"], one["kind"]),
            position: _place(said, one["position"]),
            f"rates{unit}": ", ".join(_rate(*value) for value in one["eigenvalues"]),
        }
        for one in said.data["equilibria"]
    ]
    frame = pd.DataFrame(rows)
    if not any(frame[""]):
        frame = frame.drop(columns="")
    explained = {f"rates{unit}": "eigenvalues of f there; a rate that is positive leads away"}
    return ReportTable("All states at which f vanishes.", frame.rename(columns={"": "name"}), explained, file)


def _rate(real: float, imaginary: float) -> str:
    if not imaginary:
        return value_text(real)
    return f"{value_text(real)} {'−' if imaginary < 0 else '+'} {value_text(abs(imaginary))} i"


def _times(said: SaidLandscape, noises: Sequence[float]) -> ReportTable:
    """How long each well lasts under the noise strengths that the study gives."""
    unit, time = unit_text(said.energy_unit), unit_text(said.time_unit)
    rows = []
    for strength in noises:
        row = {"noise strength ε" + (f" ({unit})" if unit else ""): value_text(strength)}
        for index, well in enumerate(said.wells):
            mean = said.dwell_time(index, NoiseStrength(strength))
            known = "too strong a noise" if strength >= well.depth else ""
            row[f"{well.name} lasts" + (f" ({time})" if time else "")] = (
                known if mean is None else time_text(mean, "1", decorated=False)
            )
        rows.append(row)
    return ReportTable(
        "How long each well lasts, for the noise strengths that the study gives.", pd.DataFrame(rows)
    )


def _over_runs(landscape: pd.DataFrame, folder: Path) -> ReportTable:
    ways = landscape[landscape["kind"] == "transition"]
    counted = (
        ways.groupby("item", sort=False)
        .agg(
            runs=("barrier", "size"), mean=("barrier", "mean"), lowest=("barrier", "min"),
            highest=("barrier", "max"), by_the_path_alone=("minimum_action", "mean"),
            prefactor=("prefactor", "mean"),
        )
        .reset_index()
        .rename(columns=lambda name: "way" if name == "item" else name.replace("_", " "))
    )  # fmt: skip
    return ReportTable(
        "Barriers of U over all runs.",
        counted,
        {"way": "A1 is A, A2 is B, and so on"},
        f"{folder}/landscape.csv",
    )


def escape_table(escape: pd.DataFrame, time_unit: str, folder: Path) -> ReportTable:
    """Mean escape times by the law beside direct simulation."""
    unit = f", in {unit_text(time_unit)}" if unit_text(time_unit) else ""
    return ReportTable(
        f"Mean escape times{unit}: by the law, and in direct simulations of the card with their standard"
        f" error.",
        escape.rename(columns=lambda name: name.replace("_", " ")),
        {"intensity": "the strength ε of the noise", "escapes": "how many were seen"},
        f"{folder}/escape.csv",
    )


def errors_table(errors: pd.DataFrame, folder: Path) -> ReportTable:
    """Relative L2 errors of U over the runs, by source and region."""
    counted = (
        errors.groupby(["source", "region"], sort=False)
        .agg(
            runs=("error", "size"), mean_error=("error", "mean"), worst_error=("error", "max"),
            least_covered=("covered", "min"), worst_everywhere=("error_everywhere", "max"),
        )
        .reset_index()
        .rename(columns=lambda name: name.replace("_", " "))
    )  # fmt: skip
    return ReportTable(
        "Relative L2 error of U against characteristics of the exact vector field; of barriers, against the"
        " minimum action.",
        counted,
        {
            "least covered": "smallest share of the region at which a source says anything",
            "worst everywhere": "of the formulas at every point of the region, believed or not",
            "source": "networks and regression are ours, by the published method; what was published is only"
            " scored. The digits of its formula that are not printed were drawn 100 times: one run each",
        },
        f"{folder}/landscape_errors.csv",
        40,
    )


SHORT = {
    "intensity": "ε",
    "bessel": "Bessel",
    "simulated_distance": "distance",
    "sampling_floor": "floor",
    "unknown_at_most": "unknown, at most",
    "simulated_unknown": "simulated there",
}


def invariant_tables(invariant: pd.DataFrame, shares: pd.DataFrame, folder: Path) -> list[ReportTable]:
    """The normalisation of the invariant distribution, and the wells' shares, where one was asked for."""
    if invariant.empty:
        return []
    explained = {
        "Bessel": "Z by the paper's closed formula, over all space",
        "quadrature": "Z by quadrature, over the domain; of local formulas, over its part where U is known",
        "distance": "total variation between density and long simulation, on the first two states; of local"
        " formulas, within the region where U is known",
        "floor": "what this distance is expected to be if the density is exact",
        "unknown, at most": "share of all probability in the domain that can lie where U is not known",
        "simulated there": "share of the simulation that was in that region",
        "method": "the published formula is as printed; its run −1 is none of ours",
    }
    tables = [
        ReportTable(
            "Normalisation Z of the invariant distribution exp(−U/ε)/Z for √ε dW, for each ε, and its"
            " distance from a long simulation.",
            readable(invariant.rename(columns=SHORT)), explained, f"{folder}/invariant.csv",
        )
    ]  # fmt: skip
    if len(shares):
        tables.append(
            ReportTable(
                "The wells' shares of the invariant distribution. Walkers of the simulation start with the"
                " shares of the formulas, since at small ε they do not change wells; where few have changed,"
                " the simulated shares are those of the start, and the simulation tests the density within"
                " each well alone. exp(−U/ε) is the leading order as ε → 0, without the density's prefactor.",
                readable(shares.rename(columns=SHORT)),
                {
                    "share": "by exp(−U/ε) over the region where U is known",
                    "by rates": "by the law of the escape times, prefactors included",
                    "changed": "of the walkers that start in the well, the share that ends in another",
                },
                f"{folder}/well_shares.csv",
            )
        )
    return tables


def readable(table: pd.DataFrame) -> pd.DataFrame:
    """A table with headings in words, without columns that say nothing."""
    return table.dropna(axis=1, how="all").rename(columns=lambda name: name.replace("_", " "))


CAPTION = (
    "Barriers, prefactors and mean times: by the equations of the card, and by the trajectories alone. This"
    " is scoring, and no input of the method."
)
EXPLAINED = {
    "item": "A1 is the first attractor of the equations, and so on; A1 to A2 is the way out of it",
    "difference": "trajectories / equations − 1",
    "in standard errors": "of the number by the trajectories, as these state it",
}


def beside_sentences(table: pd.DataFrame | None) -> list[str]:
    """The largest difference of a barrier, and what cannot be compared; nothing where nobody asked.

    Parameters
    ----------
    table
        `beside_equations`, None where there is none.
    """
    if table is None or table.empty:
        return []
    barriers = table[table["quantity"] == "barrier"]
    off = barriers["relative_difference"].abs().max()
    said = []
    if np.isfinite(off):
        said.append(
            "The equations of the card, which are no input of the method, have barriers too: those of the"
            f" trajectories are off by {_share(off)} at most."
        )
    for note, some in table[table["note"].fillna("") != ""].groupby("note", sort=False):
        named = ", ".join(item for item in dict.fromkeys(some["item"].fillna("")) if item)
        said.append(f"Beside the equations: {named + ': ' if named else ''}{note}.")
    return said


def beside_table(table: pd.DataFrame, folder: Path) -> ReportTable:
    """Every number by both; of several runs their mean, with the largest difference.

    Parameters
    ----------
    table
        `beside_equations`.
    folder
        Where it lies.
    """
    known = table[table["quantity"].fillna("") != ""]
    rows = []
    for _, some in known.groupby(["item", "quantity", "noise"], sort=False, dropna=False):
        first = some.iloc[0]
        at = f" at ε = {value_text(first['noise'])}" if np.isfinite(first["noise"]) else ""
        several = some["run"].nunique() > 1
        off, sharp = some["relative_difference"], some["in_errors"]
        rows.append(
            {
                "item": first["item"],
                "what": f"{first['quantity']}{at}",
                "by the equations": _text(first["equations"]),
                "by the trajectories": _text(some["trajectories"].mean()),
            }
            | (
                {
                    "runs": int(some["trajectories"].notna().sum()),
                    "largest difference": _share(off.abs().max()),
                    "largest in standard errors": _text(sharp.abs().max(), digits=2),
                }
                if several
                else {
                    "difference": _share(off.iloc[0], sign=True),
                    "in standard errors": _text(sharp.iloc[0], digits=2),
                }
            )
        )
    return ReportTable(
        CAPTION, pd.DataFrame(rows), EXPLAINED, f"{folder}/beside_equations.csv", 40, data=table
    )


def _text(value: float, *, digits: int = 5) -> str:
    return value_text(value, digits=digits) if np.isfinite(value) else ""


def _share(value: float, *, sign: bool = False) -> str:
    """A difference in per cent."""
    if not np.isfinite(value):
        return ""
    text = value_text(100 * value, digits=2)
    return f"+{text} %" if sign and value > 0 else f"{text} %"
