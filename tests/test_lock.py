"""The lock of an output folder: one writer, and no lock outlives its owner."""

import json
import os
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import pytest

from cellquant import lock
from cellquant.errors import InputError
from cellquant.lock import LOCK, only_writer

HOLD = """
    import sys, time
    from pathlib import Path
    from cellquant.lock import only_writer
    with only_writer(Path({folder!r})):
        print("held", flush=True)
        time.sleep(60)
"""


def held_elsewhere(folder: Path) -> "subprocess.Popen[str]":
    code = textwrap.dedent(HOLD.format(folder=str(folder)))
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_a_living_owner_is_respected_and_a_killed_one_is_not(tmp_path: Path) -> None:
    with held_elsewhere(tmp_path) as owner:
        with pytest.raises(InputError, match=f"process {owner.pid}"), only_writer(tmp_path):
            pass
        owner.kill()
    with only_writer(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["pid"] == str(os.getpid())
    assert list(tmp_path.iterdir()) == []


def test_the_one_who_waits_comes_next(tmp_path: Path) -> None:
    order = []

    def second() -> None:
        with only_writer(tmp_path, wait=True):
            order.append("second")

    with only_writer(tmp_path):
        waiting = threading.Thread(target=second)
        waiting.start()
        time.sleep(0.2)
        order.append("first")
    waiting.join()
    assert order == ["first", "second"]


def foreign(folder: Path) -> Path:
    content = {"token": "t", "machine": "another machine", "pid": "1", "started": "1"}
    (folder / LOCK).write_text(json.dumps(content))
    return folder / LOCK


def test_a_silent_lock_of_another_machine_is_taken_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "STALE", 0.3)
    foreign(tmp_path)
    started = time.monotonic()
    with only_writer(tmp_path):
        assert time.monotonic() - started >= 0.3


def test_a_touched_lock_of_another_machine_is_respected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "STALE", 30.0)
    path = foreign(tmp_path)
    touch = threading.Timer(0.3, os.utime, [path])
    touch.start()
    with pytest.raises(InputError, match="another cellquant process"), only_writer(tmp_path):
        pass
    assert path.exists()


def test_the_owner_keeps_its_lock_alive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock, "BEAT", 0.05)
    with only_writer(tmp_path):
        before = (tmp_path / LOCK).stat().st_mtime_ns
        deadline = time.monotonic() + 20
        while (tmp_path / LOCK).stat().st_mtime_ns == before:
            assert time.monotonic() < deadline
            time.sleep(0.02)


def test_one_of_many_at_a_time(tmp_path: Path) -> None:
    inside, most = 0, 0

    def work() -> None:
        nonlocal inside, most
        for _ in range(5):
            with only_writer(tmp_path, wait=True):
                inside += 1
                most = max(most, inside)
                time.sleep(0.001)
                inside -= 1

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 1
