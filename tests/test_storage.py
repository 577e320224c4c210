"""Crash-safe output: complete or absent, whatever happens in between."""

import errno
import json
import os
import signal
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import pytest

from cellquant.errors import InputError
from cellquant.lock import only_writer
from cellquant.storage import (
    RunRecord,
    atomic_path,
    begin,
    content_key,
    digest,
    disk_problem,
    replace_together,
    write_json,
)


def test_a_failing_block_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "table.txt"
    target.write_text("old")
    with pytest.raises(RuntimeError, match="broke"), atomic_path(target) as temporary:
        temporary.write_text("half")
        raise RuntimeError("broke")
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["table.txt"]


def test_a_folder_is_replaced_whole(tmp_path: Path) -> None:
    target = tmp_path / "out"
    for content in ("one", "two"):
        with atomic_path(target) as temporary:
            temporary.mkdir()
            (temporary / content).write_text(content)
    assert [p.name for p in target.iterdir()] == ["two"]
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_killed_writer_leaves_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "table.txt"
    target.write_text("old")
    code = f"""
        import time
        from cellquant.storage import atomic_path
        with atomic_path({str(target)!r}) as temporary:
            temporary.write_text("half")
            print("written", flush=True)
            time.sleep(60)
    """
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)], stdout=subprocess.PIPE
    ) as writer:
        assert writer.stdout is not None
        writer.stdout.readline()
        os.kill(writer.pid, signal.SIGKILL)
    assert target.read_text() == "old"
    with atomic_path(target) as temporary:
        temporary.write_text("new")
    assert target.read_text() == "new"


def test_an_output_below_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(InputError, match="cannot write"),
        atomic_path(tmp_path / "file" / "out") as temporary,
    ):
        temporary.write_text("never")


def test_a_full_disk_is_an_input_error(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full")
    with pytest.raises(InputError, match="No space left"), atomic_path(tmp_path / "a") as temporary:
        temporary.symlink_to("/dev/full")
        with temporary.open("w") as stream:
            stream.write("x")
    assert list(tmp_path.iterdir()) == []


def test_json_refuses_nan_and_is_stable(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "a.json", {"value": float("nan")})
    assert list(tmp_path.iterdir()) == []
    write_json(tmp_path / "a.json", {"b": 1, "a": [2.5]})
    assert (tmp_path / "a.json").read_text() == '{\n  "a": [\n    2.5\n  ],\n  "b": 1\n}\n'


def test_digests_and_keys_change_with_content(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("one")
    first, folder = digest(tmp_path / "a"), digest(tmp_path)
    (tmp_path / "a").write_text("two")
    assert digest(tmp_path / "a") != first
    assert digest(tmp_path) != folder
    assert content_key({"a": 1}) != content_key({"a": 2})
    assert content_key({"a": 1, "b": 2}) == content_key({"b": 2, "a": 1})


def test_the_record_names_stages_and_inputs(tmp_path: Path) -> None:
    (tmp_path / "in").write_text("x")
    record = RunRecord("track", {"pixel_size": 0.65})
    record.add_input(tmp_path / "in")
    with record.stage("read"):
        pass
    record.write(tmp_path / "out")
    saved = json.loads((tmp_path / "out" / "run.json").read_text())
    assert saved["inputs"][str(tmp_path / "in")] == digest(tmp_path / "in")
    assert saved["stages"][0]["stage"] == "read"
    assert {"wall_s", "cpu_s"} <= set(saved["stages"][0])
    assert saved["machine"]["cores"] >= 1


def test_results_that_belong_together_are_never_mixed(tmp_path: Path) -> None:
    (tmp_path / ".together.killed.partial").mkdir()

    def write(content: str) -> None:
        with replace_together(tmp_path) as place:
            for name in ("a", "b"):
                (place / name).write_text(content)
            (place / "run.json").write_text(content)

    write("one")
    with only_writer(tmp_path):
        other = threading.Thread(target=write, args=("other",), daemon=True)
        other.start()
        write("two")  # the same thread may
        other.join(timeout=0.3)
        assert other.is_alive(), "another writer waits"
        assert {p.read_text() for p in tmp_path.iterdir() if p.name != ".lock"} == {"two"}
    other.join(timeout=30)
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == dict.fromkeys(
        ("a", "b", "run.json"), "other"
    )
    with pytest.raises(RuntimeError, match="broke"), replace_together(tmp_path) as place:
        (place / "a").write_text("half")
        raise RuntimeError("broke")
    assert {p.read_text() for p in tmp_path.iterdir()} == {"other"}


def test_another_work_in_a_folder_is_removed_and_the_same_is_kept(tmp_path: Path) -> None:
    begin(tmp_path, "one")
    (tmp_path / "half.parquet").write_text("half")
    (tmp_path / ".half.parquet.x.partial").mkdir()
    begin(tmp_path, "one")
    assert {p.name for p in tmp_path.iterdir()} == {".started", "half.parquet"}
    begin(tmp_path, "two")
    assert {p.name for p in tmp_path.iterdir()} == {".started"}


def test_only_errors_of_the_disk_are_the_users(tmp_path: Path) -> None:
    full = OSError(errno.ENOSPC, "full", str(tmp_path / "a"))
    assert "No space left" in str(disk_problem(full))
    assert str(tmp_path / "a") in str(disk_problem(full))
    assert disk_problem(FileNotFoundError(errno.ENOENT, "gone")) is None
    assert disk_problem(RuntimeError("ours")) is None


def test_a_disk_that_fills_up_is_one_sentence(tmp_path: Path) -> None:
    """No file may grow beyond 3 kB: the writers meet EFBIG in the middle of their work."""
    sweep = tmp_path / "s.toml"
    sweep.write_text("[scene]\ncells = 9\ntransient = 0\nduration = 3\n")
    code = f"""
        import resource, sys
        from cellquant.cli import main
        resource.setrlimit(resource.RLIMIT_FSIZE, (3000, resource.RLIM_INFINITY))
        sys.argv = ["cellquant", "sweep", {str(sweep)!r}, "-o", {str(tmp_path / "out")!r}]
        main()
    """
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "0"}
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert "File too large" in done.stderr + done.stdout
    assert not list((tmp_path / "out").rglob("*.partial"))


@pytest.mark.parametrize(
    "swallow", ["raise ImportError('half loaded')", "time.sleep(60)"], ids=["another error", "none"]
)
def test_an_interruption_ends_the_program_whatever_becomes_of_it(swallow: str) -> None:
    code = f"""
        import os, signal, time
        from cellquant import cli
        def work():
            try:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(60)
            except KeyboardInterrupt:
                {swallow}
        cli.app, cli.GRACE = work, 0.2
        cli.main()
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (130, "")
