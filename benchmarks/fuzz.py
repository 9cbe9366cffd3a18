"""Readers against files that nobody means: mutations of the shipped cards, studies, tables and results.

    python -m benchmarks.fuzz --tries 5000 --log fuzz.jsonl

Each try is a seed: it chooses a file and a reader, changes the file, and reads it. An answer is allowed, and
an error of ours in one line; anything else (another exception, a warning that ends the process, more than
20 s, a file opened for writing outside the folder of the try) is a fault, which the log keeps with its seed.
Tries in the log are not made again. With ``--command N`` every Nth try of a card, a study or recordings is
given to ``siq run --dry-run`` as well.
"""

from __future__ import annotations

import argparse
import faulthandler
import io
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from siq.errors import InputError, MissingExtra, NumericalFailure

ROOT = Path(__file__).resolve().parents[1]
LONGEST = 20  # seconds of one try
OURS = (InputError, MissingExtra, NumericalFailure)
BATCH = 100  # tries of one process, which may die of one

TOKENS = (
    "1e300", "-1e-300", "nan", ".inf", "-0", "1e999", "9" * 400, "null", "~", "true", "[]", "{}", "[[[[1]]]]",
    "''", "'\\0'", "x", "t", "pi", "integer_power", "lambda", "µ", "Ω", "ｘ", "ß", "‮abc", "{x}",
    "../../x", "~root.csv", "/dev/null", "a" * 300, "x**x**x", "x**33", "Max(Max(x,1),Max(1,x))", "1/0",
    "sqrt(-1)", "exp(exp(exp(x)))", "__import__('os')", "log(0)", "(" * 60 + "x" + ")" * 60, "*a", "&a x",
    "!!python/object:os.system", "!!binary aaaa", "2001-99-99", "0x", "1_000", "1:30", "? [a]\n: b",
    "<<: {a: 1}",
    ",", ";", "\t", "\"", "#", ":", "\n", "\r", "\x00", "\ufeff", "-", "1", "0", "-1", "2.5", "1e30", "1e-30",
)  # fmt: skip


def corpus(folder: Path) -> dict[str, list[tuple[str, bytes]]]:
    """Files to begin with, by the kind of their reader: suffix and content."""
    import pandas as pd

    from siq.data.recordings import read_recordings
    from siq.workflow import examples
    from siq.workflow.pipeline import analyse
    from siq.workflow.study import PipelineSettings
    from workflow.files import write

    made: dict[str, list[tuple[str, bytes]]] = {}
    for kind, place in (
        ("card", "systems"), ("study", "studies"), ("mismatch", "mismatch"), ("published", "published"),
    ):  # fmt: skip
        made[kind] = [
            (".yaml", path.read_bytes()) for path in sorted((ROOT / "config" / place).glob("*.yaml"))
        ]
    made["card"].append(
        (".yaml", Path(examples.__file__).with_name("studies").joinpath("spring.yaml").read_bytes())
    )
    text = examples.double_well_recordings(2, 1500)
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "recordings.csv"
    file.write_text(text, encoding="utf-8")
    short = "".join(text.splitlines(keepends=True)[:40])
    table = pd.read_csv(io.StringIO(short))
    made["recordings"] = [
        (".csv", short.encode()), (".tsv", short.replace(",", "\t").encode()),
        (".csv", short.replace(",", ";").replace(".", ",").encode()),
        (".dat", short.replace(",", " ").encode()),
        (".txt", short.encode("utf-16")),
    ]  # fmt: skip
    arrays: dict[str, Any] = {"t": table.iloc[:, 1].to_numpy(), "x": table.iloc[:, 2].to_numpy()}
    for suffix, store in (
        (".parquet", lambda path: table.to_parquet(path)), (".npz", lambda path: np.savez(path, **arrays)),
        (".npy", lambda path: np.save(path, np.stack([*arrays.values()], axis=1))),
        (".mat", lambda path: __import__("scipy.io").io.savemat(path, arrays)),
    ):  # fmt: skip
        store(folder / f"table{suffix}")
        made["recordings"].append((suffix, (folder / f"table{suffix}").read_bytes()))
    found = analyse(read_recordings(file))
    settings = PipelineSettings()
    parts = (found.refined.formulas, found.refined.certificates)
    assert found.identified.result is not None and found.landscape is not None
    for name, value in (
        ("field", found.identified.result), ("model", parts), ("quasipotential", found.landscape.result),
        ("landscape_outcome", list(found.outcomes)),
    ):  # fmt: skip
        write(name, folder / f"{name}.json", value, settings)
        made[name] = [(".json", (folder / f"{name}.json").read_bytes())]
    made["table"] = [(".parquet", (folder / "table.parquet").read_bytes())]
    made["answer"] = [(".json", json.dumps({
        "sentence": "a sentence", "formulas": True, "runs": 1, "certified": "all", "failed": 0,
    }).encode())]  # fmt: skip
    return made


def readers(folder: Path) -> dict[str, Callable[[Path], Any]]:
    """What reads a file of each kind."""
    from siq.data.inspection import inspect
    from siq.diagnosis.study import load_mismatch_study
    from siq.inference.field_estimate import read_field
    from siq.quasipotential.landscape_files import read_landscape
    from siq.systems.cards import load_exact, load_system
    from siq.workflow.answers import answer_of_page
    from siq.workflow.study import load_study, load_study_system, settings_of
    from workflow.files import read
    from workflow.published import load_published

    field = read_field(folder / "field.json")
    assert field is not None
    dynamics = field.dynamics

    def card(path: Path) -> None:
        from siq.quasipotential.landscape_assembly import usable_system

        load_exact(path)
        load_system(path)
        usable_system(path)

    def study(path: Path) -> None:
        found = load_study(path)
        known = ROOT / "config" / "systems" / f"{found.system}.yaml"
        system = load_study_system(found, known if known.is_file() else None, file=str(path))
        if system is not None or found.recordings is not None:
            settings_of(found, system)

    def answer(path: Path) -> None:
        path.rename(path.parent / "answer.json")
        answer_of_page(path.parent / "report.html")

    return {
        "card": card, "study": study, "mismatch": load_mismatch_study, "published": load_published,
        "recordings": lambda path: inspect(path).text(), "answer": answer,
        "quasipotential": lambda path: read_landscape(path, dynamics=dynamics),
        **{name: partial(read, name) for name in ("field", "model", "landscape_outcome", "table")},
    }  # fmt: skip


def mutated(content: bytes, draw: np.random.Generator) -> bytes:
    """The content with one to four changes: of bytes, of words, of lines, of its length."""
    for _ in range(draw.integers(1, 5)):
        how = draw.integers(7)
        if not content:
            content = b"x"
        begin, end = sorted(int(one) for one in draw.integers(0, len(content) + 1, 2))
        if how == 0:  # bytes flipped
            array = np.frombuffer(content, np.uint8).copy()
            for place in draw.integers(0, len(array), draw.integers(1, 6)):
                array[place] ^= np.uint8(1 << draw.integers(8))
            content = array.tobytes()
        elif how in (1, 2):  # a word in the place of another
            text = content.decode("utf-8", "surrogateescape")
            words = [*_words(text)]
            token = TOKENS[draw.integers(len(TOKENS))]
            if words:
                one, other = words[draw.integers(len(words))]
                text = text[:one] + token + text[other:]
            content = text.encode("utf-8", "surrogateescape")
        elif how == 3:  # a line twice, or gone, or moved
            lines = content.splitlines(keepends=True)
            place = int(draw.integers(len(lines)))
            taken = lines.pop(place)
            for _ in range(draw.integers(3)):
                lines.insert(int(draw.integers(len(lines) + 1)), taken)
            content = b"".join(lines)
        elif how == 4:  # a piece out
            content = content[:begin] + content[min(end, begin + 40) :]
        elif how == 5:  # cut off
            content = content[:end] if draw.integers(2) else content[begin:]
        else:  # a piece repeated
            content = content[:end] + content[begin:end] * int(draw.integers(1, 4)) + content[end:]
    return content[:5_000_000]


def _words(text: str) -> Iterator[tuple[int, int]]:
    import re

    for match in re.finditer(r"[^\s,:;{}\[\]\"']+", text):
        yield match.span()


WRITTEN: list[str] = []
"""Files that were opened for writing in a try."""


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    writing = os.O_WRONLY | os.O_RDWR | os.O_CREAT
    if event == "open" and isinstance(arguments[0], str) and (arguments[2] or 0) & writing:
        WRITTEN.append(str(Path(arguments[0]).absolute()))
    elif event in ("os.mkdir", "os.rename", "os.remove", "os.rmdir"):
        WRITTEN.append(str(Path(os.fsdecode(arguments[0])).absolute()))


class TooLong(BaseException):
    """A try that takes too long."""


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Raise `TooLong` after so many seconds of work."""

    def stop(number: int, frame: object) -> None:
        raise TooLong

    signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)  # of work, for other processes have the machine, too
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def attempt(
    seed: int, files: dict[str, Any], known: dict[str, Any], *, command: bool = False
) -> dict[str, Any]:
    """One try: what came of it."""
    draw = np.random.default_rng(seed)
    kind = sorted(files)[draw.integers(len(files))]
    suffix, content = files[kind][draw.integers(len(files[kind]))]
    changed, fault, began = mutated(content, draw), "", time.process_time()
    with tempfile.TemporaryDirectory(prefix="siq-fuzz-") as folder:
        path = Path(folder, f"file{suffix}")
        path.write_bytes(changed)
        before = Path.cwd()
        os.chdir(folder)
        WRITTEN.clear()
        try:
            with at_most(LONGEST):
                known[kind](path)
            how = "read"
        except OURS as error:
            how = "refused"
            if "\n" in str(error).strip():
                fault = f"more than one line: {str(error)[:300]!r}"
        except TooLong:
            how, fault = "fault", f"more than {LONGEST} s"
        except BaseException as error:
            how = "fault"
            where = " < ".join(
                f"{Path(one.filename).name}:{one.lineno}"
                for one in reversed(traceback.extract_tb(error.__traceback__)[-4:])
            )
            fault = f"{type(error).__name__}: {str(error)[:200]} at {where}"
        finally:
            os.chdir(before)
        outside = [one for one in WRITTEN if not one.startswith((folder, "/dev/"))]
        if outside and not fault:
            fault = f"wrote {outside[:3]}"
        if command and not fault and kind in ("card", "study", "recordings"):
            fault = _by_command(path, kind)
            how += " and by command"
    seconds = round(time.process_time() - began, 2)
    return {"seed": seed, "kind": kind, "how": how, "fault": fault, "seconds": seconds}


def _by_command(path: Path, kind: str) -> str:
    """The fault of ``siq run --dry-run`` on a file, empty for none."""
    given = path
    if kind == "card":
        given = path.with_name("study.yaml")
        given.write_text(f"name: mine\nsystem: {path.name}\nfrom: equations\n", encoding="utf-8")
    words = [sys.executable, "-m", "siq", "run", "-n", str(given.name)]
    try:
        done = subprocess.run(
            words, cwd=path.parent, capture_output=True, timeout=10 * LONGEST, check=False,
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])},
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"the command took more than {10 * LONGEST} s on a busy machine"
    said = (done.stdout + done.stderr).decode("utf-8", "replace")
    if "Traceback" in said or done.returncode not in (0, 1):
        return f"code {done.returncode}: {said[-400:]}"
    return ""


def run(seeds: list[int], log: Path, *, every: int = 0) -> list[dict[str, Any]]:
    """Make tries in processes of their own, one after the other, and append what came of them to a log."""
    folder = Path(tempfile.mkdtemp(prefix="siq-fuzz-corpus-"))
    files = corpus(folder)
    known = readers(folder)
    sys.stdout.flush()
    while seeds:
        batch, seeds = seeds[:BATCH], seeds[BATCH:]
        child = os.fork()
        if child == 0:
            sys.addaudithook(_watch)
            faulthandler.disable()
            with log.open("a", encoding="utf-8") as lines:
                for seed in batch:
                    told = attempt(seed, files, known, command=bool(every) and seed % every == 0)
                    lines.write(json.dumps(told) + "\n")
                    lines.flush()
            os._exit(0)
        _, status = os.waitpid(child, 0)
        if status:  # it died of a try, the first that is not in the log
            done = {one["seed"] for one in read_log(log)}
            died = next(seed for seed in batch if seed not in done)
            told = {"seed": died, "kind": "", "how": "fault", "fault": f"the process ended: {status}"}
            with log.open("a", encoding="utf-8") as lines:
                lines.write(json.dumps(told) + "\n")
            seeds = [seed for seed in batch if seed not in done and seed != died] + seeds
    return read_log(log)


def read_log(log: Path) -> list[dict[str, Any]]:
    """What came of every try so far."""
    if not log.is_file():
        return []
    return [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines() if line.strip()]


def main() -> None:
    """Make the tries that are not in the log, and say what came of all."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fuzz", description=__doc__)
    parser.add_argument("--tries", type=int, default=5000)
    parser.add_argument("--first", type=int, default=0, help="seed of the first try")
    parser.add_argument("--log", type=Path, default=Path("fuzz.jsonl"))
    parser.add_argument(
        "--command", type=int, default=0, metavar="N", help="give every Nth to the command, too"
    )
    given = parser.parse_args()
    done = {one["seed"] for one in read_log(given.log)}
    seeds = [seed for seed in range(given.first, given.first + given.tries) if seed not in done]
    told = run(seeds, given.log, every=given.command)
    faults = [one for one in told if one["fault"]]
    kinds = {how: sum(one["how"].startswith(how) for one in told) for how in ("read", "refused", "fault")}
    print(
        f"{len(told)} tries: {kinds}; the longest took {max(one.get('seconds', 0) for one in told)} s of work"
    )
    for one in faults:
        print(f"seed {one['seed']} ({one['kind']}): {one['fault']}")
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
