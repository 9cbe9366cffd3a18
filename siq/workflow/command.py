"""The command ``siq``: what can be written after it, and with which code it ends."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from siq.errors import InputError, MissingExtra, NumericalFailure, version
from siq.workflow.answers import Exit

EPILOG = """\
what to begin with:
  siq example                     writes recordings and a study to try
  siq inspect my-recordings.csv   says what is in your file, in seconds
  siq run my-recordings.csv       answers, and names the page to read

exit codes: 0 there is an answer; 1 a file cannot be used, or a step stopped; 2 the command was not
understood; 3 everything ran and no formula came of it, the page says why; 130 you stopped it.
"""


def parser() -> argparse.ArgumentParser:
    """The parser of the command line, from which its page in the documentation is made."""
    top = argparse.ArgumentParser(
        prog="siq",
        description="From recordings to their landscape: stable states, barriers, how long each state lasts;"
        " and which physics a simulation lacks.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"siq {version()}")
    commands = top.add_subparsers(title="commands", metavar="COMMAND", required=True)
    one = commands.add_parser(
        "run",
        help="answer a study, or recordings without a study",
        description="Works out the landscape behind recordings or a system, and writes"
        " results/NAME/report.html in the folder in which you are.",
        epilog="What stands after -- is passed on to Snakemake: siq run my-study.yaml -- --forceall",
    )
    one.add_argument(
        "given",
        metavar="FILE",
        help="a study (.yaml), recordings (a file, or a folder with one file for each recording), or the name"
        " of a study that comes with siq, such as archetype3d",
    )
    _add_workflow_options(one, "run_study")
    one = commands.add_parser(
        "diagnose",
        help="say which physics a simulation lacks",
        description="Compares the equations of a simulation with recordings, and writes"
        " results/mismatch/NAME/report.html in the folder in which you are.",
        epilog="What stands after -- is passed on to Snakemake.",
    )
    one.add_argument(
        "given",
        metavar="DIR",
        help="a folder with system.yaml (the equations) and recordings.csv or recordings.parquet, or a folder"
        " of such folders",
    )
    _add_workflow_options(one, "diagnose_cases")
    one = commands.add_parser(
        "inspect",
        help="say what is in a file of recordings, in seconds",
        description="Reads recordings and says what is in them: states, units, steps, noise, and what can be"
        " learned from them. Computes nothing else and writes nothing.",
    )
    one.add_argument(
        "recordings", metavar="FILE", nargs="+", help="a file of recordings, or a folder of files"
    )
    one.set_defaults(action=_inspect)
    one = commands.add_parser(
        "verify",
        help="derive again what a page claims",
        description="Compares the files of a result with what the steps wrote, and derives its numbers again:"
        " trajectories, f, certificate, formulas and a barrier. Says what it could not derive. Ends with"
        " code 1 where something differs.",
    )
    one.add_argument("result", metavar="RESULT", help="a folder of results, results/NAME, or the page in it")
    one.set_defaults(action=_verify)
    one = commands.add_parser(
        "init",
        help="write a commented study for a file of recordings",
        description="Looks at recordings and writes a study for them that runs as it is, with comments on"
        " what you can set.",
    )
    one.add_argument("recordings", metavar="FILE", help="a file of recordings, or a folder of files")
    one.add_argument("--output", "-o", metavar="STUDY", help="where to write it (default: NAME.yaml here)")
    one.add_argument("--force", action="store_true", help="replace a study that is there already")
    one.set_defaults(action=_init)
    one = commands.add_parser(
        "example",
        help="write recordings and a study to try",
        description="Writes an example into a folder: recordings of a bead in two optical traps with a study,"
        " or a simulation that lacks something with the recordings that show it.",
    )
    one.add_argument(
        "name", nargs="?", default="double-well", choices=("double-well", "mismatch"),
        help="double-well (default): for siq run; mismatch: for siq diagnose",
    )  # fmt: skip
    one.add_argument("--folder", default=".", metavar="DIR", help="where to write it (default: here)")
    one.add_argument("--force", action="store_true", help="replace files that are there already")
    one.set_defaults(action=_example)
    return top


def _add_workflow_options(one: argparse.ArgumentParser, function: str) -> None:
    """What `run` and `diagnose` have in common; `function` is of `siq.workflow.launch`."""
    one.add_argument("--cores", "-c", default="all", metavar="N", help="how many cores to use (default: all)")
    one.add_argument("--dry-run", "-n", action="store_true", help="only say which steps would run")
    one.add_argument("--verbose", "-v", action="store_true", help="show all that Snakemake says")
    one.set_defaults(further=(), action=_launch, function=function)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command, and say what is wrong in one sentence where something is.

    Parameters
    ----------
    arguments
        What stands after ``siq``; by default what was written in the terminal.

    Returns
    -------
    int
        The exit code; see `siq.workflow.answers.Exit`.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    own, further = given, []
    if "--" in given:  # what stands behind it is for Snakemake
        place = given.index("--")
        own, further = given[:place], given[place + 1 :]
    options = parser().parse_args(own)
    if further and "further" not in options:
        parser().error("only run and diagnose pass on what stands after --")
    options.further = further
    action: Callable[[argparse.Namespace], Exit] = options.action
    try:
        return int(action(options))
    except (InputError, MissingExtra, NumericalFailure) as error:
        print(error, file=sys.stderr)
        return int(Exit.FAULT)
    except KeyboardInterrupt:
        print("Stopped.", file=sys.stderr)
        return int(Exit.INTERRUPTED)
    except OSError as error:
        print(f"{error.filename or 'A file'}: {error.strerror or error}.", file=sys.stderr)
        return int(Exit.FAULT)


# Each command imports what it needs only then: `siq --help` answers at once.


def _launch(options: argparse.Namespace) -> Exit:
    from siq.workflow import launch

    cores = options.cores
    if cores != "all" and not (cores.isdigit() and int(cores) > 0):
        raise InputError("--cores", "", f"'{cores}' is not a number of cores", "write 1 or more, or all")
    asked = launch.Request(
        cores=cores, verbose=options.verbose, dry_run=options.dry_run, further=tuple(options.further)
    )
    ended: Exit = getattr(launch, options.function)(options.given, asked)
    return ended


def _inspect(options: argparse.Namespace) -> Exit:
    from siq.data.inspection import inspect as inspect_recordings

    for file in options.recordings:
        print(inspect_recordings(file).text())
    return Exit.ANSWERED


def _verify(options: argparse.Namespace) -> Exit:
    from siq.remarks import sentence
    from siq.workflow.verification import verify

    found = []
    for kind, remark in verify(options.result):
        print(f"{TOLD[kind]}{sentence(remark)}", flush=True)
        found.append(kind)
    print("It does not hold." if "differs" in found else "All that was derived again agrees.")
    return Exit.FAULT if "differs" in found else Exit.ANSWERED


TOLD = {"agrees": "agrees:       ", "differs": "DIFFERS:      ", "open": "not derived:  "}


def _init(options: argparse.Namespace) -> Exit:
    from siq.workflow.examples import init_study

    written = init_study(
        Path(options.recordings),
        output=None if options.output is None else Path(options.output),
        replace=options.force,
    )
    print(f"Wrote {written}. Read its comments, then: siq run {written}")
    return Exit.ANSWERED


def _example(options: argparse.Namespace) -> Exit:
    from siq.workflow.examples import write_example

    files, command = write_example(options.name, Path(options.folder), replace=options.force)
    print("Wrote " + " and ".join(map(str, files)) + f". Try it: {command}")
    return Exit.ANSWERED
