# Helpers of the rules: studies and their parameters, code dependencies by content, one workflow at a time.
import fcntl
import os
import sys
from pathlib import Path

from workflow.settings import Studies, code_digest
from siq.errors import InputError

# Jobs run side by side, each on the threads that its rule names, and the same whatever --cores says.
os.environ["OMP_NUM_THREADS"] = "1"
# Training frees and takes arrays of some 100 kB all the time; glibc would return them to the system each
# time, which costs a fifth of a step.
os.environ.setdefault("MALLOC_MMAP_THRESHOLD_", str(2**30))
os.environ.setdefault("MALLOC_TRIM_THRESHOLD_", str(2**33))


def say_and_stop(error):
    """One sentence, no traceback, an exit code that is not 0."""
    print(error, file=sys.stderr)
    sys.exit(1)


try:
    STUDIES = Studies(config, configfiles=workflow.configfiles)
except InputError as error:
    say_and_stop(error)


wildcard_constraints:
    study="[A-Za-z0-9][A-Za-z0-9_.-]*",
    run="[0-9]+",
    block="[0-9]+-[0-9]+",


def study_of(wildcards):
    """The study of a job, checked when it is first asked for."""
    try:
        return STUDIES[wildcards.study]
    except InputError as error:
        say_and_stop(error)


def statistics_studies():
    return STUDIES.default_names()


def parameters(*keys):
    """Params function: the named parts of the study, so that only their change reruns a rule."""
    return lambda wildcards: study_of(wildcards).parameters(*keys)


def code(script):
    """Params: fingerprint of the script and of every module of siq that it imports, by content."""
    return code_digest(Path(workflow.basedir), script)


def block_of(wildcards):
    """The runs that train side by side, of which this run is one."""
    return study_of(wildcards).block(int(wildcards.run))


def all_runs(pattern):
    """Input function: one file for every run of the study."""
    return lambda wildcards: expand(
        pattern, study=wildcards.study, run=study_of(wildcards).run_names()
    )


def all_blocks(pattern):
    """Input function: one file for every block of runs that train side by side."""
    return lambda wildcards: expand(
        pattern, study=wildcards.study, block=study_of(wildcards).block_names()
    )


# Snakemake's own lock outlives a killed process and would ask for --unlock; the profile switches it off.
# The kernel's lock goes with the process.
LOCK = None


onstart:
    globals()["LOCK"] = open(".snakemake/siq.lock", "w")
    try:
        fcntl.flock(LOCK, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        say_and_stop(
            "Another snakemake is at work in this folder; wait for it, or stop it."
        )
