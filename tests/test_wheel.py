"""The package as others get it: a wheel in a bare environment, also installed read-only."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """Close a folder for writing; root, whom no mode stops, mounts it so."""
    mount, unmount = ["mount", "--bind", folder, folder], ["umount", "--lazy", folder]
    if os.geteuid() == 0:
        subprocess.run(mount, check=True)
        subprocess.run(["mount", "-o", "remount,bind,ro", folder], check=True)
    else:
        unmount = ["chmod", "-R", "u+w", folder]
        subprocess.run(["chmod", "-R", "a-w", folder], check=True)
    try:
        with pytest.raises(OSError, match=r"Read-only|Permission"):
            (folder / "probe").touch()
        yield
    finally:
        subprocess.run(unmount, check=True)


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
    environment = {
        k: v for k, v in os.environ.items() if k not in {"PYTHONPATH", "NUMBA_CACHE_DIR"}
    }
    environment["HOME"] = str(tmp_path / "home")
    (tmp_path / "home").mkdir()
    sweep = tmp_path / "s.toml"
    sweep.write_text("[scene]\ncells = 9\ntransient = 1\nduration = 4\n")
    cellquant = bare / "bin" / "cellquant"
    out = ["-o", str(tmp_path / "out"), "--workers", "2"]

    def run(*command: str) -> None:
        subprocess.run([str(cellquant), *command], check=True, env=environment, cwd=tmp_path)

    with read_only(package):
        run("--version")
        run("sweep", str(sweep), *out)
        kernels = set((tmp_path / "home").rglob("*.nbc"))
        assert len(kernels) > 10, "compiled code is kept with the user"
        run("sweep", str(sweep), "-o", str(tmp_path / "again"))
        assert set((tmp_path / "home").rglob("*.nbc")) == kernels, "and found there"
        run("demo", "-o", str(tmp_path / "demo"))
    assert not list(package.rglob("*.nbc"))
    assert (tmp_path / "demo" / "report.html").is_file()
    assert (tmp_path / "out" / "sweep.parquet").read_bytes() == (
        tmp_path / "again" / "sweep.parquet"
    ).read_bytes()
