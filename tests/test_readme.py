"""The README's example runs as printed, and the commands it names exist."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_python_example_runs(tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert len(code.strip().splitlines()) <= 12
    shutil.copy(ROOT / "cellquant" / "demo_data" / "masks.tif", tmp_path / "masks.tif")
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert re.search(r"shape index \d\.\d{3} ± \d\.\d{3}, n = \d+", done.stdout)
    assert (tmp_path / "observables" / "summary.json").is_file()
    assert len(pd.read_parquet(tmp_path / "tracks.parquet")) > 1000


def test_every_command_of_the_readme_exists() -> None:
    from typer.main import get_command

    from cellquant.cli import app

    known = set(get_command(app).commands)
    table = README.split("## Commands")[1].split("## ")[0]
    named = {name.split()[0] for name in re.findall(r"^\| `([a-z -]+)` \|", table, flags=re.M)}
    assert named
    assert named <= known


def test_links_point_to_files() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        if not target.startswith("http"):
            assert (ROOT / target).exists(), target
