"""Targets of the second proof: what was to be reached, what was measured, and what counts against it."""

from __future__ import annotations

import pandas as pd

from workflow.proof.foreign_scores.scores import KNOWN
from workflow.proof.scoring import FAILED
from workflow.proof.targets import Target, quantile, share

SHOWN = [
    "case", "system", "kind", "law", "noise_db", "sensors", "recordings", "verdict", "named", "described",
]  # fmt: skip


def foreign_targets(scores: pd.DataFrame) -> list[Target]:
    """All targets, from the table of scores."""
    quiet = scores[scores["kind"] != "withheld"]
    concealed = scores[scores["kind"] == "withheld"]
    known = concealed[concealed["told_effect"] >= KNOWN]
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
        share(f"detected, Δχ² ≥ {KNOWN:g}", known["detected"]),
        share(
            f"detected, Δχ² < {KNOWN:g}",
            concealed[concealed["told_effect"] < KNOWN]["detected"],
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
    """Cases that count against a target, under a sentence each."""
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
        (f"Functions that were not detected, Δχ² ≥ {KNOWN:g}.",
         concealed & (scores["told_effect"] >= KNOWN) & ~scores["detected"], ["told_effect"]),
        ("Cases without any verdict, or with something that could not be scored.", scores["note"] != "",
         ["note"]),
    ]  # fmt: skip
    return [(said, scores.loc[rows, [*SHOWN, *more]].reset_index(drop=True)) for said, rows, more in lists]


def _of(scores: pd.DataFrame, kind: str) -> pd.DataFrame:
    return scores[scores["kind"] == kind]
