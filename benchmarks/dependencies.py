"""List what an installation of cellquant brings along: names, versions, licences.

    python benchmarks/dependencies.py

Writes docs/dependencies.md from the metadata of the installed packages, following the
requirements of cellquant without its extras. Known weaknesses are for `pip-audit`, which needs its
database from the network: `pip-audit -r <(pip freeze)`.
"""

import re
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

PAGE = Path(__file__).resolve().parents[1] / "docs" / "dependencies.md"


def closure(name: str) -> dict[str, metadata.Distribution]:
    """Every installed distribution that `name` requires, itself left out."""
    found: dict[str, metadata.Distribution] = {}
    waiting = [name]
    while waiting:
        for text in metadata.distribution(waiting.pop()).requires or ():
            requirement = Requirement(text)
            key = re.sub(r"[-_.]+", "-", requirement.name).lower()
            marker = requirement.marker
            if key in found or (marker is not None and not marker.evaluate({"extra": ""})):
                continue
            found[key] = metadata.distribution(requirement.name)
            waiting.append(requirement.name)
    return found


def licence(distribution: metadata.Distribution) -> str:
    """The licence by expression, by classifier, or by the first words of its text."""
    content = distribution.metadata
    if content.get("License-Expression"):
        return str(content["License-Expression"])
    classifiers = content.get_all("Classifier") or []
    named = [c.split(" :: ")[-1] for c in classifiers if c.startswith("License ::")]
    named = [name for name in named if name != "OSI Approved"]
    if named:
        return ", ".join(named)
    return (str(content.get("License") or "not stated").strip().splitlines() or ["not stated"])[0][
        :60
    ]


def main() -> None:
    rows = sorted(closure("cellquant").items())
    lines = [
        "# Dependencies",
        "",
        "What `pip install cellquant` brings along, as last checked; made by",
        "`python benchmarks/dependencies.py`. Extras (Dask, evaluation, GEFF) are not listed.",
        "",
        "| package | version | licence |",
        "|---|---|---|",
        *(f"| {name} | {found.version} | {licence(found)} |" for name, found in rows),
        "",
    ]
    PAGE.write_text("\n".join(lines), encoding="utf-8")
    print(f"{len(rows)} packages")


if __name__ == "__main__":
    main()
