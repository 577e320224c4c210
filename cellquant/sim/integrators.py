"""Time steps of the layer: additive noise on the polarities, stiff contacts.

Every method advances a state in place over one step, given the increment W and the area H of the
Brownian path of every cell over the step (see `noise`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cellquant.errors import InputError
from cellquant.sim.contacts import Layer

Floats = NDArray[np.float64]


class Integrator(Protocol):
    """One method, bound to a layer."""

    def step(self, state: Floats, h: float, w: Floats, area: Floats) -> None:
        """Advance `state` by h, with increments w (N,) and areas (N,) of the Brownian paths."""


class Euler:
    """Euler-Maruyama, the published scheme: strong order 1, for h below 2 / stiffness."""

    def __init__(self, layer: Layer) -> None:
        self._layer = layer
        self._noise = math.sqrt(2.0 * layer.scene.D_r)
        self._slope = np.empty((len(layer.radius), layer.n_columns))

    def step(self, state: Floats, h: float, w: Floats, area: Floats) -> None:
        """Advance by one evaluation."""
        self._layer.velocity(state, self._slope)
        self._slope *= h
        state += self._slope
        state[:, 2] += self._noise * w


class Sra1:
    """SRA1: strong order 1.5 for additive noise where the drift is smooth; two evaluations.

    References
    ----------
    Roessler, SIAM J. Numer. Anal. 48 (2010) 922, table 6.2. doi:10.1137/09076636X
    """

    def __init__(self, layer: Layer) -> None:
        self._layer = layer
        self._noise = math.sqrt(2.0 * layer.scene.D_r)
        shape = (len(layer.radius), layer.n_columns)
        self._first, self._second, self._stage = np.empty(shape), np.empty(shape), np.empty(shape)

    def step(self, state: Floats, h: float, w: Floats, area: Floats) -> None:
        """Advance by two evaluations; the second one sees the time-averaged path."""
        self._layer.velocity(state, self._first)
        np.multiply(self._first, 0.75 * h, out=self._stage)
        self._stage += state
        self._stage[:, 2] += 1.5 * self._noise * (0.5 * w + area)
        self._layer.velocity(self._stage, self._second)
        self._second *= 2.0
        self._second += self._first
        self._second *= h / 3.0
        state += self._second
        state[:, 2] += self._noise * w


@dataclass(frozen=True)
class Method:
    """An integrator as a user chooses it: how to make it, and its usual step in t0."""

    make: Callable[[Layer], Integrator]
    dt: float
    adaptive: bool = False


METHODS: dict[str, Method] = {
    "euler": Method(Euler, 0.005),
    "sra1": Method(Sra1, 0.01),
}
DEFAULT = "euler"


def find_method(name: str | None) -> tuple[str, Method]:
    """Look a method up by name; None is the recommended one."""
    name = DEFAULT if name is None else name
    if name not in METHODS:
        raise InputError(
            f"integrator must be one of {', '.join(sorted(METHODS))}, got {name!r}; choose one."
        )
    return name, METHODS[name]
