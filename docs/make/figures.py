"""Read the figures that pages quote from the tables of results: `python docs/make/figures.py [RESULTS]`.

`docs/figures.json` is the one place where a measured figure stands. Pages name it as
`{{ figures.archetype3d.certified }}`; README.md, which no program fills in, has it between the marks
`<!--=archetype3d.certified-->` and `<!--/-->`, and this script writes it there. Beside each figure stand
the command that measured it and its source: the folder of tables from which this script read it, or how
else it came there. Figures whose tables are not among the results stay as they were measured before, and
the script says so.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path

import pandas as pd
import sympy

from siq.numerics.text import range_text, value_text
from siq.quasipotential.landscape_files import landscape_from_data
from siq.report.formatting import counted_text, predicted_text
from siq.report.page import read_inspection
from siq.report.summary import summarise
from siq.systems.dynamics import Dynamics

ROOT = Path(__file__).parents[2]
FIGURES = ROOT / "docs" / "figures.json"
README = ROOT / "README.md"
MARK = re.compile(r"<!--=([\w.]+)-->(.*?)<!--/-->")
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

Found = dict[str, str]


def power(value: float) -> str:
    """A number with two digits and a power of ten, as pages write it."""
    digits, exponent = f"{value:.1e}".split("e")
    return f"{digits}·10{str(int(exponent)).translate(SUPERSCRIPTS)}"


def archetype3d(tables: Path) -> Found:
    """The 50 runs of `make statistics`, or of the same system with noise."""
    scores = pd.read_parquet(tables / "rrmse.parquet")
    errors = pd.read_parquet(tables / "prediction.parquet")
    coefficients = pd.read_parquet(tables / "coefficients.parquet")
    found: Found = {}
    for method, prefix in (("refined", ""), ("regression", "regression_")):
        of = scores[scores["method"] == method]
        found[f"{prefix}certified"] = f"{int(of['certified'].sum())} of {len(of)}"
        found[f"{prefix}right_terms"] = f"{int(of['support_correct'].fillna(False).sum())} of {len(of)}"
        found[f"{prefix}rrmse_mean"] = power(of["rrmse"].mean())
        found[f"{prefix}rrmse_worst"] = power(of["rrmse"].max())
        predicted = errors.loc[errors["method"] == method, "error"]
        found[f"{prefix}prediction_mean"] = power(predicted.mean())
        found[f"{prefix}prediction_median"] = power(predicted.median())
    terms = coefficients[(coefficients["method"] == "refined") & (coefficients["component"] == "U")]
    found["coefficients_worst"] = power((terms["estimate"] - terms["exact"]).abs().max())
    refined = scores[scores["method"] == "refined"]
    found["network_error"] = power(refined["network_error"].mean())
    return found | {"runs": str(len(refined))}


SOURCES_OF_U = {
    "local formulas": "refined",
    "networks": "networks",
    "regression, by well": "by_well",
    "regression": "quartic",
}
REGIONS = {
    "A1, ": "a",
    "A2, ": "b",
    "U < ": "all",
    "barrier from A1": "barrier_a",
    "barrier from A2": "barrier_b",
}


def resonator(tables: Path) -> Found:
    """The 50 runs of that study: certificates, and U against characteristics of the exact f, mean (worst)."""
    scores, tests = (pd.read_parquet(tables / f"{name}.parquet") for name in ("rrmse", "certificates"))
    refined = scores[scores["method"] == "refined"]
    found = {"runs": str(len(refined)), "certified": f"{int(refined['certified'].sum())} of {len(refined)}"}
    for method, name in (("refined", "agree"), ("randomised network", "control_agrees")):
        of = tests[(tests["method"] == method) & (tests["test"] == "agreement")]
        found[name] = f"{int(of['passed'].sum())} of {len(of)}"
    errors = pd.read_parquet(tables / "landscape_errors.parquet")
    for (source, name), (begin, region) in product(SOURCES_OF_U.items(), REGIONS.items()):
        of = errors[(errors["source"] == source) & errors["region"].str.startswith(begin)]
        if len(of):
            mean, worst = (
                power(one) if one < 0.01 else f"{one:.2g}" for one in (of["error"].mean(), of["error"].max())
            )
            found[f"{name}_{region}"] = f"{mean} ({worst})"
            found[f"{name}_{region}_covered"] = f"{100 * of['covered'].min():.1f} %"
    return found


def proof(tables: Path) -> Found:
    """Concealed cases: what was said of them."""
    scores = pd.read_parquet(tables / "score.parquet")
    quiet = scores[scores["kind"].isin(["null", "shift"])]
    strong = scores[(scores["kind"] == "mechanism") & (scores["oracle_delta_chi2"] >= 100)]
    return {
        "cases": str(len(scores)),
        "quiet": str(len(quiet)),
        "false_alarms": str(int(quiet["false_alarm"].sum())),
        "knowable": str(len(strong)),
        "named": str(int(strong["truth_in_class"].sum())),
    }


def greenland_ice(tables: Path) -> Found:
    """The study of that name: two states, how long they last, and what divides them."""
    overview = json.loads((tables.parent / "overview.json").read_text(encoding="utf-8"))
    record = pd.read_parquet(tables / "record.parquet")
    certificates = pd.read_parquet(tables / "certificates.parquet")
    noise = json.loads((tables.parent / "runs" / "000" / "vector_field.json").read_text(encoding="utf-8"))[
        "noise"
    ]
    symbols = [sympy.Symbol(name, real=True) for name in overview["states"]]
    stored = landscape_from_data(overview, Dynamics.of(symbols, symbols))  # nothing here asks for f
    said = summarise(stored, record=record, run=overview["run"])
    found: Found = {}
    for name, well in zip(("warm", "cold"), sorted(said.wells, key=lambda one: one.position[0]), strict=True):
        assert well.visits is not None
        found[f"{name}_place"] = value_text(well.position[0], well.position_errors[0])
        found[f"{name}_counted"] = counted_text(well.visits)
        found[f"{name}_foreseen"] = predicted_text(well.visits)
        found[f"{name}_barrier"] = value_text(*well.relative_depth(said.noise))
    missing = certificates.set_index("test")["value"]["existence"]
    assert said.noise is not None
    _, seen = read_inspection(tables.parent / "drawn" / "study")
    assert seen is not None
    return found | {
        "one_state": f"{seen.probability:.2g}",
        "hops": str(int(record["visits"].sum())),
        "cycle": f"{record['counted'].sum():,.0f}",
        "no_saddle": f"{100 * missing:.0f} %",
        "sensor": value_text(noise["measurement"][0], noise["measurement_error"][0]),
        "noise": value_text(said.noise.intensity, said.noise.standard_error),
    }


def neuromorphic_chip(tables: Path) -> Found:
    """The study of that name: two states that the record shows without any formula."""
    _, seen = read_inspection(tables.parent / "drawn" / "study")
    assert seen is not None
    found = {"hops": str(seen.transitions)}
    for name, level, one in zip(("quiet", "active"), seen.levels, seen.counts, strict=True):
        found[f"{name}_level"] = value_text(level, digits=2)
        found[f"{name}_counted"] = f"{value_text(one.mean, digits=3)} ({range_text(*one.limits)})"
    return found


SOURCES: dict[str, tuple[str, Callable[[Path], Found], str]] = {
    "archetype3d": ("archetype3d/tables", archetype3d, "make statistics"),
    "archetype3d_noise": (
        "archetype3d-noise/tables",
        archetype3d,
        "snakemake --cores 2 results/archetype3d-noise/report.html",
    ),
    "resonator": ("resonator/tables", resonator, "snakemake --cores 1 results/resonator/report.html"),
    "greenland_ice": ("greenland-ice/tables", greenland_ice, "siq run greenland-ice"),
    "neuromorphic_chip": ("neuromorphic-chip/tables", neuromorphic_chip, "siq run neuromorphic-chip"),
    "proof": ("proof/proof/tables", proof, "snakemake --cores 2 proof"),
    "proof_full": ("proof/proof_full/tables", proof, "snakemake --cores 2 proof_full"),
}


def values() -> dict[str, str]:
    """Every figure by its name."""
    known = json.loads(FIGURES.read_text(encoding="utf-8"))
    return {f"{group}.{name}": one["value"] for group, of in known.items() for name, one in of.items()}


def filled(text: str, known: dict[str, str]) -> str:
    """A text with the figures between its marks."""
    return MARK.sub(lambda found: f"<!--={found[1]}-->{known[found[1]]}<!--/-->", text)


def main(results: Path) -> None:
    """Write what the results give, and fill in the README."""
    known = json.loads(FIGURES.read_text(encoding="utf-8"))
    for group, (tables, read, command) in SOURCES.items():
        if not (results / tables).is_dir():
            print(f"{group}: there is no {results / tables}; its figures stay as they were", file=sys.stderr)
            continue
        found = read(results / tables)
        known.setdefault(group, {}).update(
            {
                name: {"value": value, "command": command, "source": f"results/{tables}"}
                for name, value in found.items()
            }
        )
    FIGURES.write_text(json.dumps(known, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    README.write_text(filled(README.read_text(encoding="utf-8"), values()), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else ROOT / "results")
