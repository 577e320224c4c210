"""The scene: every parameter of a simulated layer, checked, and which terms it needs at all."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Self

from cellquant.errors import InputError

if TYPE_CHECKING:
    from cellquant.config import SceneConfig

MAX_MODES = 24
MOST_OF_A_MODE = 100.0  # a_n or b_n; lobes of the area pi R0^2 are some ten R0 long at most
INITIAL_STATES = ("hexagonal", "random")


class SimulationFailure(InputError):
    """A simulation cannot go on; what was computed so far is kept.

    Attributes
    ----------
    reason, remedy
        What happened, and what to change.
    cell
        Index of the first cell concerned, or None.
    time, step
        Simulated time in t0 and number of steps taken since the start.
    run
        The partial `Run`, or None where nothing was saved.
    """

    def __init__(
        self,
        reason: str,
        remedy: str,
        *,
        cell: int | None = None,
        time: float | None = None,
        step: int | None = None,
        run: Any = None,
    ) -> None:
        where = "" if cell is None else f" in cell {cell}"
        when = "" if time is None else f" at time {time:.6g} t0 (step {step})"
        super().__init__(f"{reason}{where}{when}; {remedy}.")
        self.reason = reason
        self.remedy = remedy
        self.cell = cell
        self.time = time
        self.step = step
        self.run = run


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Parameters of a layer of deformable active cells, in reduced units.

    The unit of length is L0 = 2 Rbar, of energy k L0^2, of time t0 = 1 / (mu_r k); with
    ``mean_radius = 0.5`` and ``k = mu_r = 1`` all numbers below are in these units.

    Parameters
    ----------
    phi
        Packing fraction sum(pi R0_i^2) / (Lx Ly); 0 < phi <= 2. Ignored where `box` is given.
    v0
        Self-propulsion speed, L0/t0, >= 0.
    eta
        Line tension of the contour, k L0, >= 0.
    n_cells
        Number of cells, >= 1.
    polydispersity
        Standard deviation of the radii over their mean, 0 to 0.3. Radii below a tenth of the mean
        are drawn again. Ignored where `radii` are given.
    D_r
        Rotational diffusion of the polarity, 1/t0, >= 0.
    mu_r, mu_theta, mu_ab
        Mobilities of the centre (> 0), of the polarity and of the shape modes (>= 0).
    k
        Energy per overlap area, >= 0.
    modes
        Highest Fourier mode M of a contour, 1 (rigid disc) to 24.
    mean_radius
        Rbar, > 0.
    aspect
        Lx / Ly of the box; None for the ratio that fits the hexagonal lattice.
    box
        (Lx, Ly) in L0; then phi follows from it.
    radii
        (n_cells,) radii R0_i in L0 instead of drawn ones.
    initial
        ``"hexagonal"``, or ``"random"`` (uniform, then relaxed as passive cells).
    positions, polarities
        (n_cells, 2) and (n_cells,) initial centres and polarities instead of `initial`.
    shapes
        (n_cells, 2(M-1)) initial a_2 .. a_M, b_2 .. b_M instead of circles. With the columns of
        `Run.state` as positions, polarities and shapes, and its radii and box, a run goes on
        under other parameters.
    seed
        Seed of radii, initial polarities and noise.

    Raises
    ------
    InputError
        If a value is out of range or the scene is physically impossible; the message names the
        field.
    """

    phi: float = 0.97
    v0: float = 0.03
    eta: float = 0.01
    n_cells: int = 1024
    polydispersity: float = 0.1
    D_r: float = 0.01
    mu_r: float = 1.0
    mu_theta: float = 1.0
    mu_ab: float = 0.1
    k: float = 1.0
    modes: int = 6
    mean_radius: float = 0.5
    aspect: float | None = None
    box: tuple[float, float] | None = None
    radii: tuple[float, ...] | None = field(default=None, repr=False)
    initial: str = "hexagonal"
    positions: tuple[tuple[float, float], ...] | None = field(default=None, repr=False)
    polarities: tuple[float, ...] | None = field(default=None, repr=False)
    shapes: tuple[tuple[float, ...], ...] | None = field(default=None, repr=False)
    seed: int = 1

    def __post_init__(self) -> None:
        self._tuples()
        _integer("n_cells", self.n_cells, 1, 10_000_000)
        _integer("modes", self.modes, 1, MAX_MODES)
        _integer("seed", self.seed, 0, 2**63 - 1)
        _number("phi", self.phi, 0.0, 2.0, open_low=True)
        _number("polydispersity", self.polydispersity, 0.0, 0.3)
        for name in ("v0", "eta", "D_r", "mu_theta", "mu_ab", "k"):
            _number(name, getattr(self, name), 0.0, 1e6)
        for name in ("mu_r", "mean_radius"):
            _number(name, getattr(self, name), 0.0, 1e6, open_low=True)
        if self.aspect is not None:
            _number("aspect", self.aspect, 1e-3, 1e3)
        if self.initial not in INITIAL_STATES:
            raise InputError(
                f"initial must be one of {', '.join(INITIAL_STATES)}, got {self.initial!r}; "
                "or give positions."
            )
        if self.box is not None:
            if len(self.box) != 2:
                raise InputError(f"box must be (Lx, Ly), got {len(self.box)} numbers; give two.")
            for edge in self.box:
                _number("box", edge, 0.0, 1e9, open_low=True)
        if self.radii is not None:
            _length("radii", self.radii, self.n_cells)
            for radius in self.radii:
                _number("radii", radius, 0.0, 1e6, open_low=True)
        if self.positions is not None:
            _length("positions", self.positions, self.n_cells)
            for row in self.positions:
                if len(row) != 2 or not all(math.isfinite(x) for x in row):
                    raise InputError(
                        f"positions must be rows of two finite numbers, got {row}; correct it."
                    )
            if len(set(self.positions)) < self.n_cells:
                raise InputError(
                    "positions puts two cells on the same point, from where no direction of push "
                    "is defined; move one of them."
                )
        if self.polarities is not None:
            _length("polarities", self.polarities, self.n_cells)
            for angle in self.polarities:
                _number("polarities", angle, -math.inf, math.inf)
        if self.shapes is not None:
            _length("shapes", self.shapes, self.n_cells)
            columns = 2 * (self.modes - 1)
            for shape in self.shapes:
                if len(shape) != columns or not all(abs(x) <= MOST_OF_A_MODE for x in shape):
                    raise InputError(
                        f"shapes must be rows of {columns} finite numbers, a_2 .. a_M, b_2 .. b_M "
                        f"for modes = {self.modes}, got {shape}; correct it."
                    )
        fraction = self._known_fraction()
        if fraction is not None and fraction > 2.0:
            raise InputError(
                f"box {self.box} holds {fraction:.3g} times its area in cells, and the model means "
                "nothing above 2; enlarge the box or take fewer cells."
            )

    def _tuples(self) -> None:
        """Turn arrays given by the user into tuples, so that a scene is hashable and frozen."""
        for name in ("radii", "polarities", "box"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, tuple(float(x) for x in value))
        for name in ("positions", "shapes"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, tuple(tuple(float(x) for x in r) for r in value))

    def _known_fraction(self) -> float | None:
        if self.box is None:
            return None
        mean = self.mean_radius
        radii = self.radii if self.radii is not None else [mean] * self.n_cells
        return math.pi * sum(r * r for r in radii) / (self.box[0] * self.box[1])

    @property
    def rigid(self) -> bool:
        """Cells are discs: there are no shape modes."""
        return self.modes == 1

    @property
    def has_tension(self) -> bool:
        """The contour length enters the forces."""
        return not self.rigid and self.eta > 0.0 and self.mu_ab > 0.0

    @property
    def has_torque(self) -> bool:
        """Overlaps turn the polarity."""
        return not self.rigid and self.mu_theta > 0.0 and self.k > 0.0

    @property
    def has_noise(self) -> bool:
        """The polarity diffuses."""
        return self.D_r > 0.0

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed, checked again."""
        return replace(self, **changes)

    def to_dict(self) -> dict[str, Any]:
        """Every field as JSON-serialisable values."""
        return {
            item.name: list(value) if isinstance(value, tuple) else value
            for item in fields(self)
            for value in [getattr(self, item.name)]
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Self:
        """Inverse of `to_dict`."""
        return cls(**content)

    @classmethod
    def from_config(cls, config: "SceneConfig") -> Self:
        """The scene of a scene file."""
        return cls(
            phi=config.phi,
            v0=config.v0,
            eta=config.eta,
            n_cells=config.cells,
            polydispersity=config.polydispersity,
            D_r=config.rotational_diffusion,
            mu_theta=config.mu_theta,
            mu_ab=config.mu_ab,
            modes=config.modes,
            box=config.box,
            aspect=config.aspect,
            radii=None if config.radii is None else tuple(config.radii),
            initial=config.initial,
            positions=None if config.positions is None else tuple(config.positions),
            polarities=None if config.polarities is None else tuple(config.polarities),
            shapes=None if config.shapes is None else tuple(tuple(s) for s in config.shapes),
            seed=config.seed,
        )


def _number(name: str, value: Any, low: float, high: float, *, open_low: bool = False) -> None:
    below = not isinstance(value, (int, float)) or not low <= value <= high
    if below or (open_low and value == low) or not math.isfinite(value):
        sign = ">" if open_low else ">="
        limit = "" if high >= 1e6 else f" and <= {high:g}"
        raise InputError(
            f"{name} must be a number {sign} {low:g}{limit}, got {value!r}; correct it."
        )


def _integer(name: str, value: Any, low: int, high: int) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise InputError(
            f"{name} must be a whole number from {low} to {high}, got {value!r}; correct it."
        )


def _length(name: str, values: Sequence[Any], n_cells: int) -> None:
    if len(values) != n_cells:
        raise InputError(
            f"{name} must have one entry per cell ({n_cells}), got {len(values)}; "
            "change it or n_cells."
        )
