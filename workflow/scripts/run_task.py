"""Run the task that the rule names, in a fork of the warm interpreter where there is one."""

from workflow.warm import run_warm

run_warm(snakemake.params.task)  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)

from workflow.tasks import run

run(snakemake)  # type: ignore[name-defined]  # noqa: F821
