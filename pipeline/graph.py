"""make graph: Prefect's picture of the last run, which task waited for which and for how long; served until Ctrl-C.

    python -m pipeline.graph [output folder]

Runs of a Prefect server of your own (PREFECT_API_URL) are looked at on that server's page.
"""

import os
import signal
import sqlite3
import subprocess
import sys
import uuid
from contextlib import closing
from pathlib import Path

from pipeline.server import SETTINGS
from pipeline.tracking import free_port

PORT = "4200"


def main(words: list[str]) -> int:
    home = Path(words[0] if words else ".").resolve() / ".prefect"
    try:
        run = last_run(home / "prefect.db")
        port = free_port(os.environ.get("PORT") or PORT, "make graph")
    except (sqlite3.Error, LookupError):
        print(f"error: no runs of Prefect under {home} yet; `make run SCENE=carnation` makes one", file=sys.stderr)
        return 1
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    here = f"http://127.0.0.1:{port}"
    print(f"open {here}/runs/flow-run/{run}\n(up in about 20 s; Ctrl-C ends it)", flush=True)
    env = os.environ | SETTINGS | {"PREFECT_HOME": str(home), "PREFECT_SERVER_UI_ENABLED": "true"}
    env |= {"PREFECT_API_URL": f"{here}/api", "PREFECT_UI_API_URL": f"{here}/api"}
    options = ["--host", "127.0.0.1", "--port", str(port), "--log-level", "error"]
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    serve = [sys.executable, "-m", "uvicorn", "--factory", "prefect.server.api.server:create_app", *options]
    with subprocess.Popen(serve, env=env) as process:
        try:
            return process.wait()
        except KeyboardInterrupt:
            process.terminate()
            process.wait()
            return 0


def last_run(database: Path) -> uuid.UUID:
    """The run that started last. Raises sqlite3.Error without a database, LookupError without a run in it."""
    with closing(sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True)) as record:
        for (run,) in record.execute("select id from flow_run order by created desc limit 1"):
            return uuid.UUID(str(run))
    raise LookupError("no run")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
