"""List what an installation of cellquant brings along: names, versions, licences.

    python benchmarks/dependencies.py

Writes docs/dependencies.md from the metadata of the installed packages, following the requirements
of cellquant and of its extras. Known weaknesses are for `pip-audit`, which needs its database from
the network.
"""

import re
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

PAGE = Path(__file__).resolve().parents[1] / "docs" / "dependencies.md"


EXTRAS = ("evaluate", "cluster", "geff")


def closure(name: str, extra: str = "") -> dict[str, metadata.Distribution]:
    """Every installed distribution that `name` requires with an extra, itself left out."""
    found: dict[str, metadata.Distribution] = {}
    waiting = [(name, extra)]
    while waiting:
        here, wanted = waiting.pop()
        for text in metadata.distribution(here).requires or ():
            requirement = Requirement(text)
            key = re.sub(r"[-_.]+", "-", requirement.name).lower()
            marker = requirement.marker
            if key in found or (marker is not None and not marker.evaluate({"extra": wanted})):
                continue
            found[key] = metadata.distribution(requirement.name)
            waiting += [(requirement.name, each) for each in ("", *requirement.extras)]
    return found


def licence(distribution: metadata.Distribution) -> str:
    """The licence by expression, by classifier, or by its text."""
    content = distribution.metadata
    if content.get("License-Expression"):
        return str(content["License-Expression"])
    classifiers = content.get_all("Classifier") or []
    named = [c.split(" :: ")[-1] for c in classifiers if c.startswith("License ::")]
    named = [name for name in named if name != "OSI Approved"]
    if named:
        return ", ".join(named)
    if content.get("License"):
        return str(content["License"]).strip().splitlines()[0][:60]
    texts = [f.read_text() for f in distribution.files or () if "licen" in f.name.lower()]
    if any("Redistribution and use in source and binary forms" in text for text in texts):
        return "BSD, by the text of its licence"
    return "not stated"


def table(found: dict[str, metadata.Distribution]) -> list[str]:
    return [
        "| package | version | licence |",
        "|---|---|---|",
        *(f"| {name} | {each.version} | {licence(each)} |" for name, each in sorted(found.items())),
        "",
    ]


def main() -> None:
    core = closure("cellquant")
    lines = [
        "# Dependencies",
        "",
        "What an installation brings along, as last checked, from the metadata of the installed",
        "packages; made by `python benchmarks/dependencies.py`. Whether a version has a known",
        "weakness changes daily and needs a database from the network: `pip install pip-audit`,",
        "then `pip-audit` in the environment of the installation.",
        "",
        "## `pip install cellquant`",
        "",
        *table(core),
    ]
    for extra in EXTRAS:
        more = {k: v for k, v in closure("cellquant", extra).items() if k not in core}
        lines += [f"## `pip install 'cellquant[{extra}]'` brings besides", "", *table(more)]
    PAGE.write_text("\n".join(lines), encoding="utf-8")
    print(f"{len(core)} packages without extras")


if __name__ == "__main__":
    main()
