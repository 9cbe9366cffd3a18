# Helpers of the rules: studies and their parameters, tasks and their versions, one workflow at a time.
import gc
import os
import sys
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from filelock import FileLock, Timeout

from siq.errors import InputError
from siq.numerics.files import files_of
from siq.report.formatting import texts
from siq.workflow.answers import Exit, Provenance, answer_of_page
from workflow.places import config_path, find_file
from workflow.published import load_published
from workflow.settings import Studies, prepare_environment
from workflow.tasks import TASKS
from workflow.versions import versions
from workflow.warm import PARENT, end_with_parent, start


def say_and_stop(error):
    """One sentence, no traceback, an exit code that is not 0."""
    print(error, file=sys.stderr)
    sys.exit(1)


@contextmanager
def bad_input_told(refused=InputError):
    """What is wrong with the input is said, and ends the workflow."""
    try:
        yield
    except refused as error:
        say_and_stop(error)


if os.environ.pop(PARENT, None):  # `siq` has started this, and holds its input open
    end_with_parent()
prepare_environment()

# Of 10,000 runs 50,000 jobs are planned, which all stay: a quarter of the time went into looking for garbage among them.
gc.set_threshold(50_000, 20, 1_000)

with bad_input_told():
    STUDIES = Studies(config, configfiles=workflow.configfiles)


REPRODUCED = ["archetype3d", "archetype3d-noise", "archetype4d", "resonator"]
RUN_TABLES = "coefficients rrmse prediction certificates record record_density".split()
FIGURES = texts("captions")["figures"]
CAPTIONS = {name: caption["text"] for name, caption in FIGURES.items()}


wildcard_constraints:
    study="(?!blind-test/)[A-Za-z0-9][A-Za-z0-9_.-]*",  # the blind test is no study
    run="[0-9]+",
    block="[0-9]+-[0-9]+",


@bad_input_told()
def study_of(wildcards):
    """The study of a job, checked when it is first asked for."""
    return STUDIES[wildcards.study]


def task(name):
    """Params of a rule: its task, whose version says when results may change, and the options that it depends on."""
    params = {"task": name, "version": versions()[name]}
    if options := TASKS[name].options:
        params["options"] = lambda wildcards: study_of(wildcards).options(options)
    return params


def tables(*names, of="results/{study}/tables"):
    """Files of tables by their names, of a study where nothing else is said."""
    return {name: f"{of}/{name}.parquet" for name in names}


def points_of_sweep(wildcards):
    """Input function: a file for every point of a sweep."""
    swept = study_of(wildcards).study.sweep
    names = [] if swept is None else swept.point_names
    return expand(
        "results/{study}/sweep/{point}.json", study=wildcards.study, point=names
    )


def file_where(asked, pattern):
    """Input function: a file of studies that ask for it, none for others."""

    def file(wildcards):
        study = study_of(wildcards).study
        return pattern.format(study=wildcards.study) if asked(study) else []

    return file


def with_sweep(name):
    """Input function: a table of studies that sweep a parameter."""
    return file_where(
        lambda study: study.sweep is not None,
        f"results/{{study}}/tables/{name}.parquet",
    )


def with_invariant(pattern):
    """Input function: a file of studies that ask for the invariant distribution."""
    return file_where(lambda study: study.invariant, pattern)


def with_card(pattern):
    """Input function: a file that a card alone can give, none for studies of recordings."""
    return file_where(lambda study: study.recordings is None, pattern)


def landscape_table(name):
    """Input function: a table that a landscape with a card has."""
    return file_where(
        lambda study: study.landscape is not None and study.recordings is None,
        f"results/{{study}}/tables/{name}.parquet",
    )


def block_of(wildcards):
    """The runs that train side by side, of which this run is one."""
    return study_of(wildcards).block(int(wildcards.run))


def all_runs(pattern):
    """Input function: one file for every run of the study."""
    return lambda wildcards: expand(
        pattern, study=wildcards.study, run=study_of(wildcards).run_names()
    )


def has_networks(wildcards):
    """Whether the study asks for networks."""
    return study_of(wildcards).study.training is not None


def of_networks(files):
    """Input function: files of studies that ask for networks, none for others."""
    return lambda wildcards: files(wildcards) if has_networks(wildcards) else []


def of_landscapes(pattern):
    """Input function: a file of every run where the study asks for its landscape, otherwise none."""

    def files(wildcards):
        asked = study_of(wildcards).study.landscape is not None
        return all_runs(pattern)(wildcards) if asked else []

    return files


def all_blocks(pattern):
    """Input function: one file for every block of runs that train side by side, where networks are asked for."""
    return of_networks(
        lambda wildcards: expand(
            pattern, study=wildcards.study, block=study_of(wildcards).block_names()
        )
    )


@bad_input_told()
def data_source(wildcards):
    """Recordings by their content, a folder with its files; a card only as what it says, which is a parameter."""
    study = study_of(wildcards)
    if study.study.recordings is None:
        return {"source": ancient(study.source())}
    check_recordings(wildcards.study)  # which refuses a file that is not there
    folder = Path(study.source())
    files = files_of(folder) if folder.is_dir() else []
    return {"source": study.source(), "files": [str(file) for file in files]}


@cache
@bad_input_told((InputError, ValueError))
def check_recordings(name):
    """Refuse bad recordings once, before any job starts."""
    STUDIES[name].check_recordings()


def of_every_run(name):
    """Input function: a file of each run that trains in a block."""

    def files(wildcards):
        first, last = (int(run) for run in wildcards.block.split("-"))
        return [
            f"results/{wildcards.study}/runs/{run:03d}/{name}"
            for run in range(first, last + 1)
        ]

    return files


def card_if_any(wildcards):
    card = study_of(wildcards).card()
    return [] if card is None else ancient(card)


def published_if_any(wildcards):
    """Input function: the published figures that the study is compared with."""
    return study_of(wildcards).published() or []


def networks_of_runs(name):
    """Input function: for every run, a file of the block in which it trained, where networks are asked for."""

    def files(wildcards):
        study = study_of(wildcards)
        return [
            f"results/{wildcards.study}/training/{study.block(run)}/{name}"
            for run in range(study.study.runs)
        ]

    return of_networks(files)


def training_of_run(wildcards):
    """Input function: the networks of a run and how they came out, where networks are asked for."""
    if not has_networks(wildcards):
        return {}
    block = f"results/{wildcards.study}/training/{block_of(wildcards)}"
    return {"networks": f"{block}/networks.npz", "train_outcome": f"{block}/train.json"}


def regression_of_run(wildcards):
    """Input function: what the published method made of the networks of a run, where there are any."""
    model = f"results/{wildcards.study}/runs/{wildcards.run}/regression.json"
    return model if has_networks(wildcards) else []


def all_outcomes(wildcards):
    """Input function: what became of every step of every run."""
    patterns = {
        "results/{study}/runs/{run}/draw.json": all_runs,
        "results/{study}/runs/{run}/identify.json": all_runs,
        "results/{study}/training/{block}/train.json": all_blocks,
        "results/{study}/runs/{run}/refine.json": all_runs,
        "results/{study}/runs/{run}/score.json": all_runs,
    }
    if has_networks(wildcards):
        patterns["results/{study}/runs/{run}/regress.json"] = all_runs
    if study_of(wildcards).study.landscape is not None:
        patterns["results/{study}/runs/{run}/landscape.json"] = all_runs
    return [path for pattern, of in patterns.items() for path in of(pattern)(wildcards)]


def published_mesh_if_any(wildcards):
    """Input function: the mesh that was published beside the figures, where SIQ_RESOURCES has it."""
    figures = study_of(wildcards).published()
    mesh = load_published(figures).mesh if figures is not None else None
    file = None if mesh is None else find_file(mesh.file)
    return [] if file is None else ancient(file)


def reproduced_settings(wildcards):
    """Params function: the settings of all studies that the page speaks of, those of the paper too."""
    names = [*REPRODUCED, "archetype3d-published", "resonator-published"]
    keys = ("runs", "simulation", "training", "regression", "domain")
    return {name: STUDIES[name].options(keys) for name in names}


def of_reproduced(method):
    """Input function: a file of every study that is reproduced."""
    return lambda wildcards: [getattr(STUDIES[name], method)() for name in REPRODUCED]


# Parts of `snakemake --report`, in the order of the page; Snakemake sorts them by their names.
ANSWER, EVIDENCE, LANDSCAPE, RUNS, PUBLISHED, WORKINGS = (
    "1 The answer",
    "2 Evidence",
    "3 The landscape",
    "4 The runs",
    "5 The published method",
    "6 The workings",
)
PARTS = {
    "lead": ANSWER,
    "evidence": EVIDENCE,
    "record": EVIDENCE,
    "landscape": LANDSCAPE,
    "sweep": LANDSCAPE,
    "runs": RUNS,
    "published": PUBLISHED,
    "workings": WORKINGS,
}


def figure_part(wildcards):
    """The part of Snakemake's report in which a figure stands, as on the page."""
    return PARTS[FIGURES.get(wildcards.name, {"part": "workings"})["part"]]


def figure_labels(wildcards):
    """Labels of a figure in Snakemake's report."""
    return {"shows": wildcards.name.replace("_", " "), "kind": "figure"}


def say_what_has_no_answer():
    """A study without a formula, or a simulation that cannot be compared, is no success: code 3, and why."""
    pages = [
        Path(output)
        for job in workflow.dag.jobs
        if job.rule.name in ("page", "equations_page", "mismatch_page")
        for output in job.output
        if str(output).endswith("report.html")
    ]
    told = {page: answer_of_page(page) for page in pages}
    for page, (lines, code) in told.items():
        if code == Exit.NO_ANSWER:
            print(*lines, f"The page to read: {page}", sep="\n", file=sys.stderr)
    if Exit.NO_ANSWER in [code for _, code in told.values()]:
        sys.exit(int(Exit.NO_ANSWER))


# Snakemake's own lock outlives a killed process and would ask for --unlock; the profile switches it off.
# The kernel's lock goes with the process.
LOCK = FileLock(".snakemake/siq.lock", timeout=0)
WARM = None

# What is not as its job wrote it is made again, before anything is built upon it.
with suppress(Timeout), LOCK:  # whoever has it is writing
    PLANNED = bool({"-n", "--dry-run", "--dryrun"} & set(sys.argv))
    Provenance.mend(Path("results"), planned=PLANNED)


onstart:
    # With a limit each job leaves a timer that wakes the scheduler while any job waits (pull request 3744).
    workflow.scheduler.job_rate_limiter = None
    try:
        LOCK.acquire()
    except Timeout:
        say_and_stop(
            "Another snakemake is at work in this folder; wait for it, or stop it."
        )
    globals()[
        "WARM"
    ] = start()  # held until the end of this process, and ends with it


onsuccess:
    say_what_has_no_answer()
