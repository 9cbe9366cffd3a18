"""Many runs on a cluster: Slurm itself, its controller and two nodes on one machine, one of which dies.

It needs the daemons of Slurm and MUNGE (Debian: ``slurmctld slurmd slurm-client munge``), the rights to
start them, and Snakemake's executor for Slurm, which `make slurm` installs. It is skipped where one of them
is missing, and where there is a cluster already.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
CONFIGURATION = Path("/etc/slurm/slurm.conf")  # jobs find it without the environment of who submits them
DAEMONS = ("slurmctld", "slurmd", "munged", "sbatch", "squeue", "scancel")
NODES = {"node1": 17001, "node2": 17002}
SLURM = """\
ClusterName=siq
SlurmctldHost=localhost
SlurmUser=root
SlurmdUser=root
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
ReturnToService=2
MinJobAge=600
SlurmdTimeout=10
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool-%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/%n.log
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
{nodes}
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""
RUNS, OF_A_JOB = 8, 2


def missing() -> str | None:
    """What this test needs and is not here."""
    if programs := [name for name in DAEMONS if shutil.which(name) is None]:
        return f"no {', '.join(programs)}"
    if importlib.util.find_spec("snakemake_executor_plugin_slurm") is None:
        return "no snakemake-executor-plugin-slurm"
    if os.geteuid() != 0:
        return "daemons are root's"
    return "there is a cluster here" if CONFIGURATION.exists() else None


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Path]:
    """A controller and two nodes; their process identifiers are in files in this folder."""
    if reason := missing():
        pytest.skip(reason)
    folder = tmp_path / "slurm"
    for name in ("state", *(f"spool-{node}" for node in NODES)):
        (folder / name).mkdir(parents=True)
    lines = [
        f"NodeName={name} NodeHostname=localhost Port={port} CPUs={OF_A_JOB} RealMemory=8000"
        for name, port in NODES.items()
    ]
    CONFIGURATION.write_text(SLURM.format(folder=folder, nodes="\n".join(lines)), encoding="utf-8")
    try:
        if subprocess.run(["munge", "-n"], capture_output=True, check=False).returncode:
            Path("/run/munge").mkdir(exist_ok=True)
            shutil.chown("/run/munge", "munge")
            subprocess.run(["su", "-s", "/bin/sh", "munge", "-c", "munged"], check=True)
        subprocess.run(["slurmctld"], check=True)
        time.sleep(2)
        for node in NODES:
            subprocess.run(["slurmd", "-N", node], check=True)
        yield folder
    finally:
        subprocess.run(["scancel", "--user", "root"], check=False)
        for pid in folder.glob("*.pid"):
            subprocess.run(["kill", pid.read_text().strip()], check=False)
        CONFIGURATION.unlink()


def study_in(folder: Path) -> Path:
    shutil.copytree(ROOT / ".test" / "config", folder / "config")
    with (folder / "config" / "studies" / "two-wells.yaml").open("a", encoding="utf-8") as file:
        file.write(f"runs: {RUNS}\n")
    return folder


def snakemake(folder: Path, *options: str) -> list[str]:
    return [
        sys.executable, "-m", "snakemake", "--snakefile", str(ROOT / "Snakefile"), "--directory", str(folder),
        *options, "--", "results/two-wells/report.html",
    ]  # fmt: skip


def by_slurm(folder: Path) -> list[str]:
    return snakemake(
        folder, "--profile", str(ROOT / "profiles" / "slurm"), "--latency-wait", "5",
        "--cores", f"{OF_A_JOB}", "--group-components", f"runs={OF_A_JOB}", "--slurm-no-account",
        "--slurm-status-command", "squeue", "--slurm-init-seconds-before-status-checks", "5",
    )  # fmt: skip


def jobs(node: str) -> list[str]:
    """Jobs of runs on a node; what comes after them is named by its rule."""
    asked = ["squeue", "--noheader", "--nodelist", node, "--states", "RUNNING", "--format", "%i"]
    return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.split()


def kill_node(cluster: Path, node: str) -> None:
    """As where the power fails: its daemon, what watches over its jobs, and the jobs themselves."""
    os.kill(int((cluster / f"{node}.pid").read_text()), signal.SIGKILL)
    for job in jobs(node):
        for process in Path("/proc").glob("[0-9]*"):
            try:
                environment = (process / "environ").read_bytes()
                command = (process / "cmdline").read_bytes()
            except OSError:
                continue
            if f"SLURM_JOB_ID={job}\0".encode() in environment or f"[{job}.".encode() in command:
                os.kill(int(process.name), signal.SIGKILL)


def test_a_node_that_dies_takes_nothing_with_it_but_its_own_runs(cluster: Path, tmp_path: Path) -> None:
    folder = study_in(tmp_path / "cluster")
    log = (tmp_path / "snakemake.log").open("w", encoding="utf-8")
    with subprocess.Popen(by_slurm(folder), stdout=log, stderr=subprocess.STDOUT) as workflow:
        end = time.monotonic() + 120
        while not (jobs("node1") and jobs("node2")) and time.monotonic() < end:
            time.sleep(1)
        time.sleep(5)
        assert jobs("node1") and jobs("node2")  # one job each, of two runs, and two jobs wait
        kill_node(cluster, "node2")
        workflow.wait(timeout=1500)
    made = {path.parent.name for path in folder.glob("results/two-wells/runs/*/score.json")}
    assert len(made) >= RUNS - OF_A_JOB, (tmp_path / "snakemake.log").read_text()
    # The same command makes what is missing, with the node or without it.
    if workflow.returncode:
        subprocess.run(by_slurm(folder), check=True, timeout=1500)
    # As on this machine alone.
    here = study_in(tmp_path / "here")
    subprocess.run(snakemake(here, "--cores", "2"), check=True, timeout=1500, capture_output=True)
    for name in ("coefficients", "rrmse", "certificates", "landscape"):
        tables = [
            pd.read_parquet(where / "results" / "two-wells" / "tables" / f"{name}.parquet")
            for where in (folder, here)
        ]
        pd.testing.assert_frame_equal(*tables)
