"""What the page of a study says of its invariant distribution."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from siq.report.page import ReportTable

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
