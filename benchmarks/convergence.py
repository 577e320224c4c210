"""Error against run time on the reference scene, three seeds; writes the figure for the docs."""

import json
import shutil
from pathlib import Path

from cellquant.sim import Scene, convergence

RESULTS = Path(__file__).parent / "results"
DOCS = Path(__file__).parents[1] / "docs"


def main():
    result = convergence(Scene(n_cells=144), RESULTS / "convergence")
    table = result.table.groupby(["contact", "integrator", "dt"])[
        ["error", "cpu_seconds", "evaluations"]
    ].mean()
    print(table.to_string(float_format="%.3g"))
    print(json.dumps(result.recommendation, indent=1))
    rows = table.reset_index().to_dict("records")
    content = {"recommendation": result.recommendation, "table": rows}
    (RESULTS / "convergence.json").write_text(json.dumps(content, indent=1) + "\n")
    images = DOCS / "images"
    images.mkdir(exist_ok=True)
    (RESULTS / "convergence" / "convergence.svg").replace(images / "convergence.svg")
    shutil.rmtree(RESULTS / "convergence")


if __name__ == "__main__":
    main()
