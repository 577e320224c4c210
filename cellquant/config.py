"""The TOML files of a user: experiment, scene and sweep, validated key by key.

Relative paths start at the file that names them. Unknown keys are refused, so that a misspelt key
never falls back to a default in silence.
"""

import math
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from cellquant.errors import InputError

MAX_RUNS = 1_000_000
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Name = Annotated[
    str, Field(min_length=1, max_length=80, pattern=r"^[^./\\\x00-\x1f][^/\\\x00-\x1f]*$")
]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class CalibrationConfig(_Strict):
    """What a pixel and a frame are; overrides what the image files say."""

    pixel_size: Positive | None = None
    frame_interval: Positive | None = None
    units: Literal["physical", "pixel"] = "physical"


class TrackingConfig(_Strict):
    """Options of the linker; the defaults are chosen from the data."""

    max_distance: Positive | None = None
    divisions: bool = True
    linker: Literal["cues", "trackpy"] = "cues"


class ObservablesConfig(_Strict):
    """What is measured, and the analysis windows of the protocol."""

    only: list[str] | None = None
    smoothing: Annotated[int, Field(ge=1)] = 5
    min_points: Annotated[int, Field(ge=2)] = 24
    window: Annotated[int, Field(ge=2)] = 24
    bin_width: Positive = 250.0
    bin_centres: list[Positive] = [1100.0, 1350.0, 1600.0, 1850.0, 2100.0, 2350.0, 2600.0]
    drift: bool = True
    keep_cut_cells: bool = False
    wave_number: Positive | Literal["2pi/d", "structure_factor_peak"] = "2pi/d"
    scattering: Literal["bessel", "vectors"] = "bessel"
    lags: list[Annotated[int, Field(ge=1)]] | None = None
    stride: Annotated[int, Field(ge=1)] = 1
    overlap_cutoff: Positive | None = None
    van_hove_lag: Positive | None = None
    core_range: tuple[NotNegative, Positive] | None = None
    tail_range: tuple[NotNegative, Positive] | None = None
    max_frames: Annotated[int, Field(ge=1)] = 32


class RunObservablesConfig(_Strict):
    """What is measured on each run of a sweep; what is left out is chosen as `observe` does."""

    only: list[str] | None = None
    smoothing: Annotated[int, Field(ge=1)] | None = None
    min_points: Annotated[int, Field(ge=2)] | None = None
    window: Annotated[int, Field(ge=2)] | None = None
    drift: bool | None = None
    wave_number: Positive | Literal["2pi/d", "structure_factor_peak"] | None = None
    scattering: Literal["bessel", "vectors"] | None = None
    lags: list[Annotated[int, Field(ge=1)]] | None = None
    stride: Annotated[int, Field(ge=1)] | None = None
    overlap_cutoff: Positive | None = None
    van_hove_lag: Positive | None = None
    core_range: tuple[NotNegative, Positive] | None = None
    tail_range: tuple[NotNegative, Positive] | None = None
    max_frames: Annotated[int, Field(ge=1)] | None = None


class TrialConfig(_Strict):
    """One independent experiment: its mask stacks, and optionally the raw movies."""

    name: Name
    stacks: Annotated[list[str], Field(min_length=1)]
    raw: list[str] | None = None


class ConditionConfig(_Strict):
    """One condition, e.g. untreated, with its independent trials."""

    name: Name
    trial: Annotated[list[TrialConfig], Field(min_length=1)]


class ExperimentConfig(_Strict):
    """The whole of an experiment file."""

    calibration: CalibrationConfig = CalibrationConfig()
    tracking: TrackingConfig = TrackingConfig()
    observables: ObservablesConfig = ObservablesConfig()
    condition: Annotated[list[ConditionConfig], Field(min_length=1)]

    @model_validator(mode="after")
    def _names_are_unique(self) -> "ExperimentConfig":
        _unique("condition", [c.name for c in self.condition])
        for condition in self.condition:
            _unique(f"trial of condition {condition.name!r}", [t.name for t in condition.trial])
        return self


class SceneConfig(_Strict):
    """One simulation in reduced units (length 2 Rbar, time 1/(mu_r k))."""

    phi: Positive = 0.97
    v0: NotNegative = 0.03
    eta: NotNegative = 0.01
    cells: Annotated[int, Field(ge=1)] = 1024
    polydispersity: Annotated[float, Field(ge=0, le=0.3)] = 0.1
    rotational_diffusion: NotNegative = 0.01
    mu_theta: NotNegative = 1.0
    mu_ab: NotNegative = 0.1
    modes: Annotated[int, Field(ge=1, le=24)] = 6
    box: tuple[Positive, Positive] | None = None
    aspect: Positive | None = None
    radii: list[Positive] | None = None
    initial: Literal["hexagonal", "random"] = "hexagonal"
    positions: list[tuple[Finite, Finite]] | None = None
    polarities: list[Finite] | None = None
    shapes: list[list[Finite]] | None = None
    seed: Annotated[int, Field(ge=0)] = 1
    transient: NotNegative = 500.0
    duration: Positive = 1000.0
    save_every: Positive | None = None
    contact: Literal["exact", "quadrature"] = "exact"
    points: Annotated[int, Field(ge=8)] = 40
    integrator: str | None = None
    dt: Positive | None = None
    tolerance: Positive | None = None

    @model_validator(mode="before")
    @classmethod
    def _lists_count_the_cells(cls, content: Any) -> Any:
        if isinstance(content, dict) and "cells" not in content:
            for name in ("radii", "positions", "polarities", "shapes"):
                if isinstance(content.get(name), list):
                    return {**content, "cells": len(content[name])}
        return content

    @model_validator(mode="after")
    def _one_rule_each(self) -> "SceneConfig":
        for kept, other in (
            ("box", "phi"), ("box", "aspect"), ("radii", "polydispersity"), ("positions", "initial")
        ):  # fmt: skip
            if getattr(self, kept) is not None and other in self.model_fields_set:
                raise ValueError(f"{kept} and {other} are both given; keep one")
        return self


class SweepConfig(_Strict):
    """A grid of scenes times seeds; `scene` holds what all of them share."""

    seeds: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)] = [1]
    scene: dict[str, Any] = {}
    grid: dict[str, Annotated[list[Any], Field(min_length=1)]] = {}
    points: list[dict[str, Any]] = []
    observables: RunObservablesConfig = RunObservablesConfig()

    @model_validator(mode="after")
    def _scenes_are_valid(self) -> "SweepConfig":
        _unique("seed", self.seeds)
        both = sorted(set(self.scene) & set(self.grid))
        if both:
            raise ValueError(f"{', '.join(both)} stands in both [scene] and [grid]; keep one")
        if "seed" in self.scene or "seed" in self.grid:
            raise ValueError("seeds are given by the key 'seeds', not inside [scene] or [grid]")
        number = len(self.seeds) * (
            math.prod(len(values) for values in self.grid.values()) + len(self.points)
        )
        if number > MAX_RUNS:
            raise ValueError(f"the sweep has {number} runs; divide it, {MAX_RUNS} are the most")
        self.scenes()
        return self

    def scenes(self) -> list[SceneConfig]:
        """Every scene of the grid and the list, for every seed, in the order of the file."""
        combinations: list[dict[str, Any]] = [{}]
        for key, values in self.grid.items():
            combinations = [{**c, key: value} for c in combinations for value in values]
        if self.points and not self.grid:
            combinations = []
        chosen = [*combinations, *self.points]
        return [
            SceneConfig.model_validate({**self.scene, **point, "seed": seed})
            for point in chosen
            for seed in self.seeds
        ]


def _unique(what: str, names: list[Any]) -> None:
    twice = sorted({str(name) for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"the {what} {', '.join(twice)} is given more than once; rename one")


Config = TypeVar("Config", bound=BaseModel)


def load(path: str | Path, model: type[Config]) -> Config:
    """Read and validate a TOML file.

    Parameters
    ----------
    path
        The file.
    model
        `ExperimentConfig`, `SceneConfig` or `SweepConfig`.

    Raises
    ------
    InputError
        If the file is missing, is not TOML, or a key is unknown, absent or out of range; the
        message names file and key.
    """
    return validate(read_toml(path), model, where=str(path))


def read_toml(path: str | Path) -> dict[str, Any]:
    """Read a TOML file; `InputError` when it is missing, too large or not TOML."""
    path = Path(path)
    if not path.is_file():
        raise InputError(
            f"{path} does not exist; 'cellquant config init' prints a template to start from."
        )
    if path.stat().st_size > 10_000_000:
        raise InputError(f"{path} is larger than 10 MB, too large for a configuration file.")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{path} is not valid TOML: {error}; mend that line.") from error


def validate(content: dict[str, Any], model: type[Config], *, where: str) -> Config:
    """Validate already parsed content; `where` names its source in errors."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        problems = "; ".join(_problem(dict(item)) for item in error.errors()[:5])
        raise InputError(f"{where}: {problems}.") from error


def _problem(item: dict[str, Any]) -> str:
    key = ".".join(str(part) for part in item["loc"]) or "file"
    if item["type"] == "extra_forbidden":
        return f"unknown key '{key}' (remove it or correct its spelling)"
    if item["type"] == "missing":
        return f"the key '{key}' is missing"
    message = str(item["msg"]).removeprefix("Value error, ")
    if item["type"] == "value_error":
        return message
    given = repr(item.get("input"))
    return f"'{key}': {message}, got {given if len(given) < 60 else given[:57] + '...'}"


TEMPLATES = {
    "experiment": """\
# An experiment: conditions, each with independent trials, each with stacks of label masks.
# Relative paths start at this file; patterns such as "t1/*.tif" are allowed.

[calibration]             # overrides what the image files say
pixel_size = 0.65         # um
frame_interval = 10       # min

[tracking]
# max_distance = 20       # um; without it the search range is chosen from the data
divisions = true          # look for divisions
linker = "cues"           # "trackpy" is the plain nearest-neighbour baseline

[observables]
smoothing = 5             # points of the moving average; 1 for none
min_points = 24           # consecutive points that a trajectory must have
window = 24               # points of an analysis window
bin_width = 250           # cells/mm^2
bin_centres = [1100, 1350, 1600, 1850, 2100, 2350, 2600]
drift = true              # remove the motion of the centre of mass
keep_cut_cells = false    # the border of the image cuts cells: leave their positions out
wave_number = "2pi/d"     # or "structure_factor_peak", or a number in 1/um
scattering = "bessel"     # exact isotropic average; "vectors" for eight directions of q
# stride = 1              # frames between time origins
# lags = [1, 2, 5, 10]    # frames; about 35 spaced in the logarithm by default
# overlap_cutoff = 6      # um; 0.3 mean diameters by default
# van_hove_lag = 40       # min; tau_alpha by default
# core_range = [0, 0.4]   # mean diameters, of the Gaussian fit; chosen from the data by default
# tail_range = [0.8, 2]   # mean diameters, of the exponential fit
# max_frames = 32         # frames on which structure is measured

[[condition]]
name = "untreated"
[[condition.trial]]
name = "2026-03-01"
stacks = ["t1/*.tif"]
# raw = ["t1_raw/*.tif"]  # the recorded movies, one per stack: adds image correlation

# [[condition]]
# name = "low nutrient"
# [[condition.trial]]
# name = "2026-03-08"
# stacks = ["t2/*.tif"]
""",
    "scene": """\
# A simulated layer. Unit of length 2 Rbar (mean cell diameter), of time t0 = 1/(mu_r k).

phi = 0.97                # packing fraction: sum of cell areas over box area
v0 = 0.03                 # self-propulsion speed
eta = 0.01                # line tension of the contour
cells = 1024
polydispersity = 0.1      # standard deviation of the radii over their mean, 0 to 0.3
rotational_diffusion = 0.01
mu_theta = 1.0            # rotational mobility
mu_ab = 0.1               # mobility of the shape modes
modes = 6                 # highest Fourier mode of a contour; 1 for rigid discs
# box = [30.0, 28.0]      # edges in L0 instead of phi; or aspect = Lx/Ly beside phi
# radii = [0.5, 0.55]     # one per cell in L0, instead of polydispersity
# initial = "random"      # then relaxed; without it a hexagonal lattice
# positions = [[1.0, 1.0], [2.1, 1.0]]   # centres in L0, and polarities = [...] in radians
# shapes = [[0.1, ...], ...]   # per cell a_2 .. a_M, b_2 .. b_M; circles where left out
transient = 500           # t0, not saved
duration = 1000           # t0, saved after the transient
seed = 1

contact = "exact"         # or "quadrature": the published sum over contour points
points = 40               # contour points of the quadrature rule
# integrator = "euler"    # without it the scheme recommended for the scene
# dt = 0.005              # step, or tolerance = 1e-3 for the adaptive scheme
# save_every = 1.0        # t0 between saved states
""",
    "sweep": """\
# A grid of scenes, each run with every seed.

seeds = [1, 2, 3]

[scene]                   # what all scenes share: any key of a scene file but the seed
cells = 256
transient = 200
duration = 500

[grid]                    # every combination of these
phi = [0.95, 0.97]
v0 = [0.01, 0.03, 0.07]
eta = [0.01, 0.03]

# [[points]]              # and any single scenes besides; without [grid] a list of scenes
# phi = 1.0
# v0 = 0.05

# [observables]           # as in an experiment file; by default as 'observe' does for runs
# only = ["shape_index", "self_intermediate_scattering"]
""",
}
