"""Which code makes a result: a digest of the source that a module can reach.

Results are recognised by a key, and code is part of it, so that results of changed code are made
again and those of unchanged code are not. Rooms that a job never imports (the command line, say)
may change without costing anything.
"""

import hashlib
import re
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent
_IMPORT = re.compile(r"^[ \t]*(?:from|import)[ \t]+cellquant\b([^\n(]*)(\([^)]*\))?", re.MULTILINE)
_DATA = {"demo_data", "__pycache__"}


@cache
def code_digest(room: str) -> str:
    """SHA-256 of every source file and template of a room and of the rooms it can import.

    A room is a module or sub-package right below ``cellquant``. Imports inside functions count;
    one that is built at run time does not.

    Parameters
    ----------
    room
        Name of the room in which the job is defined, e.g. ``"sweep"``.
    """
    total = hashlib.sha256()
    for file in _files(rooms_reached(room)):
        total.update(f"{file.relative_to(PACKAGE).as_posix()}\0".encode())
        total.update(hashlib.sha256(file.read_bytes()).digest())
    return total.hexdigest()


@cache
def rooms_reached(room: str) -> tuple[str, ...]:
    """The room itself and every room that it imports, directly or through others, sorted."""
    reached: set[str] = set()
    waiting = {room, "__init__"}
    while waiting:
        here = waiting.pop()
        reached.add(here)
        for file in _files((here,)):
            if file.suffix == ".py" and here != "__init__":
                waiting |= _imports(file.read_text(encoding="utf-8")) - reached
    return tuple(sorted(reached))


def _imports(text: str) -> set[str]:
    """Rooms named by the import statements of a module; names that are no room are left out."""
    names: set[str] = set()
    for rest, inside in _IMPORT.findall(text):
        if rest.startswith("."):
            names.add(re.split(r"\W", rest[1:], maxsplit=1)[0])
        else:  # from cellquant import a, b
            names |= set(re.findall(r"\w+", rest + inside)) - {"import", "as"}
    return {name for name in names if _files((name,))}


def _files(rooms: tuple[str, ...]) -> list[Path]:
    files: list[Path] = []
    for room in rooms:
        folder, module = PACKAGE / room, PACKAGE / f"{room}.py"
        if module.is_file():
            files.append(module)
        elif folder.is_dir() and room not in _DATA:
            files += [
                path
                for path in folder.rglob("*")
                if path.is_file() and "__pycache__" not in path.parts
            ]
    return sorted(files)
