"""Run the examples of the gallery and keep what they show: `python docs/make/gallery.py [NAME ...]`.

Each script runs by itself in an empty folder. What it prints becomes `outputs/NAME/output.txt`, its figures
`figure.png`, and its variable `table` becomes `table.csv`. `made-from.json` holds the digest of the script's
text, so that a test can tell when an output belongs to an older text.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import runpy
import subprocess
import sys
import tempfile
import time
from pathlib import Path

GALLERY = Path(__file__).parents[1] / "gallery"
OUTPUTS = GALLERY / "outputs"
DOTS = 110  # per inch: legible on a phone, and some tens of kilobytes
DIGITS = "{:.4g}".format


def digest(script: Path) -> str:
    """SHA-256 of the text, whatever the line ends of the checkout."""
    return hashlib.sha256(script.read_text(encoding="utf-8").encode()).hexdigest()


def run_here(script: Path, folder: Path) -> None:
    """Run one example in this process, in an empty folder, and write its outputs."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    matplotlib.rcParams["figure.figsize"] = (6.4, 4.4)
    text, begin = io.StringIO(), time.perf_counter()
    with tempfile.TemporaryDirectory() as empty, contextlib.chdir(empty), contextlib.redirect_stdout(text):
        names = runpy.run_path(str(script))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "output.txt").write_text(text.getvalue(), encoding="utf-8")
    for number in pyplot.get_fignums():
        name = "figure.png" if number == 1 else f"figure-{number}.png"
        pyplot.figure(number).savefig(folder / name, dpi=DOTS, metadata={"Software": None})
    names["table"].to_csv(folder / "table.csv", index=False, float_format=DIGITS)
    record = {"script": script.name, "sha256": digest(script), "seconds": round(time.perf_counter() - begin)}
    (folder / "made-from.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def main(names: list[str]) -> None:
    """Run the examples named, or all, each in a process of its own."""
    scripts = sorted(GALLERY.glob("*.py"))
    chosen = [one for one in scripts if not names or one.stem in names]
    if unknown := set(names) - {one.stem for one in scripts}:
        sys.exit(
            f"there is no example {', '.join(sorted(unknown))}; there are {[one.stem for one in scripts]}"
        )
    root = str(GALLERY.parents[1])
    for script in chosen:
        print(script.stem, flush=True)
        command = [sys.executable, __file__, "--here", script.stem]
        subprocess.run(command, check=True, env=os.environ | {"PYTHONPATH": root})


if __name__ == "__main__":
    if sys.argv[1:2] == ["--here"]:
        run_here(GALLERY / f"{sys.argv[2]}.py", OUTPUTS / sys.argv[2])
    else:
        main(sys.argv[1:])
