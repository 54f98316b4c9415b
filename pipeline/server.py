"""The Prefect server of one run. A flow needs one; it lives exactly as long as the process that started it.

Prefect would start one by itself, but that one dies before the flow when Ctrl-C reaches the whole terminal, and
outlives it after `kill -9`. Ours runs in a session of its own under a shell that waits for the end of a pipe
we hold: however this process ends, the pipe closes and the shell stops the server, and a server that ends by itself
ends the shell. Set PREFECT_API_URL to use a server
of your own. Addresses of this machine go round any proxy.
"""

import fcntl
import os
import resource
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import IO

HERE = ("localhost", "127.0.0.1", "::1")
FILES = 256  # that this process and the server each hold open, at least
SQLITE = b"SQLite format 3\0"  # how a database of it begins; one of no bytes is begun by it
PATIENCE = 600  # a first start creates the database, on a machine that may be busy with ten other things [s]
SETTINGS = {
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_TELEMETRY_ENABLE_RESOURCE_METRICS": "false",
    "PREFECT_LOGGING_LEVEL": "CRITICAL",
    "PREFECT_LOGGING_INTERNAL_LEVEL": "CRITICAL",
    "PREFECT_LOGGING_TO_API_ENABLED": "false",
    "PREFECT_SERVER_UI_ENABLED": "false",
    "DO_NOT_TRACK": "true",
}


@contextmanager
def server(home: Path, meanwhile: Callable[[], object], host: str = "127.0.0.1") -> Iterator[None]:
    """Start a server with its database under `home`, call `meanwhile` while it starts (12 s), stop it at the end.

    `host` is the address of this machine under which whoever computes can reach it. Must be entered before Prefect is
    imported. Raises RuntimeError if the server does not come up.
    """
    _allow_files()
    _go_round_proxies()
    os.environ.setdefault("PREFECT_HOME", str(home))
    for name, value in SETTINGS.items():
        os.environ.setdefault(name, value)
    if "PREFECT_API_URL" in os.environ:
        meanwhile()
        yield
        return
    home = Path(os.environ["PREFECT_HOME"])
    with _start_lock(home) as lock:  # two first starts at once would both migrate the database
        fcntl.flock(lock, fcntl.LOCK_EX)
        _set_aside(home / "prefect.db")
        process, address = _start(home / "server.log", host)
        try:
            meanwhile()
            _await(process, f"{address}/health", home / "server.log")
        except BaseException:
            _stop(process)
            raise
    os.environ["PREFECT_API_URL"] = address
    try:
        yield
    finally:
        del os.environ["PREFECT_API_URL"]
        _stop(process)


def _allow_files() -> None:
    """Raise the limit of open files as far as that is ours to do. Raises RuntimeError if it stays too low."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < FILES:
        if hard != resource.RLIM_INFINITY and hard < FILES:
            raise RuntimeError(f"only {hard} files may be open at once here, {FILES} are needed; ulimit -n {FILES}")
        resource.setrlimit(resource.RLIMIT_NOFILE, (FILES, hard))


def _go_round_proxies() -> None:
    proxies = [value for name, value in os.environ.items() if name.lower().endswith("_proxy")]
    # httpx, which talks to the server and to the hub, refuses to start beside a SOCKS proxy that it cannot use
    useless = any(value.startswith("socks") for value in proxies) and find_spec("socksio") is None
    for name in ("no_proxy", "NO_PROXY"):  # libraries read the one or the other
        listed = [entry.strip() for entry in os.environ.get(name, "").split(",") if entry.strip()]
        missing = [host for host in HERE if host not in listed]
        os.environ[name] = "*" if useless else ",".join([*listed, *missing])


def _start_lock(home: Path) -> IO[str]:
    """The file that whoever starts a server locks. Raises OSError with the remedy."""
    try:
        home.mkdir(parents=True, exist_ok=True)
        return (home / "start.lock").open("w")
    except OSError as error:
        reason = f"Prefect cannot keep its database in {home} ({error.strerror}: {error.filename})"
        raise OSError(f"{reason}; remove that, or set PREFECT_HOME=<another folder>") from error


def _set_aside(database: Path) -> None:
    """Rename what lies in the place of Prefect's database and is none, with a word."""
    if not os.path.lexists(database):
        return
    if database.is_file():
        with database.open("rb") as file:
            if file.read(len(SQLITE)) in (SQLITE, b""):
                return
    aside = database.with_name(f"{database.name}.damaged-{time.strftime('%Y%m%d-%H%M%S')}")
    database.rename(aside)
    for beside in ("-wal", "-shm"):
        database.with_name(database.name + beside).unlink(missing_ok=True)
    print(f"{'prefect':>16} | warning: its database was damaged; it is kept as {aside}, and begun anew", flush=True)


def _start(log: Path, host: str) -> tuple[subprocess.Popen, str]:
    with socket.socket() as probe:
        probe.bind((host, 0))
        port = probe.getsockname()[1]
    serve = [sys.executable, "-m", "uvicorn", "--factory", "prefect.server.api.server:create_app"]
    options = ["--host", host, "--port", str(port), "--log-level", "error", "--lifespan", "on"]
    # "$@" is the server; cat returns when the other end of the pipe is closed. The shell ends when the server does
    script = 'exec 3<&0; "$@" </dev/null 3<&- & server=$!; (cat <&3 >/dev/null; kill $server) & wait $server; kill $!'
    with log.open("w") as lines:
        process = subprocess.Popen(
            ["sh", "-c", script, "sh", *serve, *options],
            stdin=subprocess.PIPE,
            stdout=lines,
            stderr=lines,
            start_new_session=True,
            env={**os.environ, "PREFECT__SERVER_EPHEMERAL": "1"},
        )
    return process, f"http://{host}:{port}/api"


def _await(process: subprocess.Popen, url: str, log: Path) -> None:
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline and process.poll() is None:
        try:
            with direct.open(url, timeout=5):
                return
        except OSError:
            time.sleep(0.1)
    raise RuntimeError(
        f"the Prefect server did not start; see {log}, remove {log.parent} (no results are there), or set "
        "PREFECT_API_URL to a server of your own"
    )


def _stop(process: subprocess.Popen) -> None:
    assert process.stdin is not None
    process.stdin.close()
    try:
        process.wait(timeout=10)
    except subprocess.TimeoutExpired:  # the shell and the server, which are a group of their own
        os.killpg(process.pid, signal.SIGKILL)
