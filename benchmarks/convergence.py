"""Error against run time on the reference scene, three seeds; writes the figure for the docs."""

import json
import shutil
from pathlib import Path

from cellquant.sim import Scene, convergence

RESULTS = Path(__file__).parent / "results"
DOCS = Path(__file__).parents[1] / "docs"


def main():
    result = convergence(Scene(n_cells=144), RESULTS / "convergence")
    keys = ["contact", "points", "integrator", "dt"]
    table = result.table.copy()
    loose = table["tolerance"].notna()
    # The adaptive method takes other steps with every seed: one row per tolerance.
    table.loc[loose, "dt"] = table[loose].groupby("tolerance")["dt"].transform("mean")
    table = table.groupby(keys)[["error", "cpu_seconds", "evaluations"]].agg(
        {"error": lambda e: (e**2).mean() ** 0.5, "cpu_seconds": "median", "evaluations": "mean"}
    )
    print(table.to_string(float_format="%.3g"))
    print(result.weak.to_string(float_format="%.3g"))
    print(result.recommendation["text"])
    content = {
        "recommendation": result.recommendation,
        "reference_error": result.reference_error,
        "sampling_error": result.sampling_error,
        "table": json.loads(table.reset_index().to_json(orient="records")),
        "weak": json.loads(result.weak.to_json(orient="records")),
    }
    (RESULTS / "convergence.json").write_text(json.dumps(content, indent=1) + "\n")
    images = DOCS / "images"
    images.mkdir(exist_ok=True)
    (RESULTS / "convergence" / "convergence.svg").replace(images / "convergence.svg")
    shutil.rmtree(RESULTS / "convergence")


if __name__ == "__main__":
    main()
