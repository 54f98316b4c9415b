"""make report [SCENE=...] [OUT=<new .html>]: what a run left, as one page that needs nothing but a browser.

With a scene: films under one slider, the moving Gaussians, scores beside still pictures, the material, curves, previews
of every stage, what was left out and why, times, memory, configuration and versions (`scene_page.py`). Without one:
every run on this shelf, and the plots of docs/results (`shelf_page.py`). Pictures and numbers are inside the file.
Exit codes: 0 done, 1 it could not be made, 2 a word means nothing, 130 Ctrl-C.
"""

import os
import sys
from collections.abc import Mapping
from pathlib import Path

from pipeline.filed import beside, megabytes, one_line
from pipeline.places import new_place


def main(words: list[str], environment: Mapping[str, str]) -> int:
    return one_line(lambda: write(words, environment), lambda text: print(text, file=sys.stderr))


def write(words: list[str], environment: Mapping[str, str]) -> None:
    """Raises SettingsError, StageError, ValueError, RuntimeError or OSError with one line."""
    from pipeline.scene_page import scene_page
    from pipeline.shelf_page import shelf_page

    out = new_place(environment, ".html")
    one = any(word.startswith("scene=") for word in words)
    name, text = scene_page(words) if one else shelf_page(words)
    target = out or Path(f"exports/{name}.html")
    page = text.encode()
    with beside(target, len(page), over=out is None) as hidden:
        hidden.write_bytes(page)
    print(f"written   {target}   {megabytes(len(page))}; open it in a browser")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], os.environ))
