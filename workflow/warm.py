"""A warm interpreter: every job of a workflow starts where its imports are done already.

A step of a run takes seconds, and the imports of numpy, sympy, torch and pysindy as long again. So one
process imports them, and jobs that run at the same time are forks of it. A fork whose job ends well takes the
next one. `serve` is that process, which the Snakefile starts; `run_warm` is what a script calls first. Where
there is no such process, as on systems that cannot fork, a script runs as it would by itself.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import runpy
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypedDict

ADDRESS = "SIQ_WARM_INTERPRETER"
"""Environment variable with the path of the socket; absent where there is no warm interpreter."""

STREAMS = 3  # standard input, output and error of the job
LONGEST_REQUEST = 1 << 20


PARENT = "SIQ_PARENT"
"""Environment variable of a workflow whose standard input ends with the process that has started it."""


def end_with_parent(before: Callable[[], None] = lambda: None) -> None:
    """End this process when its standard input ends, and so with the one that holds that open."""

    def wait() -> None:
        while os.read(0, 1):
            pass
        before()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


class Request(TypedDict):
    """What a job asks for."""

    task: str
    script: str
    folder: str
    path: list[str]
    environment: dict[str, str]


def start() -> subprocess.Popen[bytes] | None:
    """Start the warm interpreter of this workflow and tell every job where it is.

    It ends with the process that calls this, however that ends: its standard input is a pipe that only this
    process holds open.

    Returns
    -------
    subprocess.Popen or None
        To be kept for as long as jobs run. None on a system that cannot fork.
    """
    if not hasattr(os, "fork"):
        return None
    folder = tempfile.mkdtemp(prefix="siq-")
    address = str(Path(folder) / "warm")
    server = socket.socket(socket.AF_UNIX)
    server.bind(address)
    server.listen(64)  # jobs that ask before its first imports are done wait here
    process = subprocess.Popen(
        [sys.executable, "-m", "workflow.warm", str(server.fileno()), folder],
        stdin=subprocess.PIPE,
        pass_fds=[server.fileno()],
        cwd=Path(__file__).resolve().parents[1],
    )
    server.close()
    os.environ[ADDRESS] = address
    return process


def run_warm(task: str) -> None:
    """Run the script that calls this in a fork of the warm interpreter, and end with its exit code.

    Returns at once where there is none, or where this is that fork. To be called before the imports that take
    their time.
    """
    address = os.environ.pop(ADDRESS, None)
    if address is None:
        return
    connection = socket.socket(socket.AF_UNIX)
    try:
        connection.connect(address)
    except OSError:  # it ends with the workflow, and nobody waits for this job any more
        sys.exit("The workflow has ended, and this job with it.")
    request: Request = {
        "task": task,
        "script": str(Path(sys.argv[0]).resolve()),  # Snakemake runs a copy, which says what the job is
        "folder": str(Path.cwd()),
        "path": sys.path,
        "environment": dict(os.environ),
    }
    _send(connection, request, [0, 1, 2])
    signal.signal(signal.SIGTERM, lambda *_: os._exit(128 + signal.SIGTERM))  # the fork sees us gone
    code = connection.recv(1)
    os._exit(code[0] if code else 1)


def serve(listening: socket.socket, folder: Path) -> None:
    """Give every script that connects to a fork, until standard input ends; then remove the folder."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is for the workflow, which then ends
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # forks that have ended are reaped by the system
    gc.disable()  # what imports make stays; looking through it for garbage takes a quarter of their time
    forks: dict[socket.socket, bool] = {}  # whether each is at work
    numbers: dict[socket.socket, int] = {}

    def end_all() -> None:
        for number in [*numbers.values()]:
            with contextlib.suppress(OSError):
                os.kill(number, signal.SIGKILL)
        shutil.rmtree(folder, ignore_errors=True)

    end_with_parent(end_all)
    while True:
        ready, _, _ = select.select([listening, *forks], [], [])
        for fork in set(ready) & set(forks):
            with contextlib.suppress(OSError):
                forks[fork] = not fork.recv(1)
            if forks[fork]:  # it has ended with its job
                del forks[fork], numbers[fork]
                fork.close()
        if listening not in ready:
            continue
        connection, _ = listening.accept()
        try:
            request, descriptors = _received(connection)
        except (OSError, ValueError):  # a job that was killed while it asked
            connection.close()
            continue
        sys.path[:] = request["path"]
        idle = next((fork for fork, busy in forks.items() if not busy), None)
        if idle is None:
            with contextlib.suppress(Exception):  # the job says itself what is wrong
                _load(request["task"])
            gc.freeze()  # nor does a fork look through it, which collects what its jobs make
            idle, ours = socket.socketpair()
            if not (number := os.fork()):
                for each in (listening, connection, idle, *forks):
                    each.close()
                for descriptor in descriptors:
                    os.close(descriptor)
                _work(ours)
            ours.close()
            numbers[idle] = number
        forks[idle] = True
        with contextlib.suppress(OSError):  # one that was killed; the script sees its connection end
            _send(idle, request, [*descriptors, connection.fileno()])
        for descriptor in descriptors:
            os.close(descriptor)
        connection.close()


def _load(task: str) -> None:
    """Import what a task imports when it runs, once for all of its jobs."""
    from workflow.versions import imports_of_task

    for module in imports_of_task(task):
        with contextlib.suppress(ImportError):  # a name in a module, and no module
            importlib.import_module(module)


def _send(connection: socket.socket, request: Request, descriptors: list[int]) -> None:
    payload = json.dumps(request).encode()
    socket.send_fds(connection, [len(payload).to_bytes(8, "big")], descriptors)
    connection.sendall(payload)


def _received(connection: socket.socket) -> tuple[Request, list[int]]:
    """A request, and the descriptors that came with it: the streams of a job, and its script's connection."""
    header, descriptors, _, _ = socket.recv_fds(connection, 8, STREAMS + 1)
    size = int.from_bytes(header, "big")
    if not header or size > LONGEST_REQUEST:
        raise ValueError("there is no request, or it is too long")
    payload = b""
    while len(payload) < size:
        part = connection.recv(size - len(payload))
        if not part:
            raise OSError("the job is gone")
        payload += part
    return json.loads(payload), list(descriptors)


def _work(server: socket.socket) -> None:
    """Run one job after the other, until one fails or the warm interpreter ends."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    gc.enable()
    null, code = os.open(os.devnull, os.O_RDWR), 0
    while not code:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            request, (*streams, script) = _received(server)
        except (OSError, ValueError):
            break
        code = _run_job(request, streams, socket.socket(fileno=script), null=null)
        if not code:
            with contextlib.suppress(OSError):
                server.sendall(b"1")
    os._exit(code)


def _run_job(request: Request, streams: list[int], connection: socket.socket, *, null: int) -> int:
    """Be the job: its folder, environment and streams, its script, its exit code."""
    code, ended = 1, threading.Event()
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        for place, descriptor in enumerate(streams):
            os.dup2(descriptor, place)
            os.close(descriptor)
        os.chdir(request["folder"])
        os.environ.clear()
        os.environ.update(request["environment"])
        sys.path[:], sys.argv = request["path"], [request["script"]]
        warnings.simplefilter("default", append=True)  # what a job before was warned of is news to this one
        threading.Thread(target=_end_with_script, args=(connection, ended), daemon=True).start()
        runpy.run_path(request["script"], run_name="__main__")
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        for place in range(STREAMS):  # whoever reads what the script says waits for its end
            os.dup2(null, place)
        ended.set()
        with contextlib.suppress(OSError):
            connection.sendall(bytes([code % 256]))
    return code % 256


def _end_with_script(connection: socket.socket, ended: threading.Event) -> None:
    """A job whose script is killed ends with it."""
    with contextlib.suppress(OSError):
        connection.recv(1)
    if not ended.is_set():
        os._exit(1)
    connection.close()


if __name__ == "__main__":
    serve(socket.socket(fileno=int(sys.argv[1])), Path(sys.argv[2]))
