"""The fault campaign: kills at random moments of a study and of a sweep, then the same bytes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

CAMPAIGN = Path(__file__).resolve().parents[1] / "benchmarks" / "fault_campaign.py"
KILLS = {"kill at a file operation", "kill at a time", "command with two workers"}


@pytest.mark.slow
@pytest.mark.timeout(4 * 3600)
def test_two_hundred_kills_end_in_the_same_bytes(pytestconfig: pytest.Config) -> None:
    """Goes on where it was stopped; once it has passed, it begins anew."""
    folder = pytestconfig.cache.mkdir("fault_campaign")
    done = subprocess.run([sys.executable, str(CAMPAIGN), "--results", str(folder)], check=False)
    files = [folder / f"fault_campaign_{job}.json" for job in ("run", "sweep")]
    rows = [row for file in files for row in json.loads(file.read_text())]
    now = [row for row in rows if row["code"] == rows[-1]["code"]]
    assert [row for row in now if row["problem"]] == []
    assert done.returncode == 0
    assert sum(row["fault"] in KILLS for row in now) >= 200
    for file in files:
        file.unlink()
