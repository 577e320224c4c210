"""Fits of a comparison: for each layer the ranking of scenes and the estimated parameters."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cellquant.compare.figures import Curve, Mark, Scale, draw_curves
from cellquant.compare.groups import Group
from cellquant.compare.inference import Posterior, fit_parameters, sensitivity
from cellquant.compare.page import MINUS, Figure, Panel, Row, Section, Table, format_value
from cellquant.compare.ranking import MATCH, REDUCED_UNITS, Ranking, Units, rank_candidates
from cellquant.errors import InputError

if TYPE_CHECKING:
    from cellquant.compare.comparison import Comparison

SYMBOLS = {"phi": "φ", "v0": "v₀", "eta": "η"}
FEATURES = {
    "shape_index.mean": "⟨p⟩",
    "shape_index.std": "width of P(p)",
    "shape_index.skewness": "skewness of P(p)",
    "van_hove.sigma2": "σ^{2}/d^{2}",
    "van_hove.xi": "ξ/d",
    "msd.exponent": "exponent of the MSD",
    "alpha2_peak.value": "peak of α_{2}",
    "tau_alpha.value": "ln τ_{α}",
    "speed.mean": "ln speed",
    "msd.diffusion_coefficient": "ln D",
    "P(p)": "P(p), whole",
    "G_s": "displacements, whole",
}
MAX_ROWS = 12


@dataclass(frozen=True)
class Fit:
    """What matches one layer.

    Attributes
    ----------
    target
        Its name.
    ranking
        Scenes from the closest to the farthest.
    posterior
        Parameters with credible regions; None where there is no estimate.
    reason
        Why there is none.
    with_units
        Whether times and lengths were used.
    """

    target: str
    ranking: Ranking
    posterior: Posterior | None
    reason: str
    with_units: bool

    def as_dict(self) -> dict[str, Any]:
        """JSON-serialisable."""
        found: dict[str, Any] = {
            "target": self.target,
            "statement": self.ranking.statement(),
            "features": list(self.ranking.features),
            "left_out": list(self.ranking.left_out),
            "ranking": [
                {
                    "name": rank.name,
                    "scene": dict(rank.scene),
                    "distance": rank.distance,
                    "best_probability": rank.best_probability,
                    "rank_interval_90": list(rank.interval),
                    "parts": dict(rank.parts),
                }
                for rank in self.ranking.ranks
            ],
            "parameters": None,
            "reason": self.reason,
        }
        if self.posterior is not None:
            posterior = self.posterior
            found["parameters"] = {
                name: {
                    "median": posterior.interval(name)[1],
                    "interval_68": list(posterior.interval(name)[::2]),
                    "interval_95": list(posterior.interval(name, 0.95)[::2]),
                    "at_edge": posterior.at_edge(name),
                    "prior": list(posterior.bounds[name]),
                }
                for name in posterior.names
            }
            found["sensitivity"] = sensitivity(posterior)
        return found


def fit_groups(
    comparison: "Comparison", *, units: Units | None = None, seed: int = 0
) -> Iterator[Fit]:
    """Fit every experiment of a comparison to its simulations.

    Where all groups are simulated the first is fitted to the others, with times and lengths.

    Raises
    ------
    InputError
        If there are fewer than two scenes to choose from, or nothing to compare them by.
    """
    targets: Sequence[Group] = comparison.experiments
    scenes: Sequence[Group] = comparison.simulations
    if not targets:
        targets, scenes, units = comparison.groups[:1], comparison.groups[1:], REDUCED_UNITS
    for target in targets:
        ranking = rank_candidates(target, scenes, units=units, seed=seed)
        posterior, reason = None, ""
        try:
            posterior = fit_parameters(target, scenes, units=units, seed=seed)
        except InputError as error:
            reason = str(error)
        yield Fit(target.name, ranking, posterior, reason, units is not None)


def fit_sections(fits: Sequence[Fit]) -> list[Section]:
    """One section of the page per fit."""
    return [_section(index, fit) for index, fit in enumerate(fits, start=1)]


def _section(index: int, fit: Fit) -> Section:
    ranking = fit.ranking
    used = ", ".join(FEATURES.get(name, name) for name in ranking.features)
    text = [
        ranking.statement(),
        f"Compared by: {used}. Distances are in combined standard errors, averaged over these "
        "numbers as the root of the mean square; a distance of about one is what chance alone "
        "gives. Chances and ranges come from drawing every number again from its error.",
    ]
    if ranking.left_out:
        left = ", ".join(FEATURES.get(name, name) for name in ranking.left_out)
        text.append(f"Left out, because it is not known or not comparable everywhere: {left}.")
    if not fit.with_units:
        text.append(
            "The units of the model were not given in micrometres and minutes, so only pure "
            "numbers were used; they constrain the overall pace of the layer weakly."
        )
    tables = [_ranking_table(index, ranking)]
    figures: tuple[Figure, ...] = ()
    if fit.posterior is None:
        text.append(f"Parameters were not estimated: {fit.reason}")
    else:
        text.append(
            "The estimate interpolates between the scenes of the sweep and says nothing beyond "
            "its range."
        )
        tables += [_parameter_table(index, fit.posterior), _sensitivity_table(index, fit.posterior)]
        figures = (_figure(index, fit.posterior),)
    return Section(
        f"fit-{index}",
        f"Parameters that match {fit.target}",
        text=tuple(text),
        tables=tuple(tables),
        figures=figures,
    )


def _ranking_table(index: int, ranking: Ranking) -> Table:
    import pandas as pd

    shown = ranking.ranks[:MAX_ROWS]
    close = len(ranking.not_distinguishable)
    others = {id(rank) for rank in ranking.not_distinguishable[1:]}
    words = ["closest" if close == 1 else "closest, but not alone", *[""] * (len(shown) - 1)]
    words = [
        "not distinguishable" if id(r) in others else w for r, w in zip(shown, words, strict=True)
    ]
    rows = tuple(
        Row(
            (
                rank.name,
                f"{rank.distance:.2f}",
                f"{rank.best_probability:.0%}",
                f"{rank.interval[0]} to {rank.interval[1]}",
                word if not word or rank.distance <= MATCH else f"{word}; does not match",
            ),
            "good" if word and rank.distance <= MATCH else "none",
        )
        for rank, word in zip(shown, words, strict=True)
    )
    more = len(ranking.ranks) - len(shown)
    data = pd.DataFrame(
        [
            {
                "name": rank.name,
                **rank.scene,
                "distance": rank.distance,
                "best_probability": rank.best_probability,
                "rank_low": rank.interval[0],
                "rank_high": rank.interval[1],
                **{f"distance_{name}": part for name, part in rank.parts.items()},
            }
            for rank in ranking.ranks
        ]
    )
    return Table(
        f"ranking-{index}",
        "Scenes from the closest on." + (f" {more} farther ones are in the CSV." if more else ""),
        ("Scene", "Distance", "Chance of being the closest", "Rank, 90 % range", "Verdict"),
        ("", "number", "number", "number", "verdict"),
        rows,
        data,
    )


def _parameter_table(index: int, posterior: Posterior) -> Table:
    rows = []
    for name in posterior.names:
        low, middle, high = posterior.interval(name)
        bottom, _, top = posterior.interval(name, 0.95)
        lower, upper = posterior.bounds[name]
        note = ""
        if posterior.at_edge(name):
            note = "leans on an end of the sweep: widen it"
        rows.append(
            Row(
                (
                    SYMBOLS[name],
                    format_value(middle, (high - low) / 2),
                    f"{low:.3g} to {high:.3g}",
                    f"{bottom:.3g} to {top:.3g}",
                    f"{lower:g} to {upper:g}",
                    note,
                )
            )
        )
    return Table(
        f"parameters-{index}",
        "Estimated parameters: median ± half the 68 % interval.",
        ("Parameter", "Estimate", "68 %", "95 %", "Range of the sweep", "Note"),
        ("", "number", "number", "number", "number", "note"),
        tuple(rows),
    )


def _sensitivity_table(index: int, posterior: Posterior) -> Table:
    effects = sensitivity(posterior)
    rows = tuple(
        Row(
            (
                FEATURES[feature],
                *(f"{effects[feature][n]:+.1f}".replace("-", MINUS) for n in posterior.names),
            )
        )
        for feature in posterior.features
    )
    return Table(
        f"sensitivity-{index}",
        "What constrains which parameter: change of each number over the range of the sweep, in "
        "standard errors of the target.",
        ("Number", *(SYMBOLS[name] for name in posterior.names)),
        ("", *("number" for _ in posterior.names)),
        rows,
    )


def _figure(index: int, posterior: Posterior) -> Figure:
    import pandas as pd

    panels, parts = [], []
    for name in posterior.names:
        edges = np.linspace(*posterior.bounds[name], 41)
        column = posterior.samples[:, posterior.names.index(name)]
        density = np.histogram(column, edges, density=True)[0]
        centres = 0.5 * (edges[1:] + edges[:-1])
        low, middle, high = posterior.interval(name)
        slug = f"posterior-{index}-{name}"
        svg = draw_curves(
            [Curve("", centres, density, kind="bars")],
            slug,
            x=Scale(SYMBOLS[name], limits=posterior.bounds[name]),
            y=Scale("probability density", limits=(0.0, 1.15 * float(density.max()))),
            marks=(Mark(middle, f"{middle:.3g}", error=(high - low) / 2),),
        )
        words = f"Posterior of {name}: {middle:.3g}, from {low:.3g} to {high:.3g} (68 %)."
        panels.append(Panel(slug, svg, words, SYMBOLS[name]))
        parts.append(
            pd.DataFrame({"parameter": name, "value": centres, "probability_density": density})
        )
    return Figure(
        f"posterior-{index}",
        "Estimated parameters",
        "Posterior of each parameter over the range of the sweep; the line is the median, the "
        "band half of the 68 % interval to each side.",
        tuple(panels),
        pd.concat(parts, ignore_index=True),
        wide=True,
    )
