"""Targets of the proofs: what was to be reached, what the scores say, and within which bounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import scipy.stats

from benchmarks.proof.scoring import FAILED, NAMELESS, NOISE

STRONG = 100.0
"""Oracle Δχ² from which on the recordings hold enough to know the mechanism by."""

LEVEL = 0.95
SHOWN = [
    "case", "system", "kind", "mechanism", "noise_db", "strength", "oracle_delta_chi2", "verdict",
    "reported_class", "location",
]  # fmt: skip


FOREIGN_SHOWN = [
    "case", "system", "kind", "law", "noise_db", "sensors", "recordings", "verdict", "named", "described",
]  # fmt: skip


@dataclass(frozen=True)
class Target:
    """A figure and what it was to be.

    Attributes
    ----------
    name
        What is measured.
    limit
        What was to be reached, in words; empty where nothing was.
    measured, low, high
        The figure, and its 95 % bounds.
    cases
        How many cases, or intervals, it is of.
    met
        Whether the limit is kept; None where there is none, or no case.
    """

    name: str
    limit: str
    measured: float
    low: float
    high: float
    cases: int
    met: bool | None


def share(name: str, hits: pd.Series, *, most: float | None = None, least: float | None = None) -> Target:
    """A share with the bounds of Clopper and Pearson."""
    count, found = len(hits), int(hits.sum())
    return counted(name, found, count, most=most, least=least)


def counted(
    name: str, found: int, count: int, *, most: float | None = None, least: float | None = None
) -> Target:
    """A share that is given by two counts, with the bounds of Clopper and Pearson."""
    low, high = clopper_pearson(found, count)
    return _target(name, found / count if count else np.nan, low, high, count, most, least, percent=True)


def quantile(
    name: str, values: pd.Series, at: float, *, most: float | None = None, percent: bool = False
) -> Target:
    """A quantile with bounds by order statistics, which assume no distribution."""
    known = np.sort(values.dropna().to_numpy(float))
    count = len(known)
    if not count:
        return _target(name, np.nan, np.nan, np.nan, 0, most, None, percent=percent)
    lower, upper = scipy.stats.binom.ppf([(1 - LEVEL) / 2, (1 + LEVEL) / 2], count, at).astype(int)
    return _target(
        name,
        float(np.quantile(known, at)),
        float(known[lower - 1]) if lower > 0 else -np.inf,
        float(known[upper]) if upper < count else np.inf,
        count,
        most,
        None,
        percent=percent,
    )


def mean(name: str, values: pd.Series, *, most: float) -> Target:
    """A mean with the bounds of a normal distribution."""
    known = values.dropna().to_numpy(float)
    if not len(known):
        return _target(name, np.nan, np.nan, np.nan, 0, most, None, percent=False)
    error = 1.96 * known.std(ddof=1) / np.sqrt(len(known)) if len(known) > 1 else np.nan
    middle = float(known.mean())
    return _target(name, middle, middle - error, middle + error, len(known), most, None, percent=False)


def clopper_pearson(found: int, count: int, *, level: float = LEVEL) -> tuple[float, float]:
    """Exact bounds of a probability, from so many hits in so many trials."""
    if not count:
        return np.nan, np.nan
    tail = (1 - level) / 2
    low = float(scipy.stats.beta.ppf(tail, found, count - found + 1)) if found else 0.0
    high = float(scipy.stats.beta.ppf(1 - tail, found + 1, count - found)) if found < count else 1.0
    return low, high


def targets_of(scores: pd.DataFrame) -> list[Target]:
    """All targets, from the table of scores."""
    quiet = scores[scores["kind"].isin(["null", "shift"])]
    noisy = scores[scores["kind"] == NOISE]
    mechanisms = scores[scores["kind"] == "mechanism"]
    strong = mechanisms[mechanisms["oracle_delta_chi2"] >= STRONG]
    faint = mechanisms[mechanisms["oracle_delta_chi2"] < STRONG]
    named = strong[strong["verdict"] == "missing physics"]
    withheld = scores[(scores["kind"] == "withheld") & scores["detected"]]
    found = [
        share("false alarms among nulls and shifts", quiet["false_alarm"], most=0.01),
        share("nulls: “no mismatch”", _of(quiet, "null")["right"]),
        share("shifts: “parameter shift”", _of(quiet, "shift")["right"]),
        share(
            "deterministic mechanism named under process noise", noisy["deterministic_under_noise"], most=0.01
        ),
        share("process noise named, and nothing else", noisy["right"]),
        share("truth within the reported class, Δχ² ≥ 100", strong["truth_in_class"], least=0.98),
        mean("mean size of the class, Δχ² ≥ 100", named["class_size"], most=1.5),
        share("named mechanism has the key's formula, Δχ² ≥ 100", strong["same_formula"]),
        share("detected, Δχ² < 100", faint["detected"]),
        share("named rightly, Δχ² < 100", faint["truth_in_class"]),
    ]
    for level, least in ((40.0, 0.85), (30.0, 0.75), (20.0, None)):
        own = strong[strong["noise_db"] == level]
        single = own[own["class_size"] == 1]
        found += [
            share(f"classes of one at {level:g} dB, Δχ² ≥ 100", own["class_size"] == 1, least=least),
            share(
                f"of these the right one at {level:g} dB",
                single["truth_in_class"],
                least=None if least is None else 0.98,
            ),
        ]
    found.append(
        share("withheld: without a name among those detected", withheld["verdict"].isin(NAMELESS), least=0.95)
    )
    for name, some in (("mechanisms, Δχ² ≥ 100", strong), ("withheld, detected", withheld)):
        found += [
            share(f"equation right, {name}", some["equation_right"], least=0.95),
            share(f"coordinate right, {name}", some["coordinate_right"], least=0.95),
        ]
    right = strong[strong["truth_in_class"]]
    for level, most in ((40.0, 0.02), (30.0, 0.10), (20.0, None)):
        own = right[right["noise_db"] == level]
        errors = own["functional_error"]
        found.append(
            quantile(f"functional error at {level:g} dB, median", errors, 0.5, most=most, percent=True)
        )
        # Effects just above Δχ² = 100 have errors of 10 % by nature; the oracle's say what could be had.
        for whose, column in (("", "functional_error"), (" of the oracle", "oracle_functional_error")):
            name = f"functional error{whose} at {level:g} dB, 90th percentile"
            found.append(quantile(name, own[column], 0.9, percent=True))
    for what, text in (("mechanism", "mechanism's parameters"), ("parameter", "recalibrated parameters")):
        within, count = int(scores[f"{what}_covered"].sum()), int(scores[f"{what}_intervals"].sum())
        found.append(counted(f"95 % intervals that hold, {text}", within, count, least=0.90, most=0.98))
    found.append(
        quantile("estimated over true intensity of process noise, median", noisy["intensity_ratio"], 0.5)
    )
    for name, some in (("mechanisms, Δχ² ≥ 100", strong), ("nulls and shifts", quiet)):
        for at, word in ((0.5, "median"), (0.95, "95th percentile")):
            found.append(
                quantile(
                    f"held-out error over the oracle's, {name}, {word}", some["error_ratio"], at, most=1.05
                )
            )
    found.append(quantile("seconds a case, median", scores["seconds"], 0.5, most=10.0))
    found.append(share("cases without any verdict", scores["verdict"] == FAILED))
    return found


def target_table(targets: list[Target]) -> pd.DataFrame:
    """Targets as a table."""
    rows = [
        (each.name, each.limit, each.measured, each.low, each.high, each.cases, each.met) for each in targets
    ]
    return pd.DataFrame(rows, columns=["figure", "target", "measured", "from", "to", "of", "met"])


def failures_of(scores: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Cases that count against a target, under a sentence each."""
    strong = (scores["kind"] == "mechanism") & (scores["oracle_delta_chi2"] >= STRONG)
    quiet = scores["kind"].isin(["null", "shift"])
    seen = strong & (scores["verdict"] != FAILED)
    withheld = (scores["kind"] == "withheld") & scores["detected"]
    lists = [
        ("False alarms: “missing physics” where nothing is missing.",
         quiet & (scores["verdict"] == "missing physics"), []),
        ("False alarms: “modelled” or “unexplained” where nothing is missing.",
         quiet & scores["verdict"].isin(NAMELESS), []),
        ("Nulls and shifts that were taken for each other.",
         quiet & ~scores["right"] & ~scores["false_alarm"] & (scores["verdict"] != FAILED), []),
        ("Deterministic mechanisms named under process noise.", scores["deterministic_under_noise"], []),
        ("Process noise that was not named.",
         (scores["kind"] == NOISE) & ~scores["right"] & ~scores["deterministic_under_noise"], []),
        ("Mechanisms that are not in the reported class, Δχ² ≥ 100.", seen & ~scores["truth_in_class"], []),
        ("Classes of more than one, Δχ² ≥ 100.", strong & (scores["class_size"] > 1), []),
        ("Right names whose formula is not the key's, Δχ² ≥ 100.",
         strong & scores["truth_in_class"] & ~scores["same_formula"], []),
        ("Wrong equation or coordinate, Δχ² ≥ 100.",
         seen & ~(scores["equation_right"] & scores["coordinate_right"]), []),
        ("Withheld effects that were given a name.",
         withheld & ~scores["verdict"].isin(NAMELESS), []),
        ("Withheld effects found in the wrong equation or coordinate.",
         withheld & ~(scores["equation_right"] & scores["coordinate_right"]), []),
        ("Functional errors above 2 % at 40 dB or 10 % at 30 dB, Δχ² ≥ 100.",
         strong & scores["truth_in_class"]
         & (((scores["noise_db"] == 40) & (scores["functional_error"] > 0.02))
            | ((scores["noise_db"] == 30) & (scores["functional_error"] > 0.1))), ["functional_error"]),
        ("Held-out errors above 1.05 times the oracle's, but for withheld effects.",
         (scores["kind"] != "withheld") & (scores["error_ratio"] > 1.05),
         ["augmented_error", "oracle_error"]),
        ("Cases without any verdict.", scores["verdict"] == FAILED, ["note"]),
        ("Cases with something that could not be scored.",
         (scores["note"] != "") & (scores["verdict"] != FAILED), ["note"]),
    ]  # fmt: skip
    return [(said, scores.loc[rows, [*SHOWN, *more]].reset_index(drop=True)) for said, rows, more in lists]


def foreign_targets(scores: pd.DataFrame) -> list[Target]:
    """All targets of the proof on random systems, from its table of scores."""
    quiet = scores[scores["kind"] != "withheld"]
    concealed = scores[scores["kind"] == "withheld"]
    known = concealed[concealed["told_effect"] >= STRONG]
    asked, placed = concealed[concealed["gain_asked"]], concealed[concealed["place_asked"]]
    found = [
        share("false alarms among nulls and shifts", quiet["false_alarm"], most=0.01),
        share("place right, where the oracle can tell it", placed["place_right"], least=0.95),
        share(
            "at least 90 % of the oracle's gain, where that exceeds twice its error",
            asked["gain_had"],
            least=0.90,
        ),
        share("wrong names among concealed functions", concealed["wrong_name"], most=0.02),
        share("nulls: “no mismatch”", _of(quiet, "null")["right"]),
        share("shifts: “parameter shift”", _of(quiet, "shift")["right"]),
        share(f"detected, Δχ² ≥ {STRONG:g}", known["detected"]),
        share(
            f"detected, Δχ² < {STRONG:g}",
            concealed[concealed["told_effect"] < STRONG]["detected"],
        ),
        quantile("share of the oracle's gain, median", asked["share_of_gain"], 0.5),
    ]
    for one, some in (("one recording", asked["recordings"] == 1), ("several", asked["recordings"] > 1)):
        found.append(share(f"90 % of the gain, learned from {one}", asked[some]["gain_had"]))
    for level in (40.0, 30.0, 20.0):
        found.append(
            share(f"90 % of the gain at {level:g} dB", asked[asked["noise_db"] == level]["gain_had"])
        )
    for family in ("polynomial", "rational", "mechanical"):
        own = asked["system"].str.startswith(family)
        found.append(share(f"90 % of the gain, {family} systems", asked[own]["gain_had"]))
    found.append(quantile("seconds a case, median", scores["seconds"], 0.5))
    found.append(share("cases without any verdict", scores["verdict"] == FAILED, most=0.0))
    return found


def foreign_failures(scores: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Cases on random systems that count against a target, under a sentence each."""
    quiet, concealed = scores["kind"] != "withheld", scores["kind"] == "withheld"
    held = ["card_error", "oracle_error", "augmented_error", "share_of_gain"]
    where = ["true_place", "said_place", "told_equation", "told_coordinate"]
    lists = [
        ("False alarms: something is said to be missing, and nothing is.", scores["false_alarm"], []),
        ("Nulls and shifts that were taken for each other.",
         quiet & ~scores["right"] & ~scores["false_alarm"] & (scores["verdict"] != FAILED), []),
        ("Names that are not the concealed function.", scores["wrong_name"], ["name_error", "true_place"]),
        ("Places that are wrong, and that an oracle can tell.",
         scores["place_asked"] & ~scores["place_right"], where),
        ("Less than 90 % of the oracle's gain.", scores["gain_asked"] & ~scores["gain_had"], held),
        (f"Functions that were not detected, Δχ² ≥ {STRONG:g}.",
         concealed & (scores["told_effect"] >= STRONG) & ~scores["detected"], ["told_effect"]),
        ("Cases without any verdict, or with something that could not be scored.", scores["note"] != "",
         ["note"]),
    ]  # fmt: skip
    return [
        (said, scores.loc[rows, [*FOREIGN_SHOWN, *more]].reset_index(drop=True)) for said, rows, more in lists
    ]


def _of(scores: pd.DataFrame, kind: str) -> pd.DataFrame:
    return scores[scores["kind"] == kind]


def _target(
    name: str,
    measured: float,
    low: float,
    high: float,
    count: int,
    most: float | None,
    least: float | None,
    *,
    percent: bool,
) -> Target:
    def text(value: float) -> str:
        return f"{100 * value:g} %" if percent else f"{value:g}"

    if most is not None and least is not None:
        limit = f"{text(least)} to {text(most)}"
    else:
        limit = f"≤ {text(most)}" if most is not None else f"≥ {text(least)}" if least is not None else ""
    met = None
    if limit and count:
        met = (most is None or measured <= most) and (least is None or measured >= least)
    return Target(name, limit, measured, low, high, count, met)
