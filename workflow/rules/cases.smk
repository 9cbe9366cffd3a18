# What the rules of a diagnosis share: cases and their files.
from benchmarks.publication.public_recordings import BENCHMARKS
from workflow.cases import Cases

MISMATCH_TABLES = ["curves", "candidates", "held_out", "forces", "noise"]

try:
    CASES = Cases(config)
except InputError as error:
    say_and_stop(error)


wildcard_constraints:
    case="[A-Za-z0-9][A-Za-z0-9_.-]*",
    benchmark="|".join(BENCHMARKS),


def case_of(wildcards):
    """The case of a job, checked when it is first asked for."""
    try:
        return CASES[wildcards.case]
    except InputError as error:
        say_and_stop(error)


def case_file(name):
    """Input function: a file of the case; card and study count by content, which is a parameter."""

    def file(wildcards):
        found = getattr(case_of(wildcards), name)
        if found is None:
            return []
        return found if name == "recordings" else ancient(found)

    return file


def raw_file(wildcards):
    try:
        return CASES.raw_file(wildcards.benchmark)
    except InputError as error:
        say_and_stop(error)


def scores_if_any(wildcards):
    """Input function: scores in units of their own, which public benchmarks have."""
    if case_of(wildcards).benchmark is None:
        return []
    return f"results/mismatch/{wildcards.case}/tables/official_tests.parquet"


def mismatch_pages(wildcards):
    """Input function: pages of the studies that can run; of the others it says what is missing."""
    try:
        names, missing = CASES.listed()
    except InputError as error:
        say_and_stop(error)
    for sentence in missing:
        print(sentence, file=sys.stderr)
    return expand("results/mismatch/{case}/report.html", case=names)


def diagnosed_pages(wildcards):
    """Input function: the page of every case of the folder."""
    try:
        names = CASES.in_folder()
    except InputError as error:
        say_and_stop(error)
    return expand("results/mismatch/{case}/report.html", case=names)
