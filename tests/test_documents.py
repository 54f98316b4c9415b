"""The documents lead somewhere: what they link to is there, file and heading, and so are the commands that they name.

That what they recommend can be set, and that keys which they name exist, is in `test_configs.py`.
"""

import re
from pathlib import Path

import pytest

from pipeline.fingerprint import ROOT

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
MAKEFILE = (ROOT / "Makefile").read_text()


def without_code(text: str) -> str:
    """A page without what is shown as it is typed."""
    return re.sub(r"^(?:    ).*$|`[^`\n]*`", "", text, flags=re.M)


def anchors(page: Path) -> set[str]:
    """Names of the headings of a page, as GitHub makes them: small letters, hyphens for blanks, nothing else kept."""
    found: dict[str, int] = {}
    for title in re.findall(r"^#+ (.*)$", page.read_text(), re.M):
        name = re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
        found[name] = found.get(name, -1) + 1
        if found[name]:
            found[f"{name}-{found[name]}"] = 0
    return set(found)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_to_a_file_and_to_a_heading_of_it(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", without_code(page.read_text())):
        if target.startswith(("http://", "https://")):
            continue
        path, _, heading = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), f"{page.name} links to {target}, which is not there"
        if heading:
            assert heading in anchors(there), f"{page.name} links to {target}: there is no such heading"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_of_make_is_one(page):
    targets = set(re.findall(r"^([a-z -]+):", MAKEFILE, re.M))
    known = {name for line in targets for name in line.split()}
    for name in re.findall(r"(?:^ {4}|`)make ([a-z][\w-]*\w)\b(?![<-])", page.read_text(), re.M):
        bench = name.removeprefix("bench-")
        is_bench = name.startswith("bench-") and (ROOT / "benchmarks" / f"{bench}.py").is_file()
        assert name in known or is_bench, f"{page.name} says make {name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_file_of_the_project_that_is_named_is_there(page):
    """Paths in code font that begin with a folder of ours."""
    for name in re.findall(r"`((?:physics3d|pipeline|stages|tests|conf|docs|benchmarks)/[\w./]+)`", page.read_text()):
        if page.parent.name != "results" and name != "pipeline/conf":  # that is where a wheel has conf/
            assert (ROOT / name).exists(), f"{page.name} names {name}"


def test_the_glossary_is_in_alphabetical_order():
    titles = re.findall(r"^### (.*)$", (ROOT / "docs" / "glossary.md").read_text(), re.M)
    letters = [re.sub(r"[^a-z]", "", title.lower()) for title in titles]
    assert letters == sorted(letters) and len(set(letters)) == len(letters)
