"""The layer at work: buffers, neighbour list and the choice of the compiled contact rule."""

import math
from typing import Any, Literal

import numba
import numpy as np
from numpy.typing import NDArray

from cellquant.errors import InputError
from cellquant.sim import (
    areas,
    crossings,
    discs,
    energies,
    evaluation,
    lanes,
    lenses,
    neighbours,
    outlines,
    overlaps,
    parts,
    pinches,
    quadrature,
    records,
)
from cellquant.sim.scene import Scene, SimulationFailure

Floats = NDArray[np.float64]
ContactRule = Literal["exact", "quadrature"]
NONE = np.empty(0, np.int64)
PINCHED = 0.02  # smallest sample of a contour over R0 below which its zeros are sought


class Layer:
    """Generalised velocities of one layer, with all its buffers.

    Parameters
    ----------
    scene
        The scene; its features choose what is compiled.
    radius
        (N,) radii R0_i, L0.
    box
        (2,) edges of the periodic box, L0.
    contact
        ``"exact"``, or ``"quadrature"``: the published sum over contour points.
    points
        Contour points of the quadrature rule, even and >= 8.
    general
        Compile every term of the model even where the scene lacks it; the same numbers, slower.

    Attributes
    ----------
    evaluations
        Number of velocity evaluations made.
    """

    def __init__(
        self,
        scene: Scene,
        radius: Floats,
        box: Floats,
        *,
        contact: ContactRule = "exact",
        points: int = 40,
        general: bool = False,
    ) -> None:
        if contact not in ("exact", "quadrature"):
            raise InputError(f"contact must be exact or quadrature, got {contact!r}; choose one.")
        if points < 8 or points % 2 or points > 100_000:
            raise InputError(
                f"points must be an even number from 8 to 100000, got {points}; correct it."
            )
        self.scene = scene
        self.radius = np.ascontiguousarray(radius, dtype=np.float64)
        self.box = np.ascontiguousarray(box, dtype=np.float64)
        self.contact = contact
        self.points = points
        self.evaluations = 0
        self.builds = 0
        n_cells = len(self.radius)
        n_modes = self._n_modes = scene.modes - 1
        self.n_columns = 3 + 2 * n_modes
        self.skin = 0.2 * scene.mean_radius
        has_tension = scene.has_tension or general
        self._features = n_modes, int(has_tension), int(scene.has_torque or general)
        self._numbers = np.array(
            [scene.v0, scene.k, scene.eta, scene.mu_r, scene.mu_theta, scene.mu_ab], np.float64
        )
        size = outlines.samples_of(scene.modes) if contact == "exact" else points
        self._table, single = outlines.compass(scene.modes, size)
        spare = lanes.QUAD - 1  # rows that the last tile of cells may write to
        self._record = lanes.zeros(n_cells + spare, records.record_length(n_modes))[:n_cells]
        self._energy = np.zeros(n_cells)
        self._growth = np.zeros(n_cells)  # dH/dA0
        self._parted, self._pulls = NONE, np.empty((0, 2 * n_modes))
        if contact == "exact":
            self._single = single
            self._work = crossings.work(1, size)
            self._rim = outlines.rim(size)
            self._circle = lanes.zeros(size, 4)
            self._circle[:, :2] = self._table[:2].T
            self._quarter, self._starts = outlines.quarter_points(scene.modes)
            self._grid = lanes.zeros(n_cells, 2, outlines.row_of_samples(size), kind=np.float32)
            self._pattern = np.zeros((n_cells, 1 + 4 * n_modes), np.float32)
            self._tangent = lanes.zeros(n_cells, (2 * n_modes + 5) // 4 * 4)
        else:
            self._rho = lanes.zeros(n_cells, size)
            self._slope = lanes.zeros(n_cells, size)
        self._outlines = outlines.contours if contact == "exact" else quadrature.sample_contours
        self._bound: dict[parts.Shared, parts.Bound] = {}
        self._at_one_go: tuple[tuple[int, int], ...] = ()
        self._reference: Floats | None = None
        self._capacity = 6 * n_cells + 64
        self._n_blocks = -(-n_cells // outlines.BLOCK)
        self._allocate_roots(12 * outlines.BLOCK)

    def velocity(self, state: Floats, out: Floats) -> None:
        """Write the deterministic part of d(state)/dt into `out`.

        Parameters
        ----------
        state
            (N, 3 + 2(M-1)) rows x, y, theta, a_2 .. a_M, b_2 .. b_M.
        out
            The same shape.

        Raises
        ------
        SimulationFailure
            If a number is not finite.
        """
        for array in (state, out):  # compiled code is given their addresses
            if array.dtype != np.float64 or not array.flags.c_contiguous:
                raise ValueError("a state must be a C-contiguous array of float64")
        self.evaluations += 1
        self._n_parts = min(self._n_blocks, numba.get_num_threads())
        reached = evaluation.NOTHING
        if self._n_parts == 1 and self._at_one_go:
            self._narrow = self._parted = NONE
            reached = evaluation.evaluate(
                self._at_one_go, state, out, self._record, self._reference, self._fault,
                *self._limits,
            )  # fmt: skip
        if reached != evaluation.ALL:
            self._evaluate(state, out, reached)

    def _evaluate(self, state: Floats, out: Floats, reached: int) -> None:
        """Take decisions between the kernels."""
        self._prepare(state, out, reached)
        if self.scene.rigid:
            self._do(discs.rigid_velocity, state, out)
        elif self.contact == "exact":
            self._find_crossings(state, out)
            self._do(overlaps.exact_velocity, state, out)
        else:
            self._do(quadrature.quadrature_velocity, state, out)
        if len(self._parted):
            areas.correct_velocity(
                self._record, self._parted, self._pulls, self.radius, self._growth,
                self.scene.mu_ab, self._n_modes, out,
            )  # fmt: skip
        if not (self._at_one_go or self.scene.rigid):
            self._get_ready()

    def energies(self, state: Floats) -> Floats:
        """Energy of every cell: its tension and its share of the overlaps, by the exact rule."""
        if self.contact != "exact":
            raise ValueError("energies belong to the exact contact rule")
        self.velocity(state, np.empty_like(state))
        if self.scene.rigid:
            shared = energies.disc_overlaps(
                state, self.radius, self._first, self._other, self._shift
            )
            return self.scene.k * shared + 2.0 * math.pi * self.scene.eta * self.radius
        areas_of_lenses = energies.lens_areas(
            self._roots, self._root_first, self._root_last, self._first
        )
        return self._energy + self.scene.k * areas_of_lenses

    def touching(self, state: Floats) -> NDArray[np.int64]:
        """Pairs (i, j) of cells that overlap by the exact rule, (pairs, 2), one row per image."""
        self.velocity(state, np.empty_like(state))
        pairs = np.column_stack([self._owner, self._other])
        if not self.scene.rigid:
            return pairs[(self._root_last > self._root_first) | (self._inside > 0)]
        apart = state[pairs[:, 1], :2] + self._shift - state[pairs[:, 0], :2]
        near: NDArray[np.bool_] = np.hypot(*apart.T) < self.radius[pairs].sum(axis=1)
        return pairs[near]

    @property
    def crossings(self) -> tuple[Any, ...]:
        """Contours, pairs and crossings of the state evaluated last, by the exact rule."""
        return (
            self._record, self._first, self._other, self._root_first, self._root_last, self._roots,
        )  # fmt: skip

    def age_of_list(self) -> Floats:
        """Centres, reach and lowest radius (N, 4) for which the neighbour list was made."""
        if self._reference is None:
            raise ValueError("the layer has not been evaluated yet")
        return self._reference

    def restore_list(self, reference: Floats) -> None:
        """Make the neighbour list as it was, so that sums keep their order after a restart."""
        self._record[:, [0, 1, 3, 4]] = reference
        self._rebuild()

    def _prepare(self, state: Floats, out: Floats, reached: int) -> None:
        if self.scene.rigid:
            self._record[:, :2] = state[:, :2]
            self._record[:, 2:5] = self.radius[:, None]
        elif reached == evaluation.NOTHING:
            self._do(self._outlines, state, out)
        fresh = self._reference is None
        reference = self._record if self._reference is None else self._reference  # any, if fresh
        age, fault, narrowest = neighbours.inspect(self._record, reference)
        self._narrow = self._parted = NONE
        if (fault >= 0 or narrowest < 4.0 * pinches.SHARP) and not self.scene.rigid:
            self._keep_areas()
            age, fault, _ = neighbours.inspect(self._record, reference)
            self._narrow = np.flatnonzero(self._record[:, 4] < pinches.SHARP * self.radius)
        self._check(fault)
        if len(self._narrow) and self._features[1] and self.contact == "exact":
            pinches.measure_lengths(self._record, self._narrow, self._n_modes, self._tangent)
        if fresh or age > 0.5 * self.skin:
            self._rebuild()

    def _do(self, kernel: parts.Shared, state: Floats, out: Floats) -> None:
        bound = self._bound.get(kernel)
        if bound is None:
            bound = self._bound[kernel] = parts.Bound(kernel, *self._handed(kernel))
        elif not bound.arrays:
            bound.describe(self._handed(kernel)[0])
        bound(self._n_parts, state, out)

    def _get_ready(self) -> None:
        """Note what the next evaluation does at one go, see `evaluation`."""
        kernels = [self._outlines, quadrature.quadrature_velocity]
        if self.contact == "exact":
            kernels[1:] = [crossings.crossings, overlaps.exact_velocity]
        bound = [self._bound[kernel] for kernel in kernels]
        self._at_one_go = tuple((work.address, work.kept) for work in bound)
        self._limits = 0.5 * self.skin, 4.0 * pinches.SHARP

    def _forget(self) -> None:
        """Arrays of pairs were made anew: no kernel knows where they are."""
        self._at_one_go = ()
        for kernel, bound in self._bound.items():
            if kernel is not self._outlines:
                bound.arrays = ()

    def _handed(self, kernel: parts.Shared) -> tuple[tuple[Any, ...], tuple[int, int, int]]:
        """What a kernel reads and writes, and the features it is compiled for."""
        modes, tension, _ = self._features
        if kernel is outlines.contours:
            arrays: tuple[Any, ...] = (
                self.radius, self._single, self._quarter, self._starts, self._record, self._grid,
                self._pattern, self._tangent,
            )  # fmt: skip
            return arrays, (modes, tension, 0)
        if kernel is quadrature.sample_contours:
            arrays = self.radius, self._table, self._record, self._rho, self._slope
            return arrays, (modes, 0, 0)
        pairs = self._first, self._other, self._shift
        back = self._back_first, self._back_pair, self._back_cell
        if kernel is crossings.crossings:
            arrays = (
                self._record, self._grid, self._rim, self._pattern, self._circle, self._table,
                self._first, self._owner, self._other, self._shift, self._roots[: self._room],
                self._root_first, self._root_last, self._lenses, self._inside, self._fault,
                *self._work,
            )  # fmt: skip
            return arrays, (modes, 0, 0)
        if kernel is overlaps.exact_velocity:
            arrays = (
                self.radius, self._record, self._tangent, self._first, self._other, *back,
                self._roots, self._root_first, self._root_last, self._lenses, self._inside,
                self._numbers, self._energy, self._growth,
            )  # fmt: skip
            return arrays, self._features
        if kernel is quadrature.quadrature_velocity:
            arrays = (
                self.radius, self._record, self._rho, self._slope, self._table, *pairs, *back,
                self._numbers, self._growth,
            )  # fmt: skip
            return arrays, self._features
        return (self.radius, *pairs, *back, self._numbers), (0, 0, 0)

    def _check(self, fault: int) -> None:
        if fault >= 0:
            raise SimulationFailure(
                "the state is not finite",
                "take a smaller step or the adaptive integrator",
                cell=fault,
            )

    def _keep_areas(self) -> None:
        """Mean radius, samples and bounds of contours with gaps, whose closed form differs."""
        n_modes = self._n_modes
        cells = np.flatnonzero(~(self._record[:, 4] >= PINCHED * self.radius))
        pulls = np.empty((len(cells), 2 * n_modes))
        parted = areas.keep_areas(self._record, self.radius, n_modes, cells, pulls)
        self._parted, self._pulls = cells[parted], pulls[parted]
        size = self._table.shape[1]
        spacing = 2.0 * math.pi / size
        for i in self._parted.tolist():
            if self.contact == "exact":
                rho, slope = np.empty(size), np.empty(size)
                areas.resample(self._record, i, self.radius[i], n_modes, rho, slope, spacing)
                self._fill_grid(i, rho, slope)
            else:
                areas.resample(
                    self._record, i, self.radius[i], n_modes, self._rho[i], self._slope[i], spacing
                )

    def _fill_grid(self, i: int, rho: Floats, slope: Floats) -> None:
        """Write a contour sampled anew to what the search of crossings reads."""
        row = self._grid.shape[2]
        self._grid[i] = np.resize(rho, row), np.resize(slope, row)
        n_modes = self._n_modes
        modes = self._record[i, records.HEAD : records.HEAD + 2 * n_modes]
        self._pattern[i, 0] = self._record[i, 2]
        self._pattern[i, 1 : 1 + 2 * n_modes] = modes
        self._pattern[i, 1 + 2 * n_modes :] = np.tile(np.arange(2, n_modes + 2), 2) * modes

    def _rebuild(self) -> None:
        position = np.ascontiguousarray(self._record[:, :2])
        reach = np.ascontiguousarray(self._record[:, 3])
        while True:
            first, other, shift, needed = neighbours.find_pairs(
                position, reach, self.box, self.skin, self._capacity
            )
            if needed[0] <= self._capacity:
                break
            if needed[0] > 4000 * len(self.radius) + 4000:
                raise SimulationFailure(
                    f"{needed[0]} pairs of images overlap",
                    "the box is far too small for its cells: enlarge it",
                )
            self._capacity = int(needed[0])
        self._first, self._other = first, other.copy()
        self._shift = lanes.zeros(len(other) + 1, 2)[:-1]  # two pairs are read at once
        self._shift[:] = shift
        self._put_narrow_first()
        self._owner = np.repeat(np.arange(len(reach)), np.diff(self._first))
        back = neighbours.transpose_pairs(self._first, self._other)
        self._back_first, self._back_pair, self._back_cell = back
        self._forget()
        self._root_first = np.zeros(len(self._other), np.int64)
        self._root_last = np.zeros(len(self._other), np.int64)
        self._inside = np.zeros(len(self._other), np.int8)
        self._lenses = lanes.zeros(len(self._other), lenses.LENS)
        self._reference = np.ascontiguousarray(self._record[:, [0, 1, 3, 4]])
        self.builds += 1

    def _put_narrow_first(self) -> None:
        """Turn the listed pairs so that crossings are sought on the contour with the waist."""
        waist = self._record[:, 4] / self.radius
        if not waist.min() < pinches.NARROW:
            return
        waist[waist > pinches.NARROW] = 1.0
        cell = np.repeat(np.arange(len(waist)), np.diff(self._first))
        turned = waist[self._other] < waist[cell]
        sign = np.where(turned, -1.0, 1.0)
        first, second = np.where(turned, (self._other, cell), (cell, self._other))
        order = np.argsort(first, kind="stable")
        self._other = second[order]
        self._shift[:] = (sign[:, None] * self._shift)[order]
        self._first = np.searchsorted(first[order], np.arange(len(waist) + 1))

    def _allocate_roots(self, room: int, spare: int = 0) -> None:
        self._room = self._n_blocks * room
        # The last row stays zero: no crossing.
        self._roots = lanes.zeros(self._room + spare + 1, lenses.ROOT)
        self._fault = np.zeros(self._n_blocks, np.int64)
        self._forget()

    def _find_crossings(self, state: Floats, out: Floats) -> None:
        while True:
            if len(self._work[0]) < self._n_parts:
                self._work = crossings.work(self._n_parts, self._table.shape[1])
                self._forget()
            self._do(crossings.crossings, state, out)
            if self._fault.any():
                self._allocate_roots(2 * self._room // self._n_blocks)
            elif (used := self._close_pinches()) >= len(self._roots):
                self._allocate_roots(self._room // self._n_blocks, 2 * (used - self._room))
            else:
                return

    def _close_pinches(self) -> int:
        """End the arcs of pinched contours where they reach the centre; return the room used."""
        if len(self._narrow) == 0:
            return 0
        pinched = self._record[:, 4] < PINCHED * self.radius
        if not pinched.any():
            return 0
        used: int = pinches.add_gaps(
            self._record, pinched, self._first, self._other, self._roots[:-1], self._root_first,
            self._root_last, self._lenses, self._inside, self._room, self._n_modes,
        )  # fmt: skip
        return used
