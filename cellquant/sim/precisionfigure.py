"""The work-precision diagram as a figure."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

AVERAGES = {"shape_index": "<p>", "msd": "MSD / L0²", "scattering": "F_s", "tau_alpha": "tau / t0"}


def draw(table: pd.DataFrame, weak: pd.DataFrame, sampling_error: float, path: Path) -> None:
    """Draw strong errors against CPU time, one curve per method, and the weak errors below."""
    import matplotlib as mpl

    mpl.use("svg")
    import matplotlib.pyplot as plt

    names = [] if weak.empty else [n for n in AVERAGES if _measured(weak, n).any()]
    with mpl.rc_context({"svg.hashsalt": "cellquant", "svg.fonttype": "none"}):
        figure = plt.figure(figsize=(10.0, 7.4 if names else 4.2), layout="constrained")
        parts: Any = figure.subfigures(
            2 if names else 1, 1, height_ratios=(1.0, 0.75)[: 1 + bool(names)]
        )
        strong = (parts[0] if names else parts).subplots(1, 2)
        styles: dict[str, int] = {}
        for (contact, integrator, points), group in table.groupby(
            ["contact", "integrator", "points"]
        ):
            key = "tolerance" if integrator == "adaptive" else "dt"
            means = group.groupby(key)[["cpu_seconds", "error", "shape_error"]].agg(
                {"cpu_seconds": "median", "error": _rms, "shape_error": _rms}
            )
            label = _label(contact, integrator, points)
            style = styles.setdefault(label, len(styles))
            for axis, column in zip(strong, ("error", "shape_error"), strict=True):
                axis.loglog(
                    means["cpu_seconds"], means[column], "osD^v<>P"[style % 8] + "-",
                    color=f"C{style}", markersize=4, linewidth=1.2, label=label,
                )  # fmt: skip
        strong[1].axhline(sampling_error, color="0.5", linestyle="--", label="sampling error")
        strong[0].set_ylabel("RMS error of positions / L0")
        strong[1].set_ylabel("error of <p>")
        for axis in strong:
            axis.set_xlabel("CPU time / s")
            axis.grid(alpha=0.25)
        strong[0].legend(fontsize=7)
        strong[1].legend(*_last(strong[1]), fontsize=7)
        if names:
            for axis, name in zip(
                parts[1].subplots(1, len(names), squeeze=False)[0], names, strict=True
            ):
                _draw_weak(axis, weak[weak["observable"] == name], styles)
                axis.set_ylabel(f"difference of {AVERAGES[name]}")
        figure.savefig(path, metadata={"Date": None})
        plt.close(figure)


def _draw_weak(axis: Any, group: pd.DataFrame, styles: dict[str, int]) -> None:
    """Differences to the finest method; the band is the sampling error."""
    sampling = float(group["sampling_error"].iloc[0])
    axis.axhspan(-sampling, sampling, color="0.92")
    for side in (-sampling, sampling):
        axis.axhline(side, color="0.5", linestyle="--", linewidth=1.0)
    for (contact, integrator, points), rows in group.groupby(["contact", "integrator", "points"]):
        style = styles.get(_label(contact, integrator, points), 7)
        axis.errorbar(
            rows["cpu_seconds"], rows["difference"], rows["difference_std_error"],
            fmt="osD^v<>P"[style % 8] + "-", color=f"C{style}", markersize=4, capsize=2,
            linewidth=0.8,
        )  # fmt: skip
    axis.set_xscale("log")
    axis.xaxis.set_minor_formatter("")
    axis.set_xlabel("CPU time per t0 / s")


def _label(contact: Any, integrator: Any, points: Any) -> str:
    return f"{contact} {points or ''} {integrator}".replace("  ", " ")


def _measured(weak: pd.DataFrame, name: str) -> "pd.Series[bool]":
    rows = weak[weak["observable"] == name]
    return rows["difference"].notna() & rows["sampling_error"].notna()


def _last(axis: Any) -> tuple[list[Any], list[str]]:
    handles, labels = axis.get_legend_handles_labels()
    return handles[-1:], labels[-1:]


def _rms(values: "pd.Series[float]") -> float:
    return float(np.sqrt(np.mean(np.square(values))))
