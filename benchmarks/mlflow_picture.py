"""MLflow's page that compares runs, as a headless Chromium shows it, for the README.

    make sweep SCENES=carnation METHODS=physics3d,without_viscoelastic,physgaussian PROFILE=smoke
    make bench-mlflow_picture [ARGS=<name of the sweep's table>]   ->   docs/results/mlflow.jpg

Shows what this folder has recorded, or one sweep, and of its charts those of SHOWN.
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
SHOWN = "score/learned/(psnr|motion_psnr|flow_error)|^learned/youngs"  # names of charts
WIDTH, HEIGHT = 1500, 1240  # of the window [px]
NO_ASSISTANT = "localStorage['mlflow.assistant.panelOpen_v1'] = 'false'; location.reload()"  # it covers the charts
NO_SIDEBAR = "document.querySelector('[aria-label=\"Toggle sidebar\"]').click()"
NO_TOOLS = """document.head.insertAdjacentHTML('beforeend', '<style>.modebar {display: none}</style>');
document.querySelector('[placeholder=\"Search metric charts\"]').focus()"""


def main(words: list[str]) -> None:
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
                opened(address(home, port, *words), Path(folder), width=WIDTH, height=HEIGHT) as tab,
            ):
                time.sleep(DRAWN)
                tab.evaluate(NO_ASSISTANT)
                time.sleep(DRAWN)
                tab.evaluate(NO_SIDEBAR)
                tab.evaluate(NO_TOOLS)
                tab.call("Input.insertText", text=SHOWN)
                time.sleep(DRAWN / 3)
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
    main(sys.argv[1:])
