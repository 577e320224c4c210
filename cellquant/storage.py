"""Crash-safe output: a file or folder is there complete, or not at all.

Everything is written under a temporary name on the same file system, flushed to the disk and then
renamed, so that a reader, a second process or a restart never meets a half-written result. A
folder's manifest ``run.json`` is written last.
"""

import contextlib
import hashlib
import json
import os
import platform
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cellquant import __version__
from cellquant.errors import InputError

MANIFEST = "run.json"


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Give a temporary sibling to write to, and rename it to `path` when the block succeeds.

    Works for a file and for a folder (make the folder yourself at the temporary path). When the
    block raises, the temporary is removed and whatever stood at `path` before is untouched.

    Parameters
    ----------
    path
        Where the finished file or folder is to stand.

    Yields
    ------
    pathlib.Path
        A path that does not exist yet, in the same folder and with the same suffix.

    Raises
    ------
    InputError
        If the folder cannot be made or written, or the disk is full.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        holder = Path(tempfile.mkdtemp(prefix=f".{path.name[:100]}.", dir=path.parent))
    except OSError as error:
        raise InputError(
            f"cannot write {path}: {error.strerror}; choose an output path in a folder that "
            "exists or can be made, and that you may write to."
        ) from error
    temporary = holder / path.name
    try:
        try:
            yield temporary
            _flush(temporary)
            _replace(temporary, path, holder)
        except OSError as error:
            if error.filename is not None and not _inside(Path(str(error.filename)), holder):
                raise
            raise InputError(
                f"cannot write {path}: {error.strerror or error}; free space or choose another "
                "output path."
            ) from error
    finally:
        shutil.rmtree(holder, ignore_errors=True)


def check_output(path: str | Path) -> Path:
    """Make sure that a folder can be made or written at `path`, without making anything.

    Raises
    ------
    InputError
        If `path` is a file, lies below a file, or its nearest existing folder is not writable.
    """
    path = Path(path)
    nearest = path
    while not nearest.exists() and nearest != nearest.parent:
        nearest = nearest.parent
    if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(
            f"cannot write to {path}: {nearest} is not a folder that may be written; "
            "choose another output path."
        )
    return path


def _inside(path: Path, folder: Path) -> bool:
    return folder in (path, *path.parents)


def _flush(path: Path) -> None:
    files = [p for p in path.rglob("*") if p.is_file()] if path.is_dir() else [path]
    for file in files:
        descriptor = os.open(file, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _replace(temporary: Path, path: Path, holder: Path) -> None:
    # rename() cannot replace a folder that is not empty: the old one steps aside first.
    if path.is_dir() and not path.is_symlink():
        path.rename(holder / "replaced")
    temporary.replace(path)
    descriptor = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_json(path: str | Path, content: Any) -> None:
    """Write JSON crash-safely: sorted keys, indented, and refusing NaN and infinity."""
    text = json.dumps(content, sort_keys=True, indent=2, allow_nan=False, default=_plain) + "\n"
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "item") and getattr(value, "ndim", None) == 0:
        return value.item()
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no place in a JSON file")


def digest(path: str | Path) -> str:
    """SHA-256 of a file, or of the names and contents of all files below a folder."""
    path = Path(path)
    total = hashlib.sha256()
    if path.is_dir():
        for file in sorted(p for p in path.rglob("*") if p.is_file()):
            total.update(f"{file.relative_to(path).as_posix()}\0{digest(file)}\n".encode())
        return total.hexdigest()
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            total.update(block)
    return total.hexdigest()


def content_key(content: Mapping[str, Any]) -> str:
    """Key of a task: SHA-256 of its JSON-serialisable description and of the version."""
    text = json.dumps(
        {"version": __version__, **content}, sort_keys=True, allow_nan=False, default=_plain
    )
    return hashlib.sha256(text.encode()).hexdigest()


def finished_key(folder: Path, command: str) -> str | None:
    """Key of the work that `command` finished in a folder; None where there is none."""
    try:
        content = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        key = content["settings"]["key"] if content["command"] == command else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return key if isinstance(key, str) else None


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Hold the folder's lock, which the system frees even when the process is killed.

    Raises
    ------
    InputError
        If another process is working on the same folder.
    """
    descriptor = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(
                f"another cellquant process is writing to {folder}; wait until it has finished, "
                "or choose another output folder."
            ) from error
        except (ImportError, OSError):
            pass  # a file system without locks: renames still keep every file whole
        yield
    finally:
        os.close(descriptor)


@dataclass
class RunRecord:
    """What an output folder's ``run.json`` says: how the results were made, and at what cost.

    Attributes
    ----------
    command
        Name of the command.
    settings
        The resolved configuration.
    inputs
        SHA-256 of every input, by path as given.
    notes
        What the program found worth telling about the input and its own choices.
    """

    command: str
    settings: Mapping[str, Any]
    inputs: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    counts: dict[str, Any] = field(default_factory=dict)
    stages: list[dict[str, Any]] = field(default_factory=list)

    def add_input(self, path: str | Path) -> None:
        """Record the digest of an input file or folder."""
        self.inputs[str(path)] = digest(path)

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time one stage, in seconds of wall and of processor time."""
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.stages.append(
            {
                "stage": name,
                "wall_s": round(time.perf_counter() - wall, 3),
                "cpu_s": round(time.process_time() - cpu, 3),
            }
        )

    def as_dict(self) -> dict[str, Any]:
        """Everything known, with version and machine; JSON-serialisable."""
        return {
            "program": "cellquant",
            "version": __version__,
            "command": self.command,
            "settings": dict(self.settings),
            "inputs": self.inputs,
            "notes": self.notes,
            "counts": self.counts,
            "stages": self.stages,
            "machine": machine(),
        }

    def write(self, folder: str | Path) -> None:
        """Write ``run.json`` into `folder`; call it last, when every other file is there."""
        content = self.as_dict()
        path = Path(folder) / MANIFEST
        earlier = [r for r in _earlier(path) if r.get("command") != self.command]
        if earlier:
            content["earlier"] = earlier
        write_json(path, content)


def _earlier(path: Path) -> list[dict[str, Any]]:
    """Records of other commands that wrote into the same folder, so that none is lost."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return [*content.pop("earlier", []), content]
    except (OSError, ValueError, AttributeError, TypeError):
        return []


def machine() -> dict[str, Any]:
    """Describe the machine: processor kind, number of usable cores, operating system, Python."""
    return {
        "platform": platform.platform(),
        "processor": platform.machine(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "python": platform.python_version(),
    }
