# What the rules of a diagnosis share: cases and their files.
from benchmarks.publication.public_recordings import BENCHMARKS
from workflow.cases import Cases

MISMATCH = "results/mismatch/{case}/tables"
MISMATCH_TABLES = ["curves", "candidates", "held_out", "forces", "noise"]

with bad_input_told():
    CASES = Cases(config)


wildcard_constraints:
    case="[A-Za-z0-9][A-Za-z0-9_.-]*",
    benchmark="|".join(BENCHMARKS),


@bad_input_told()
def case_of(wildcards):
    """The case of a job, checked when it is first asked for."""
    return CASES[wildcards.case]


def case_file(name):
    """Input function: a file of the case; card and study count by content, which is a parameter."""

    def file(wildcards):
        found = getattr(case_of(wildcards), name)
        if found is None:
            return []
        return found if name == "recordings" else ancient(found)

    return file


@bad_input_told()
def raw_file(wildcards):
    return CASES.raw_file(wildcards.benchmark)


def scores_if_any(wildcards):
    """Input function: scores in units of their own, which public benchmarks have."""
    if case_of(wildcards).benchmark is None:
        return []
    return f"results/mismatch/{wildcards.case}/tables/official_tests.parquet"


@bad_input_told()
def mismatch_pages(wildcards):
    """Input function: pages of the studies that can run; of the others it says what is missing."""
    names, missing = CASES.listed()
    for sentence in missing:
        print(sentence, file=sys.stderr)
    return expand("results/mismatch/{case}/report.html", case=names)


def of_folder(pattern):
    """Input function: a file of every case of the folder."""
    return bad_input_told()(lambda wildcards: expand(pattern, case=CASES.in_folder()))
