"""Hostile records and honest ones, case by case; then the table.

    python -m benchmarks.hostile [--kinds NAME ...] [--seeds 0 1 ...] [--strengths 0.2 0.5 1] [--honest]
                                 [--held-out] [--jobs 2] [--folder results/hostile] [--table]

Each case is a line of ``cases.csv`` in the folder: an interrupted run goes on where it was, and more seeds
add to those that are there. Remove the folder when the method has changed. A fifth of the kinds is held out,
and runs with ``--held-out`` alone: not before the tests of the certificate are finished.
"""

from __future__ import annotations

import argparse
import csv
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.hostile.catalogue import FAMILIES, HELD_OUT, KINDS
from benchmarks.hostile.scores import as_row, scored

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")  # one each: cases run side by side
Case = tuple[str, int, float, bool]
COLUMNS = (
    "kind", "seed", "strength", "honest", "certified", "claims", "false", "named", "codes", "off", "excess",
    "seconds", "said",
)  # fmt: skip


def cases(
    names: Sequence[str], seeds: Sequence[int], strengths: Sequence[float], *, honest: bool
) -> Iterator[Case]:
    """Seed by seed, so that a run that is stopped early knows a little of every kind."""
    for seed in seeds:
        for strength in strengths:
            yield from ((name, seed, strength, honest) for name in names)


def case(name: str, seed: int, strength: float, honest: bool) -> dict[str, Any]:
    """One case, whatever comes: what siq did not foresee is written down, too."""
    kind = KINDS[name]
    try:
        return as_row(kind, seed, strength, honest, scored(kind, seed, strength, honest=honest))
    except Exception as error:
        fault = f"{type(error).__name__}: {error}"
        row = dict.fromkeys(COLUMNS, "")
        return row | {
            "kind": name, "seed": seed, "strength": strength, "honest": honest, "certified": False,
            "false": False, "named": False, "codes": "traceback", "said": fault, "claims": 0,
        }  # fmt: skip


def read(file: Path) -> pd.DataFrame:
    """The cases that are there."""
    return pd.read_csv(file) if file.exists() else pd.DataFrame(columns=list(COLUMNS))


def table(found: pd.DataFrame) -> pd.DataFrame:
    """One row for every kind: false certificates, honest records certified, refusals that name the flaw."""
    rows = []
    for name, own in found.groupby("kind", sort=False):
        hostile, honest = own[~own.honest.astype(bool)], own[own.honest.astype(bool)]
        refused = hostile[~hostile.certified.astype(bool)]
        rows.append(
            {
                "kind": name,
                "family": FAMILIES[str(name)],
                "cases": len(hostile),
                "certified": int(hostile.certified.sum()),
                "false": int(hostile["false"].sum()),
                "refused": len(refused),
                "named": int(refused.named.sum()),
                "honest": len(honest),
                "honest certified": int(honest.certified.sum()),
                "honest false": int(honest["false"].sum()),
                "seconds": round(float(own.seconds.median()), 1),
            }
        )
    return pd.DataFrame(rows)


def summary(found: pd.DataFrame) -> str:
    """The table, and its shares."""
    if not len(found):
        return "no cases"
    rows = table(found)
    total = rows.sum(numeric_only=True)

    def share(part: str, whole: str) -> str:
        one, other = int(total[part]), int(total[whole])
        return f"{one} of {other}" + (f" ({one / other:.1%})" if other else "")

    lines = [
        rows.to_string(index=False), "",
        f"false certificates: {share('false', 'cases')}",
        f"refusals that name the flaw: {share('named', 'refused')}",
        f"honest records certified: {share('honest certified', 'honest')},"
        f" of them false: {int(total['honest false'])}",
    ]  # fmt: skip
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is missing, and say what came out."""
    parser = argparse.ArgumentParser(prog="benchmarks.hostile", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kinds", nargs="+", choices=sorted(KINDS), metavar="NAME")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(8)))
    parser.add_argument("--strengths", nargs="+", type=float, default=[0.2, 0.5, 1.0])
    parser.add_argument("--honest", action="store_true", help="the honest records instead")
    parser.add_argument("--held-out", action="store_true", help="the kinds that are held out, and no others")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=Path("results/hostile"))
    parser.add_argument("--table", action="store_true", help="only the table of what is there")
    parser.add_argument("--list", action="store_true", help="only the kinds")
    chosen = parser.parse_args(arguments)
    names = [name for name in KINDS if (name in HELD_OUT) == chosen.held_out]
    if chosen.kinds:
        if any((name in HELD_OUT) != chosen.held_out for name in chosen.kinds):
            parser.error("a kind that is held out runs with --held-out, and others do not")
        names = chosen.kinds
    if chosen.list:
        print("\n".join(f"{name}: {KINDS[name].about}" for name in names))
        return
    os.environ |= dict.fromkeys(THREADS, "1")
    file = chosen.folder / "cases.csv"
    file.parent.mkdir(parents=True, exist_ok=True)
    if not chosen.table:
        there = read(file)
        done = set(zip(there.kind, there.seed, there.strength, there.honest, strict=True))
        wanted = [
            one
            for one in cases(names, chosen.seeds, chosen.strengths, honest=chosen.honest)
            if one not in done
        ]
        with (
            ProcessPoolExecutor(chosen.jobs) as pool,
            file.open("a", newline="", encoding="utf-8", buffering=1) as lines,
        ):
            writer = csv.DictWriter(lines, COLUMNS)
            if not file.stat().st_size:
                writer.writeheader()
            running = [pool.submit(case, *one) for one in wanted]
            for number, finished in enumerate(as_completed(running), start=1):
                row = finished.result()
                writer.writerow(row)
                outcome = "FALSE" if row["false"] else "certified" if row["certified"] else row["codes"]
                print(
                    f"{number}/{len(running)} {row['kind']} {row['seed']} {row['strength']}: {outcome}",
                    flush=True,
                )
    print(summary(read(file)))


if __name__ == "__main__":
    main()
