"""Compute the groups, and write them down or hold them against what is written down.

    python -m benchmarks.golden [GROUP ...] [--write] [--results DIR] [--elsewhere] [--spread]

One line for each item; exit code 1 where something differs.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.golden.table import LEARNED, Table, compared, plain, read, write

GROUPS = {  # and the modules that have them
    "equations": "landscapes",
    "records": "landscapes",
    "studies": "studies",
    "diagnosis": "diagnosis",
    "laboratories": "laboratories",
}
FOLDER = Path(__file__).parents[2] / "tests" / "golden"


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute, and write or compare; the exit code."""
    parser = argparse.ArgumentParser(prog="benchmarks.golden", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("groups", nargs="*", metavar="GROUP", help=f"{', '.join(GROUPS)}; by default all")
    parser.add_argument("--write", action="store_true", help="write the tables, compare nothing")
    parser.add_argument("--results", type=Path, default=Path("results"), help="of a finished run of studies")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="where the tables are")
    parser.add_argument(
        "--elsewhere", action="store_true",
        help="the results are of another kind of processor: hold nothing that networks alone say",
    )  # fmt: skip
    parser.add_argument("--spread", action="store_true", help="say by how much numbers are off, by quantity")
    chosen = parser.parse_args(arguments)
    if unknown := set(chosen.groups) - GROUPS.keys():
        parser.error(f"there is no group {', '.join(sorted(unknown))}; there are {', '.join(GROUPS)}")
    same = [run(group, chosen) for group in chosen.groups or GROUPS]
    return int(not all(same))


def run(group: str, chosen: argparse.Namespace) -> bool:
    """One group; whether all of it is as written down."""
    module = importlib.import_module(f"benchmarks.golden.{GROUPS[group]}")
    path = chosen.folder / f"{group}.json"
    known, began, same = read(path), time.process_time(), 0
    found: dict[str, Any] = {}
    worst: dict[str, float] = {}
    for item, quantities in getattr(module, group)(chosen.results):
        found[item] = plain(quantities)
        pairs = list(compared(known.items.get(item, {}), found[item], known.tolerances))
        if chosen.elsewhere:
            pairs = [one for one in pairs if not one.name.startswith(LEARNED)]
        different = [] if chosen.write else [one.text for one in pairs if not one.same]
        same += not different
        seconds = time.process_time() - began
        print(f"{'DIFF' if different else 'ok  '} {group}: {item} ({seconds:.0f} s)", flush=True)
        print(*(f"       {text}\n" for text in different), sep="", end="", flush=True)
        for name, off in ((one.name.split(" ")[0], one.off) for one in pairs):
            worst[name] = max(worst.get(name, 0.0), off)
    # Studies whose results are not there say nothing, for or against.
    absent = {item: one for item, one in known.items.items() if item not in found}
    skipped = module.skipped(absent, chosen.results) if group == "studies" else []
    if chosen.write:
        write(path, Table(module.TOLERANCES[group], found | {item: absent[item] for item in skipped}))
        return True
    for item in absent:
        print("skip" if item in skipped else "GONE", f"{group}: {item}")
    for name, off in sorted(worst.items()) if chosen.spread else ():
        print(f"       {name}: {off:.1e}")
    print(f"{group}: {same} of {len(known.items)} items the same, {len(skipped)} skipped")
    return same > 0 and same == len(found) and len(absent) == len(skipped)


if __name__ == "__main__":
    sys.exit(main())
