"""The digest of the code that can reach a result: changed code always counts, other code never."""

import ast
import shutil
from pathlib import Path

import pytest

from cellquant import fingerprint
from cellquant.fingerprint import code_digest, rooms_reached

PACKAGE = Path(fingerprint.__file__).parent


@pytest.fixture
def copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    package = tmp_path / "cellquant"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__", "demo_data"))
    monkeypatch.setattr(fingerprint, "PACKAGE", package)
    forget()
    return package


def forget() -> None:
    code_digest.cache_clear()
    rooms_reached.cache_clear()


@pytest.fixture(autouse=True)
def _forget_afterwards() -> "object":
    yield
    forget()


def test_a_copy_has_the_same_digest(copy: Path) -> None:
    there = code_digest("sweep")
    forget()
    fingerprint.PACKAGE = PACKAGE
    assert code_digest("sweep") == there


@pytest.mark.parametrize(
    ("changed", "sweep", "batch"),
    [
        ("sim/crossings.py", True, True),
        ("observables/fits.py", True, True),
        ("tables.py", True, True),
        ("__init__.py", True, True),
        ("compare/report.py", False, True),
        ("study.py", False, True),
        ("cli/text.py", False, False),
        ("demo.py", False, False),
    ],
)
def test_what_changes_which_digest(copy: Path, changed: str, sweep: bool, batch: bool) -> None:
    before = code_digest("sweep"), code_digest("batch")
    forget()
    path = copy / changed
    path.write_text(path.read_text() + "\nchanged = True\n")
    assert (code_digest("sweep") != before[0], code_digest("batch") != before[1]) == (sweep, batch)


def test_every_import_is_followed() -> None:
    """The patterns find what the syntax tree of every module names."""
    rooms = {p.stem for p in PACKAGE.glob("*.py")} | {
        p.parent.name for p in PACKAGE.glob("*/__init__.py")
    }
    for path in PACKAGE.rglob("*.py"):
        named = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            else:
                continue
            named |= {n.split(".")[1] for n in names if n.startswith("cellquant.")}
        found = fingerprint._imports(path.read_text())
        assert named & rooms <= found, path
