"""The package as others get it: a wheel in a bare environment, also installed read-only."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_wheel_installs_and_runs_in_a_bare_environment(tmp_path: Path) -> None:
    """Needs an index of packages, as an installation does."""
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", str(tmp_path), str(ROOT)], check=True)
    (wheel,) = tmp_path.glob("cellquant-*.whl")
    bare = tmp_path / "bare"
    subprocess.run([sys.executable, "-m", "venv", str(bare)], check=True)
    python = bare / "bin" / "python"
    subprocess.run(
        [str(python), "-m", "pip", "--disable-pip-version-check", "install", "-q", str(wheel)],
        check=True,
    )
    package = next(bare.glob("lib/python*/site-packages/cellquant"))
    read_only = stat.S_IRUSR | stat.S_IXUSR
    for folder in [package, *(p for p in package.rglob("*") if p.is_dir())]:
        folder.chmod(read_only)
    environment = {
        k: v for k, v in os.environ.items() if k not in {"PYTHONPATH", "NUMBA_CACHE_DIR"}
    }
    environment["HOME"] = str(tmp_path / "home")
    (tmp_path / "home").mkdir()
    sweep = tmp_path / "s.toml"
    sweep.write_text("[scene]\ncells = 9\ntransient = 1\nduration = 4\n")
    for command in (
        ["--version"],
        ["sweep", str(sweep), "-o", str(tmp_path / "out"), "--workers", "2"],
        ["demo", "-o", str(tmp_path / "demo")],
    ):
        subprocess.run(
            [str(bare / "bin" / "cellquant"), *command], check=True, env=environment, cwd=tmp_path
        )
    assert (tmp_path / "demo" / "report.html").is_file()
    assert (tmp_path / "out" / "sweep.parquet").is_file()
