"""Crash-safe output: a file or folder is there complete, or not at all.

Everything is written under a temporary name on the same file system, flushed to the disk and then
renamed, so that a reader, a second process or a restart never meets a half-written result. A
folder's manifest ``run.json`` is written last.
"""

import contextlib
import errno
import hashlib
import json
import os
import platform
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from cellquant import __version__
from cellquant.errors import InputError
from cellquant.fingerprint import code_digest
from cellquant.lock import LOCK, only_writer

MANIFEST = "run.json"
_LIBRARIES = (
    *("numpy", "scipy", "numba", "pandas", "pyarrow", "opencv-python-headless"),
    *("scikit-image", "scikit-learn", "tifffile", "imagecodecs", "zarr", "trackpy"),
)
FINISHED = "finished.json"  # folders of the results that belong to a study or a sweep
STARTED = ".started"  # key of the work that a folder holds, finished or not
_CLOSED = {errno.EACCES, errno.EPERM}
_DISK_ERRORS = {
    *_CLOSED,
    *(getattr(errno, name) for name in ("ENOSPC", "EDQUOT", "EFBIG", "EROFS", "EIO")
      if hasattr(errno, name)),
}  # fmt: skip


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
    with _holder(path.parent, path) as holder, _clear_errors(path, holder):
        temporary = holder / path.name
        yield temporary
        _flush(temporary)
        _replace(temporary, path, holder)


@contextlib.contextmanager
def replace_together(folder: str | Path) -> Iterator[Path]:
    """Give an empty folder to write to, and move what it holds into `folder` when the block ends.

    For results that belong together: when one of them cannot be written, all the old ones stay.
    The manifest comes last, and an old one goes first, so that a folder with a manifest never
    holds a mixture. Other writers to the folder wait.

    Parameters
    ----------
    folder
        The output folder; made when it does not exist.

    Yields
    ------
    pathlib.Path
        A folder on the same file system.

    Raises
    ------
    InputError
        If the folder cannot be made or written, or the disk is full.
    """
    folder = make_folder(folder)
    with (
        clear_disk_errors(),
        only_writer(folder, wait=True),
        _holder(folder, Path("together")) as holder,
        _clear_errors(folder, holder),
    ):
        for left in folder.glob(".together.*.partial"):  # of those that were killed
            if left != holder:
                shutil.rmtree(left, ignore_errors=True)
        staged = holder / "staged"
        staged.mkdir()
        yield staged
        _flush(staged)
        if (staged / MANIFEST).is_file():
            (folder / MANIFEST).unlink(missing_ok=True)
        for entry in sorted(staged.iterdir(), key=lambda entry: (entry.name == MANIFEST, entry)):
            _replace(entry, folder / entry.name, holder)


@contextlib.contextmanager
def _holder(folder: Path, target: Path) -> Iterator[Path]:
    """A temporary folder inside `folder`, which is made where it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        holder = Path(tempfile.mkdtemp(".partial", f".{target.name[:100]}.", folder))
    except OSError as error:
        raise InputError(
            f"cannot write to {folder}: {error.strerror}; choose an output path in a folder that "
            "exists or can be made, and that you may write to."
        ) from error
    try:
        yield holder
    finally:
        shutil.rmtree(holder, ignore_errors=True)


@contextlib.contextmanager
def _clear_errors(target: Path, holder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.filename is not None and not _inside(Path(str(error.filename)), holder):
            raise
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise InputError(
            f"cannot write {target}: {reason}; free space or choose another output path."
        ) from error


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


def make_folder(path: str | Path) -> Path:
    """Make a folder and those above it; `InputError` where that cannot be done."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"cannot make the folder {path}: {error.strerror}; choose another output path."
        ) from error
    return path


def _inside(path: Path, folder: Path) -> bool:
    return folder in (path, *path.parents)


def _flush(path: Path) -> None:
    for entry in [*path.rglob("*"), path] if path.is_dir() else [path]:
        _fsync(entry)


def _fsync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _replace(temporary: Path, path: Path, holder: Path) -> None:
    # rename() cannot replace a folder that is not empty: the old one steps aside first.
    if path.is_dir() and not path.is_symlink():
        path.rename(holder / f"replaced {path.name}")
    temporary.replace(path)
    _fsync(path.parent)


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
    """Key of a task: SHA-256 of its JSON-serialisable description.

    What decides the result belongs into it: configuration, digests of the inputs, and
    `cellquant.fingerprint.code_digest` of the code.
    """
    text = json.dumps(content, sort_keys=True, allow_nan=False, default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()


def finished_key(folder: Path, command: str) -> str | None:
    """Key of the work that `command` finished in a folder; None where there is none."""
    return _key_of(_read_manifest(folder), command)


def earlier_record(folder: Path, command: str, key: str) -> dict[str, Any] | None:
    """Record of the finished work of `command` with this key, also where others came after it."""
    last = _read_manifest(folder)
    records = [last, *(last.get("earlier", []) if isinstance(last, dict) else [])]
    return next((r for r in records if _key_of(r, command) == key), None)


def _read_manifest(folder: Path) -> Any:
    try:
        return json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _key_of(record: Any, command: str) -> str | None:
    try:
        key = record["settings"]["key"] if record["command"] == command else None
    except (KeyError, TypeError):
        return None
    return key if isinstance(key, str) else None


def begin(folder: Path, key: str) -> None:
    """Make a folder ready for the work with this key: what another work left there is removed.

    Unfinished work with the same key is kept, apart from files that were not finished. The caller
    holds the folder's lock.
    """
    started = folder / STARTED
    try:
        same = started.read_text(encoding="utf-8") == key
    except (OSError, UnicodeDecodeError):
        same = False
    if same:
        remove_partial(folder)
        return
    started.unlink(missing_ok=True)
    for entry in folder.iterdir():
        if entry.name.startswith(LOCK):
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()
    with atomic_path(started) as path:
        path.write_text(key, encoding="utf-8")


def remove_partial(folder: Path, *, below: bool = True) -> None:
    """Remove what killed writers left under temporary names; the caller holds the lock."""
    find = folder.rglob if below else folder.glob
    for entry in list(find("*.partial")):
        if entry.is_dir():
            shutil.rmtree(entry, ignore_errors=True)
        elif not entry.name.startswith(LOCK):
            entry.unlink(missing_ok=True)


@contextlib.contextmanager
def clear_disk_errors() -> Iterator[None]:
    """Say in one sentence that a disk is full, read-only or closed to us.

    Raises
    ------
    InputError
        Instead of the `OSError` of such a disk; other errors pass.
    """
    try:
        yield
    except OSError as error:
        problem = disk_problem(error)
        if problem is None:
            raise
        raise InputError(problem) from error


def disk_problem(error: BaseException) -> str | None:
    """One sentence for a disk that is full, read-only or closed to us; None for other errors."""
    if not isinstance(error, OSError) or error.errno is None or error.errno not in _DISK_ERRORS:
        return None
    reason = os.strerror(error.errno)
    if error.errno in _CLOSED and error.filename:
        return (
            f"{error.filename} is closed to you ({reason}); change its permissions or choose "
            "another path, then run the same command again."
        )
    what = f"cannot write {error.filename}" if error.filename else "cannot write the results"
    return (
        f"{what}: {reason}; free space or choose an output folder that you may write to, then run "
        "the same command again."
    )


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

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "RunRecord":
        """The record that `as_dict` has written."""
        parts = ("settings", "inputs", "notes", "counts", "stages")
        return cls(content["command"], **{name: content[name] for name in parts})

    def as_dict(self) -> dict[str, Any]:
        """Everything known, with version and machine; JSON-serialisable."""
        return {
            "program": "cellquant",
            "version": __version__,
            "code": code_digest("pipeline"),
            "libraries": libraries(),
            "command": self.command,
            "working_folder": os.getcwd(),
            "settings": dict(self.settings),
            "inputs": self.inputs,
            "notes": self.notes,
            "counts": self.counts,
            "stages": self.stages,
            "machine": machine(),
        }

    def write(self, folder: str | Path, *, after: str | Path | None = None) -> None:
        """Write ``run.json`` into `folder`; call it last, when every other file is there.

        The records of other commands in `after` are kept; that is `folder` itself when None.
        """
        content = self.as_dict()
        earlier = _earlier(Path(folder if after is None else after) / MANIFEST)
        earlier = [r for r in earlier if r.get("command") != self.command]
        if earlier:
            content["earlier"] = earlier
        write_json(Path(folder) / MANIFEST, content)


def _earlier(path: Path) -> list[dict[str, Any]]:
    """Records of other commands that wrote into the same folder, so that none is lost."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return [*content.pop("earlier", []), content]
    except (OSError, ValueError, AttributeError, TypeError):
        return []


@cache
def libraries() -> dict[str, str]:
    """Versions of the libraries that a result can depend on."""
    found = {}
    for name in _LIBRARIES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


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
