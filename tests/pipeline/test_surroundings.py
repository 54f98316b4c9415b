"""What surrounds a run: proxies, limits, folders that cannot be written. It works, or one line names the remedy."""

import os
import resource
import sqlite3
import subprocess
import sys
import tempfile
from contextlib import closing
from pathlib import Path

import pytest

from pipeline import __main__ as command
from pipeline import sweep as sweeps
from pipeline.__main__ import _kernels
from pipeline.server import HERE, _go_round_proxies, _set_aside, server
from pipeline.stage import StageError

ROOT = Path(__file__).resolve().parent.parent.parent


@pytest.fixture
def environment(monkeypatch):
    """A copy of the environment without proxies, given back afterwards."""
    monkeypatch.setattr(os, "environ", os.environ.copy())
    for name in [n for n in os.environ if n.lower().endswith("_proxy")]:
        del os.environ[name]
    return os.environ


@pytest.mark.parametrize("listed", [{}, {"no_proxy": "a.org, b.org"}, {"NO_PROXY": "localhost"}, {"no_proxy": "*"}])
def test_addresses_of_this_machine_go_round_proxies(environment, listed):
    environment |= listed | {"http_proxy": "http://127.0.0.1:9"}
    _go_round_proxies()
    for name in ("no_proxy", "NO_PROXY"):
        entries = environment[name].split(",")
        assert set(HERE) <= set(entries) and len(entries) == len(set(entries))
        assert {e.strip() for e in listed.get(name, "").split(",") if e} <= set(entries)


@pytest.mark.parametrize("name", ["http_proxy", "HTTPS_PROXY", "all_proxy"])
@pytest.mark.parametrize("proxy", ["socks5://127.0.0.1:9", "http://127.0.0.1:9", "127.0.0.1:9", "nonsense"])
def test_no_proxy_keeps_the_client_of_the_server_from_starting(environment, name, proxy):
    import httpx

    environment[name] = proxy
    _go_round_proxies()
    httpx.Client().close()


LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_NOFILE, (64, int(sys.argv[1])))
from pathlib import Path
from pipeline.server import server
with server(Path(sys.argv[2]), meanwhile=lambda: print(resource.getrlimit(resource.RLIMIT_NOFILE)[0])):
    pass
"""


@pytest.mark.parametrize("hard", [64, 1024])
def test_the_limit_of_open_files_is_raised_or_said(tmp_path, hard):
    if resource.getrlimit(resource.RLIMIT_NOFILE)[1] < hard:
        pytest.skip("the limit is lower here")
    env = os.environ | {"PREFECT_API_URL": "http://127.0.0.1:9/api", "PYTHONPATH": str(ROOT)}  # starts no server
    call = [sys.executable, "-c", LIMITED, str(hard), str(tmp_path)]
    done = subprocess.run(call, env=env, cwd=ROOT, capture_output=True, text=True)
    if hard == 64:
        assert "RuntimeError: only 64 files may be open at once here, 256 are needed; ulimit -n 256" in done.stderr
    else:
        assert done.stdout == "256\n", done.stderr


def test_a_server_without_a_home_is_an_error_not_a_wait(tmp_path, environment):
    environment.pop("PREFECT_API_URL", None)
    environment.pop("PREFECT_HOME", None)
    (tmp_path / "home").write_text("x")
    (tmp_path / "other" / "start.lock").mkdir(parents=True)
    for name, reason in (("home", "File exists"), ("other", "Is a directory")):
        environment.pop("PREFECT_HOME", None)
        said = f"cannot keep its database in {tmp_path / name} \\({reason}.*; remove that, or set PREFECT_HOME="
        with pytest.raises(OSError, match=said), server(tmp_path / name, meanwhile=lambda: None):
            pass


def test_a_server_that_ends_by_itself_is_an_error_not_a_wait(tmp_path, environment):
    """As where its disk is full: the database cannot be made."""
    for name in ("PREFECT_API_URL", "PREFECT_HOME"):
        environment.pop(name, None)
    (tmp_path / "prefect.db-journal").mkdir()  # no file can be made there
    said = r"the Prefect server did not start; see .*server\.log"
    with pytest.raises(RuntimeError, match=said), server(tmp_path, meanwhile=lambda: None):
        pass
    assert "Traceback" in (tmp_path / "server.log").read_text()  # it said why, and ended


@pytest.mark.parametrize("kind", ["text", "cut", "folder", "link"])
def test_what_is_no_database_of_prefect_is_set_aside_with_a_word(tmp_path, capsys, kind):
    file = tmp_path / "prefect.db"
    match kind:
        case "text":
            file.write_text("this is no database")
        case "cut":
            file.write_bytes(b"SQLite")
        case "folder":
            file.mkdir()
        case "link":
            file.symlink_to(tmp_path / "nowhere")
    (tmp_path / "prefect.db-wal").write_text("x")
    _set_aside(file)
    (aside,) = tmp_path.iterdir()
    assert aside.name.startswith("prefect.db.damaged-") and str(aside) in capsys.readouterr().out


@pytest.mark.parametrize("content", [b"", None])
def test_a_database_of_prefect_is_left_in_its_place(tmp_path, content):
    file = tmp_path / "prefect.db"
    if content is None:
        with closing(sqlite3.connect(file)) as made:
            made.execute("create table runs (id)")
    else:
        file.write_bytes(content)
    _set_aside(file)
    assert list(tmp_path.iterdir()) == [file]


def test_a_full_temporary_folder_is_said_at_once(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", "/dev/shm")
    monkeypatch.setattr(command, "LEAST_TEMPORARY", 1 << 60)
    assert command.main(["scene=ball", "profile=smoke", f"output={tmp_path}"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "MB are free in /dev/shm); set TMPDIR=<folder>" in line


@pytest.mark.parametrize("place", ["file", "file/below", "full"])
@pytest.mark.parametrize("sweep", [False, True])
def test_a_place_where_no_results_can_be_kept_is_said_at_once(tmp_path, capsys, place, sweep):
    (tmp_path / "file").write_text("x")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "artifacts").write_text("x")
    words = ["profile=smoke", f"output={tmp_path / place}"]
    assert sweeps.main(["scenes=ball", *words]) == 1 if sweep else command.main(["scene=ball", *words]) == 1
    told = capsys.readouterr()
    (line,) = told.err.splitlines()
    assert line.startswith(f"error: results cannot be kept in {tmp_path / place / 'artifacts'} (")
    assert line.endswith("; say output=<a folder that can be written>") and told.out == ""


def test_kernels_are_kept_where_one_can_write(tmp_path, environment):
    environment.pop("WARP_CACHE_PATH", None)
    environment["XDG_CACHE_HOME"] = str(tmp_path / "cache")
    _kernels(tmp_path)
    assert "WARP_CACHE_PATH" not in environment
    (tmp_path / "file").write_text("x")  # also root cannot write into a file
    environment["XDG_CACHE_HOME"] = str(tmp_path / "file")
    _kernels(tmp_path)
    assert environment["WARP_CACHE_PATH"] == str(tmp_path / ".warp")
    environment["WARP_CACHE_PATH"] = str(tmp_path / "file")
    with pytest.raises(
        StageError, match=r"compiled kernels cannot be kept in .*file.*; set WARP_CACHE_PATH to a folder"
    ):
        _kernels(tmp_path)
