"""The direction of imports, and what may not be loaded at all."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "cellquant"

# Each room may import the rooms named here (and itself); the data flow one way.
FOUNDATION = {"errors", "tables", "rows", "storage", "lock", "fingerprint", "config", "io"}
ALLOWED: dict[str, set[str]] = {
    "errors": set(),
    "parquet": {"errors"},
    "tables": {"errors", "parquet"},
    "rows": {"errors", "tables"},
    "lock": {"errors"},
    "fingerprint": set(),
    "storage": {"errors", "lock", "fingerprint"},
    "config": {"errors", "tables", "storage"},
    "io": {"errors", "tables", "storage", "config"},
    "statistics": FOUNDATION,
    "observables": FOUNDATION | {"statistics"},
    "segment": FOUNDATION | {"observables", "statistics"},
    "track": FOUNDATION | {"observables", "statistics", "segment"},
    "sim": FOUNDATION | {"observables", "statistics"},
    "compare": FOUNDATION | {"observables", "statistics", "segment", "track", "sim"},
    "engines": FOUNDATION | {"cluster"},
    "cluster": FOUNDATION | {"engines"},
    "pipeline": FOUNDATION | {"observables", "segment", "track", "sim"},
    "study": FOUNDATION | {"observables", "statistics", "compare"},
    "batch": FOUNDATION
    | {"observables", "segment", "track", "sim", "compare", "pipeline", "engines", "study"},
    "sweep": FOUNDATION | {"observables", "sim", "pipeline", "engines"},
    "slurm": FOUNDATION,
    "estimate": FOUNDATION | {"observables", "sim"},
    "rerun": FOUNDATION | {"sim", "pipeline", "batch", "sweep"},
    "closed_loop": FOUNDATION | {"observables", "segment", "track", "sim", "pipeline"},
    "demo": FOUNDATION | {"observables", "track", "sim", "compare", "pipeline", "closed_loop"},
}
FORBIDDEN = {"napari", "PyQt5", "PyQt6", "PySide2", "PySide6", "qtpy", "pickle", "shelve"}
HEAVY = ("numba", "statsmodels", "matplotlib", "trackpy", "pandas", "scipy", "cv2", "zarr")


def room(path: Path) -> str:
    part = path.relative_to(PACKAGE).parts[0]
    return part.removesuffix(".py")


def imported(path: Path) -> list[str]:
    names: list[str] = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}:{node.lineno} uses a relative import"
            names.append(node.module or "")
            if node.module == "cellquant":
                names += [f"cellquant.{alias.name}" for alias in node.names]
    return names


MODULES = sorted(PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_one_way(path: Path) -> None:
    here = room(path)
    for name in imported(path):
        parts = name.split(".")
        assert parts[0] not in FORBIDDEN, f"{path.name} imports {name}"
        if parts[0] != "cellquant" or len(parts) == 1 or here in {"cli", "__main__", "__init__"}:
            continue
        if parts[1] == "__version__":
            continue
        assert parts[1] == here or parts[1] in ALLOWED[here], f"{here} may not import {name}"


def test_package_imports_nothing_heavy() -> None:
    code = (
        "import sys, cellquant; "
        f"loaded = [m for m in {HEAVY!r} if m in sys.modules]; "
        "assert not loaded, loaded"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
