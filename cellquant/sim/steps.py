"""From frame to frame: steps of one length, or steps that follow the error.

A step that fails is repeated in parts on the same Brownian path, within bounds.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cellquant.sim.contacts import Layer
from cellquant.sim.integrators import Rosenbrock, find_method
from cellquant.sim.noise import BrownianTree
from cellquant.sim.scene import SimulationFailure

Floats = NDArray[np.float64]

ROOT_DEPTH = 2  # a root of the Brownian tree spans 2^2 steps
WATCH_EVERY = 16  # steps between two checks of the step length
CHATTER_LIMIT = 0.02  # RMS change of the displacement from one step to the next, L0
LONGEST_MOVE = 0.1  # of a cell within one implicit step, in units of the mean radius
LARGEST_CHANGE = 0.03  # of a shape mode within one implicit step
JUMP, FLIP = 0.5, 0.3  # the same for explicit steps, which only an instability takes
REPAIRS = 6  # halvings of an equal step that failed
DEEPEST = 14  # halvings of a frame interval that the adaptive method may make
REMEDY = "take a smaller dt or the adaptive integrator"
EASY = 0.15  # share of the tolerance below which it doubles the step


@dataclass(frozen=True)
class Plan:
    """Steps of a run: n_before frames' worth of transient, then n_frames - 1 saved intervals."""

    h: float
    steps_per_frame: int
    n_before: int
    n_frames: int

    @classmethod
    def of(cls, duration: float, transient: float, save_every: float, dt: float) -> "Plan":
        """Divide the frame interval into equal steps no longer than dt."""
        steps = max(1, math.ceil(save_every / dt * (1.0 - 1e-12)))
        return cls(
            h=save_every / steps,
            steps_per_frame=steps,
            n_before=math.ceil(transient / save_every * (1.0 - 1e-12)),
            n_frames=1 + math.ceil(duration / save_every * (1.0 - 1e-12)),
        )


class FixedSteps:
    """Equal steps of one method, watched for steps that are too long.

    An implicit step in which a cell moves too far or a shape changes too much is repeated in
    2, 4, ... parts. Explicit steps that are too long stop the run: in parts they would
    only chatter less visibly.

    Attributes
    ----------
    count, rejected
        Steps taken and given up.
    repaired
        Steps that were taken in parts.
    elapsed
        Time since the start of the frame interval, t0.
    """

    def __init__(self, layer: Layer, integrator: str, plan: Plan) -> None:
        self.layer = layer
        self.plan = plan
        self.count = 0
        self.rejected = 0
        self.repaired = 0
        self.elapsed = 0.0
        self._method = find_method(integrator)[1].make(layer)
        self._explicit = integrator in ("euler", "sra1")
        self._tree = BrownianTree(layer.scene.seed, len(layer.radius), plan.h * 2**ROOT_DEPTH)
        self._still = np.zeros(len(layer.radius))
        self._moved = np.zeros((len(layer.radius), 2))
        self._chatter = 0.0

    def save(self) -> Floats:
        """What a checkpoint has to keep."""
        return np.array([self.count, self.rejected, self.repaired, self._chatter])

    def restore(self, stored: Floats) -> None:
        """Go on from what `save` returned."""
        self.count, self.rejected, self.repaired = (int(x) for x in stored[:3])
        self._chatter = float(stored[3])

    def advance(self, state: Floats, interval: int) -> None:
        """Advance a state over one frame interval, in place."""
        steps = self.plan.steps_per_frame
        before = np.empty_like(state)
        self._method.restart()
        for index in range(interval * steps, (interval + 1) * steps):
            before[:] = state
            try:
                self._take(state, index, 0)
            except SimulationFailure as failure:
                if self._explicit:
                    raise
                self._repair(state, before, index, failure)
            self.count += 1
            self.elapsed = (index + 1 - interval * steps) * self.plan.h
            if not self._explicit:
                continue
            if index % WATCH_EVERY == 0:
                self._moved = state[:, :2] - before[:, :2]
            elif index % WATCH_EVERY == 1 and index > interval * steps:
                self._watch(state[:, :2] - before[:, :2] - self._moved)
        self.elapsed = 0.0

    def _take(self, state: Floats, index: int, halvings: int) -> None:
        """Take one step in 2^halvings parts."""
        h, parts = self.plan.h / 2**halvings, 2**halvings
        root, place = divmod(index, 2**ROOT_DEPTH)
        limit = (JUMP if self._explicit else LONGEST_MOVE) * self.layer.scene.mean_radius
        for part in range(place * parts, (place + 1) * parts):
            w = area = self._still
            if self.layer.scene.has_noise:
                ws, areas = self._tree.level(root, ROOT_DEPTH + halvings)
                w, area = ws[part], areas[part]
            start = state.copy()
            self._method.step(state, h, w, area)
            start -= state
            moved = np.abs(start, out=start)
            if not moved[:, :2].max() < limit:
                cell = int(np.argmax(moved[:, :2].max(axis=1)))
                raise SimulationFailure("a cell moves too far within one step", REMEDY, cell=cell)
            change = FLIP if self._explicit else LARGEST_CHANGE
            if not moved[:, 3:].max(initial=0.0) < change:
                cell = int(np.argmax(moved[:, 3:].max(axis=1)))
                raise SimulationFailure("a shape changes too much in one step", REMEDY, cell=cell)

    def _repair(
        self, state: Floats, before: Floats, index: int, failure: SimulationFailure
    ) -> None:
        """Take a step that failed in ever shorter parts."""
        for halvings in range(1, REPAIRS + 1):
            self.rejected += 1
            state[:] = before
            try:
                self._take(state, index, halvings)
            except SimulationFailure as again:
                failure = again
            else:
                self.repaired += 1
                return
        state[:] = before
        h = self.plan.h / 2**REPAIRS
        raise SimulationFailure(
            f"{failure.reason} even at a step of {h:.2g} t0", failure.remedy, cell=failure.cell
        ) from failure

    def _watch(self, difference: Floats) -> None:
        """Stop where explicit steps make the displacement change too much from step to step."""
        change = float(np.sqrt(np.mean(difference**2)))
        self._chatter += 0.2 * (change / (2.0 * self.layer.scene.mean_radius) - self._chatter)
        if self._chatter > CHATTER_LIMIT:
            reason = "the step is too long for the contacts, which chatter"
            raise SimulationFailure(reason, REMEDY)


class AdaptiveSteps:
    """Steps of the implicit method, halved and doubled so that each stays within a tolerance.

    Steps are dyadic parts of the frame interval, so that a rejected step is repeated in halves on
    the same Brownian path, and two easy ones are followed by one of twice the length.

    Attributes
    ----------
    count, rejected
        Steps taken and given up.
    elapsed
        Time since the start of the frame interval, t0.
    """

    def __init__(
        self, layer: Layer, plan: Plan, tolerance: float, tree: BrownianTree | None = None
    ) -> None:
        self.layer = layer
        self.count = 0
        self.rejected = 0
        self.repaired = 0
        self.elapsed = 0.0
        self._tolerance = tolerance
        self._span = plan.h * plan.steps_per_frame
        self._method = Rosenbrock(layer)
        self._tree = tree or BrownianTree(layer.scene.seed, len(layer.radius), self._span)
        self._still = np.zeros(len(layer.radius))
        first = find_method("implicit")[1].dt
        self._depth = max(0, math.ceil(math.log2(self._span / first)))

    def save(self) -> Floats:
        """What a checkpoint has to keep."""
        return np.array([self.count, self.rejected, self._depth], np.float64)

    def restore(self, stored: Floats) -> None:
        """Go on from what `save` returned."""
        self.count, self.rejected, self._depth = (int(x) for x in stored)

    def advance(self, state: Floats, interval: int) -> None:
        """Advance a state over one frame interval, in place."""
        before = np.empty_like(state)
        index = 0
        while index < 2**self._depth:
            h = self._span / 2**self._depth
            w = area = self._still
            if self.layer.scene.has_noise:
                ws, areas = self._tree.level(interval, self._depth)
                w, area = ws[index], areas[index]
            before[:] = state
            failure: SimulationFailure | None = None
            try:
                self._method.step(state, h, w, area)
            except SimulationFailure as caught:
                failure = caught
            error = self._method.error
            if failure is None and error <= self._tolerance:
                self.count += 1
                index += 1
                self.elapsed = index * h
                if error < EASY * self._tolerance and self._depth > 0 and index % 2 == 0:
                    self._depth -= 1
                    index //= 2
                continue
            state[:] = before
            self.rejected += 1
            if self._depth == self._deepest():
                reason = "the error exceeds the tolerance" if failure is None else failure.reason
                raise SimulationFailure(
                    f"{reason} even at a step of {h:.2g} t0",
                    "raise the tolerance" if failure is None else failure.remedy,
                    cell=None if failure is None else failure.cell,
                )
            self._depth += 1
            index *= 2
        self.elapsed = 0.0

    def _deepest(self) -> int:
        """Deepest level: DEEPEST halvings of an interval of one t0."""
        return max(4, DEEPEST + math.ceil(math.log2(self._span)))
