"""The page of a run as a headless Chromium shows it, for the README.

    make bench-report_picture ARGS="scene=carnation"   ->   docs/results/report.jpg

Nothing is computed here; run the scene first (`make run SCENE=carnation`).
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

TARGET = Path(__file__).resolve().parent.parent / "docs" / "results" / "report.jpg"
WIDTH, HEIGHT = 1240, 1720  # of the window [px]
QUALITY = 80


def chromium() -> str | None:
    """Path of a Chromium, or None."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def shot(program: str, page: Path, picture: Path, width: int = WIDTH, height: int = HEIGHT) -> None:
    """Open a page without a screen and keep what it shows. Raises CalledProcessError or TimeoutExpired."""
    with tempfile.TemporaryDirectory() as profile:
        options = ["--headless=new", "--no-sandbox", "--hide-scrollbars", "--virtual-time-budget=4000"]
        options += [f"--user-data-dir={profile}", f"--window-size={width},{height}", f"--screenshot={picture}"]
        subprocess.run([program, *options, page.as_uri()], check=True, capture_output=True, timeout=300)


def main(words: list[str]) -> None:
    from PIL import Image

    from pipeline.scene_page import scene_page

    program = chromium()
    if program is None:
        raise SystemExit("error: no Chromium; on Debian: apt install chromium")
    with tempfile.TemporaryDirectory() as folder:
        page, picture = Path(folder) / "page.html", Path(folder) / "page.png"
        page.write_text(scene_page(words or ["scene=carnation"])[1])
        shot(program, page, picture)
        with Image.open(picture) as image:
            image.convert("RGB").save(TARGET, quality=QUALITY)
    print(f"{TARGET} ({TARGET.stat().st_size / 1e3:.0f} kB)")


if __name__ == "__main__":
    main(sys.argv[1:])
