"""Run every benchmark, each in a process of its own; results go to benchmarks/results/NAME.json."""

import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
SHARED = {"run_all.py", "synthetic_layer.py"}
LONG = {"published_values.py", "fault_campaign.py"}  # run them by hand, they resume
REPORTS = {"simulation_report.py"}  # written from the results of the others


def main() -> None:
    failed = []
    for script in sorted(HERE.glob("*.py"), key=lambda path: (path.name in REPORTS, path.name)):
        if script.name in SHARED | LONG or "__main__" not in script.read_text(encoding="utf-8"):
            continue
        print(f"== {script.name}", flush=True)
        if subprocess.run([sys.executable, str(script)], cwd=HERE, check=False).returncode:
            failed.append(script.name)
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
