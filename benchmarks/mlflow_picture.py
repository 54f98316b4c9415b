"""MLflow's page that compares runs, as a headless Chromium shows it, for the README.

    make bench-mlflow_picture   ->   docs/results/mlflow.jpg

Shows what this folder has recorded; run some variants first (`make compare`, `make sweep`).
"""

import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

from browser import chromium, opened

from pipeline.tracking import address, database

TARGET = Path(__file__).resolve().parent.parent / "docs" / "results" / "mlflow.jpg"
PATIENCE = 180.0  # [s] for MLflow on a busy machine
DRAWN = 30.0  # [s] for its charts
# whatever helper has opened at the side
CLOSE = 'document.querySelectorAll(\'[aria-label="Close"], [aria-label="close"]\').forEach(b => b.click())'


def main() -> None:
    from PIL import Image

    if chromium() is None:
        raise SystemExit("error: no Chromium; on Debian: apt install chromium")
    home = Path.cwd()
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "mlflow", "ui", "--backend-store-uri", database(home), "--host", "127.0.0.1"]
    with subprocess.Popen([*command, "--port", str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as ui:
        try:
            wait(port)
            with (
                tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
                opened(address(home, port), Path(folder), width=1500, height=1000) as tab,
            ):
                time.sleep(DRAWN)
                tab.evaluate(CLOSE)
                time.sleep(5.0)
                picture = Image.fromarray(tab.picture())
        finally:
            ui.terminate()
    picture.save(TARGET, quality=80)
    print(f"{TARGET} ({TARGET.stat().st_size / 1e3:.0f} kB)")


def wait(port: int) -> None:
    """Until it answers. Raises SystemExit if it does not."""
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        try:
            direct.open(f"http://127.0.0.1:{port}/health", timeout=5).close()
            return
        except OSError:
            time.sleep(0.5)
    raise SystemExit("error: MLflow does not answer")


if __name__ == "__main__":
    main()
