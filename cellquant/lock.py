"""One writer per folder, on any file system: a lock file that its owner keeps alive.

Kernel locks are missing or local to one machine on many network file systems. Here the lock is a
file made with O_EXCL, which is atomic on NFS too. It names its owner, who touches it every
`BEAT` seconds. A lock is stale when its owner is a process of this machine that is gone, or when
nobody has touched it for `STALE` seconds, counted by the clock of the one who waits.
"""

import contextlib
import json
import os
import platform
import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

from cellquant.errors import InputError

LOCK = ".lock"
BEAT = 5.0
STALE = 60.0
_PAUSE = 0.05
_held: set[tuple[int, Path]] = set()  # by thread


@contextlib.contextmanager
def only_writer(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Be the only process that writes to a folder while the block runs.

    Inside such a block the same thread may ask for the same folder again.

    Parameters
    ----------
    folder
        An existing folder.
    wait
        Wait until another process has finished, instead of refusing.

    Raises
    ------
    InputError
        If another process is at work on the folder and `wait` is false.
    """
    mine = (threading.get_ident(), folder.resolve())
    if mine in _held:
        yield
        return
    path = folder / LOCK
    token = uuid.uuid4().hex
    content = json.dumps({"token": token, **_this_process()}, sort_keys=True)
    seen: tuple[str, int] | None = None
    seen_at = 0.0
    while True:
        found = _look(path)
        if found is None:
            if _take(path, content):
                break
            continue
        now = time.monotonic()
        first = seen is None
        if found != seen:
            seen, seen_at = found, now
            owner = _owner(found[0])
            local = owner is not None and owner["machine"] == _machine()
            alive = local and owner is not None and _is_alive(owner)
            if alive or not first:  # somebody lives: a local process, or a lock that was touched
                if not wait:
                    who = "another" if owner is None else f"process {owner['pid']}, another"
                    raise InputError(
                        f"{who} cellquant process is writing to {folder}; wait until it has "
                        "finished, or choose another output folder."
                    )
            elif local:
                _remove(path, found[0])
                continue
        elif now - seen_at > STALE or _is_gone(found[0]):
            _remove(path, found[0])
            continue
        time.sleep(_PAUSE)
    for left in folder.glob(f"{LOCK}.*.partial"):  # of those that were killed while they took it
        left.unlink(missing_ok=True)
    stop = threading.Event()
    beating = threading.Thread(target=_beat, args=(path, stop), daemon=True)
    beating.start()
    _held.add(mine)
    try:
        yield
    finally:
        _held.discard(mine)
        stop.set()
        beating.join()
        _remove(path, content)


def remove_stale(folder: Path) -> None:
    """Remove the lock that a killed process left in a folder; that of a living one stays."""
    if any(folder.glob(f"{LOCK}*")):
        found = _look(folder / LOCK)
        if found is None or _is_gone(found[0]):
            with contextlib.suppress(InputError), only_writer(folder):
                pass


def _take(path: Path, content: str) -> bool:
    """Make the lock file whole or not at all: written under a name of its own, then linked."""
    own = path.with_name(f"{LOCK}.{uuid.uuid4().hex}.partial")
    try:
        own.write_text(content, encoding="utf-8")
        try:
            os.link(own, path)
        except (FileExistsError, FileNotFoundError):
            return False
        except OSError:  # a file system without hard links
            try:
                descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
            except FileExistsError:
                return False
            with os.fdopen(descriptor, "w", encoding="utf-8") as stream:
                stream.write(content)
        return True
    except OSError as error:
        raise InputError(
            f"cannot write to {path.parent}: {error.strerror or error}; free space or choose "
            "another output folder."
        ) from error
    finally:
        own.unlink(missing_ok=True)


def _look(path: Path) -> tuple[str, int] | None:
    """Content of the lock and the time of its last touch; None where there is no lock."""
    try:
        return path.read_text(encoding="utf-8"), path.stat().st_mtime_ns
    except (OSError, UnicodeDecodeError):
        return None


def _remove(path: Path, content: str) -> None:
    """Remove the lock if it is still the one with this content."""
    aside = path.with_name(f"{LOCK}.{uuid.uuid4().hex}.partial")
    with contextlib.suppress(OSError):
        path.rename(aside)
        if aside.read_text(encoding="utf-8") != content:  # a new owner came first: put it back
            os.link(aside, path)
        aside.unlink()


def _beat(path: Path, stop: threading.Event) -> None:
    while not stop.wait(BEAT):
        with contextlib.suppress(OSError):
            os.utime(path)


def _owner(content: str) -> dict[str, str] | None:
    try:
        found = json.loads(content)
        return {name: str(found[name]) for name in ("machine", "pid", "started")}
    except (ValueError, KeyError, TypeError):
        return None


def _is_gone(content: str) -> bool:
    owner = _owner(content)
    return owner is not None and owner["machine"] == _machine() and not _is_alive(owner)


def _this_process() -> dict[str, str]:
    pid = str(os.getpid())
    return {"machine": _machine(), "pid": pid, "started": _started(pid)}


def _machine() -> str:
    """Name of everything within which a process number means one process."""
    parts = [platform.node()]
    with contextlib.suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text().strip())
    with contextlib.suppress(OSError):
        parts.append(str(os.stat("/proc/self/ns/pid").st_ino))
    return "/".join(parts)


def _is_alive(owner: dict[str, str]) -> bool:
    try:
        os.kill(int(owner["pid"]), 0)
    except ProcessLookupError:
        return False
    except (OSError, ValueError):
        pass  # it lives and is not ours
    return _started(owner["pid"]) == owner["started"]


def _started(pid: str) -> str:
    """When a process began, so that a number used again is not taken for its first owner."""
    try:
        state, *rest = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return "ended" if state in "ZX" else rest[18]
    except (OSError, IndexError, ValueError):
        return ""
