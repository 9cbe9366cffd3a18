"""Scripts that start in a fork of the warm interpreter behave as they would by themselves."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from workflow import warm

ROOT = Path(__file__).resolve().parents[2]
HEAD = "from workflow.warm import run_warm\nrun_warm('example_hopping')\nimport json\n"

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")


@pytest.fixture(scope="module")
def interpreter() -> Iterator[subprocess.Popen[bytes]]:
    """A warm interpreter that ends with the last of these tests."""
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv(warm.ADDRESS, "")
        process = warm.start()
        assert process is not None and process.stdin is not None
        yield process
        process.stdin.close()
        process.wait(timeout=20)


def start(path: Path, body: str, **environment: str) -> subprocess.Popen[str]:
    path.write_text(HEAD + body, encoding="utf-8")
    return subprocess.Popen(
        [sys.executable, str(path)],
        env=os.environ | {"PYTHONPATH": str(ROOT)} | environment,
        cwd=path.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def test_a_script_runs_in_a_fork_with_its_own_folder_streams_and_environment(
    interpreter: subprocess.Popen[bytes], tmp_path: Path
) -> None:
    body = "import os\nprint(os.getppid(), os.getcwd(), os.environ['MINE'])\n"
    output, _ = start(tmp_path / "script.py", body, MINE="own").communicate(timeout=60)
    assert output.split() == [str(interpreter.pid), str(tmp_path), "own"]


def test_a_fork_whose_job_ends_well_takes_the_next_one_and_another_does_not(
    interpreter: subprocess.Popen[bytes], tmp_path: Path
) -> None:
    tell = (
        "import os, warnings\nprint(os.getpid(), os.environ.get('MINE'), flush=True)\nwarnings.warn('once')\n"
    )
    ends = (("", "own"), ("raise SystemExit(3)", "mine"), ("", "other"))
    told = [
        start(tmp_path / f"script{place}.py", tell + end, MINE=mine).communicate(timeout=60)[0]
        for place, (end, mine) in enumerate(ends)
    ]
    (first, *_), (second, *_), (third, *_) = (each.split() for each in told)
    assert first == second != third
    for (_, mine), each in zip(ends, told, strict=True):
        assert each.split()[1] == mine and "UserWarning: once" in each


@pytest.mark.parametrize(
    ("body", "code"), [("", 0), ("raise SystemExit(3)", 3), ("raise SystemExit('no')", 1)]
)
def test_the_exit_code_is_that_of_the_script(
    interpreter: subprocess.Popen[bytes], tmp_path: Path, body: str, code: int
) -> None:
    process = start(tmp_path / "script.py", body)
    process.communicate(timeout=60)
    assert process.returncode == code


def test_a_fault_shows_its_traceback(interpreter: subprocess.Popen[bytes], tmp_path: Path) -> None:
    output, _ = start(tmp_path / "script.py", "raise KeyError('what')").communicate(timeout=60)
    assert "Traceback" in output and "KeyError: 'what'" in output


def test_a_job_that_is_killed_takes_its_fork_along(
    interpreter: subprocess.Popen[bytes], tmp_path: Path
) -> None:
    body = "import os, time\nprint(os.getpid(), flush=True)\ntime.sleep(600)\n"
    process = start(tmp_path / "script.py", body)
    assert process.stdout is not None
    fork = int(process.stdout.readline())
    process.kill()
    process.wait()
    assert _gone(fork)


def test_the_interpreter_ends_with_the_workflow_and_takes_its_jobs_along(tmp_path: Path) -> None:
    program = (
        "import subprocess, sys, time\nfrom workflow import warm\nwarm.start()\n"
        "job = subprocess.Popen([sys.executable, sys.argv[1]])\ntime.sleep(600)\n"
    )
    script = tmp_path / "script.py"
    script.write_text(
        HEAD + "import os, time\nprint(os.getpid(), os.getppid(), flush=True)\ntime.sleep(600)\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != warm.ADDRESS}
    workflow = subprocess.Popen(
        [sys.executable, "-c", program, str(script)],
        env=environment | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert workflow.stdout is not None
    _, interpreter = map(int, workflow.stdout.readline().split())
    os.killpg(workflow.pid, signal.SIGKILL)
    assert _gone(interpreter)


def test_without_an_interpreter_a_script_runs_by_itself(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv(warm.ADDRESS, raising=False)
    process = start(tmp_path / "script.py", "import os\nprint(os.getpid())\n")
    output, _ = process.communicate(timeout=60)
    assert int(output) == process.pid


def _gone(pid: int) -> bool:
    for _ in range(200):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        if Path(f"/proc/{pid}/stat").exists() and " Z " in Path(f"/proc/{pid}/stat").read_text():
            return True
        time.sleep(0.05)
    return False
