r"""The stiff part of the contacts, and linear solves with it.

The Hessian of the overlap energy is dominated by the motion of the crossings. With u the normal
displacement of a contour per unit change of its coordinates, every crossing at which the contours
meet under the angle psi adds

.. math:: k\, w w^T / \sin\psi, \qquad w = (u_i, u_j),

which is positive and of rank one. Scaled by the square roots of the mobilities the operator
1 + g S H S is symmetric and positive, and conjugate gradients need few products. The modes are
turned into the frame of the laboratory, where w needs no polarity. The operator only steadies a
step, so single precision is enough: it halves the traffic and doubles the lanes.
"""

import math
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from cellquant.sim.contacts import Layer
from cellquant.sim.gathers import gather_pair, scatter
from cellquant.sim.lanes import (
    LANES,
    absolute,
    greatest,
    load_pair,
    root,
    store,
)
from cellquant.sim.lenses import ROOT
from cellquant.sim.records import HEAD

Floats = NDArray[np.float64]
CG_TOLERANCE = 1e-2
CG_MOST = 200
LEAST_SINE = 0.05  # smaller angles, of grazing contacts, would only cost iterations
FLAGS = {"contract", "reassoc", "nsz", "arcp"}
LOOSE = ("contract", "reassoc", "nsz")  # NaN stays what it is


def row_length(n_modes: int) -> int:
    """Columns of a cell in single precision, padded to whole vector registers."""
    return LANES * ((2 + LANES + 2 * n_modes) // LANES)


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def list_crossings(
    first: Any, other: Any, root_first: Any, root_last: Any, roots: Any, stride: int, rows: Any,
    cells: Any,
) -> int:  # fmt: skip
    """List where the numbers of every crossing, of its i and of its j begin; return how many.

    Where that exceeds the room, the rest is not stored.
    """
    count = 0
    for i in range(first.shape[0] - 1):
        for p in range(first[i], first[i + 1]):
            for r in range(root_first[p], root_last[p]):
                if roots[r, 3] == 0.0 or roots[r, 7] == 0.0:
                    continue  # an arc that ends at the centre of a pinched cell, no crossing
                if count < cells.shape[0]:
                    rows[0, count] = stride * i
                    rows[1, count] = stride * other[p]
                    rows[2, count] = ROOT * r
                    cells[count, 0] = i
                    cells[count, 1] = other[p]
                count += 1
    return count


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def gather(
    record: Any, first: Any, other: Any, root_first: Any, root_last: Any, roots: Any,
    scale: Any, k: float, modes: Any, rows: Any, weight: Any, factor: Any, cells: Any,
) -> tuple[int, float]:  # fmt: skip
    """Collect w and k / sin(psi) of all crossings.

    Returns their number (where it exceeds the room, nothing is stored), and the mean stiffness
    2 k |w|^2 / sin(psi) of a contact with two of them, per time.
    """
    n_modes = len(modes)
    width = weight.shape[1] // 2
    room = rows.shape[1]
    count = list_crossings(first, other, root_first, root_last, roots, record.shape[1], rows, cells)
    if count == 0 or count > cells.shape[0]:
        return count, 0.0
    padded = (count + LANES - 1) // LANES * LANES
    for r in range(count, padded):
        for row in range(3):
            rows[row, r] = rows[row, count - 1]
    real = np.empty((2 * n_modes + 4) * LANES)
    imaginary = real[n_modes * LANES :]
    column = np.zeros(width * LANES)
    share = np.empty(LANES)
    total = 0.0
    for r in range(0, padded, LANES):
        c, s, _, rho = gather_pair(roots, rows, 2 * room + r, 0)
        c_2, s_2, _, rho_2 = gather_pair(roots, rows, 2 * room + r, 4)
        ax = c
        ay = c
        squares = c
        for side in range(2):
            if side == 1:
                c, s, rho = c_2, s_2, rho_2
            at = side * room + r
            _, _, mean, _ = gather_pair(record, rows, at, 0)
            _, _, _, radius = gather_pair(record, rows, at, 4)
            for m in range(0, 2 * n_modes, 4):
                v0, v1, v2, v3 = gather_pair(record, rows, at, HEAD + m)
                store(real, m * LANES, v0)
                store(real, (m + 1) * LANES, v1)
                store(real, (m + 2) * LANES, v2)
                store(real, (m + 3) * LANES, v3)
            slope = 0.0 * c
            zr = c
            zi = s
            for m in range(n_modes):
                zr, zi = zr * c - zi * s, zr * s + zi * c
                turned = load_pair(real, m * LANES) * zi + load_pair(imaginary, m * LANES) * zr
                slope -= (m + 2.0) * turned
            tx = slope * c - rho * s
            ty = slope * s + rho * c
            inverse = 1.0 / root(greatest(tx * tx + ty * ty, 1e-24))
            tx *= inverse
            ty *= inverse
            turning = -rho * slope * inverse * scale[2]
            store(column, 0, ty * scale[0])
            store(column, LANES, -tx * scale[1])
            store(column, 2 * LANES, turning)
            square = scale[0] * scale[0] + turning * turning
            if n_modes > 0:
                radial = radius * rho * inverse * scale[3]
                half = 0.5 / greatest(mean, 0.2 * radius)
                zr = c
                zi = s
                for m in range(n_modes):
                    zr, zi = zr * c - zi * s, zr * s + zi * c
                    along = radial * (zr - half * load_pair(real, m * LANES))
                    across = radial * (zi + half * load_pair(imaginary, m * LANES))
                    store(column, (3 + m) * LANES, along)
                    store(column, (3 + n_modes + m) * LANES, across)
                    square += along * along + across * across
            for q in range(0, width, 4):
                scatter(
                    weight, r * 2 * width + side * width + q, 2 * width,
                    load_pair(column, q * LANES), load_pair(column, (q + 1) * LANES),
                    load_pair(column, (q + 2) * LANES), load_pair(column, (q + 3) * LANES),
                )  # fmt: skip
            if side == 0:
                ax, ay, squares = tx, ty, square
                continue
            rigidity = k / greatest(absolute(ax * ty - ay * tx), LEAST_SINE)
            store(share, 0, rigidity)
            for lane in range(LANES):
                factor[r + lane] = share[lane]
            store(share, 0, 2.0 * rigidity * (squares + square))
            for lane in range(min(LANES, count - r)):
                total += share[lane]
    return count, total / count


@intrinsic
def push(
    typing_context: Any, weight: Any, crossing: Any, direction: Any, product: Any, i: Any, j: Any,
    coefficient: Any, modes: Any,
) -> Any:  # fmt: skip
    """Add coefficient w (w . direction) to `product` for one crossing, in vector registers.

    Written as vector instructions, because a compiler that cannot exclude that `weight` and
    `product` share memory leaves the loop scalar: this is six times faster.
    """
    chunks = row_length(modes.count) // LANES
    signature = types.void(
        weight, types.int64, direction, product, types.int64, types.int64, types.float32, modes
    )

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lanes = ir.VectorType(ir.FloatType(), LANES)

        def rows(position: int, row: Any, offset: int) -> list[Any]:
            array = context.make_array(signature.args[position])(
                context, builder, arguments[position]
            )
            stride = (2 if position == 0 else 1) * chunks * LANES
            start = builder.mul(row, ir.Constant(row.type, stride))
            pointers = []
            for chunk in range(chunks):
                shift = ir.Constant(row.type, offset + chunk * LANES)
                pointer = builder.gep(array.data, [builder.add(start, shift)])
                pointers.append(builder.bitcast(pointer, lanes.as_pointer()))
            return pointers

        def load(pointers: list[Any]) -> list[Any]:
            return [builder.load(pointer, align=4) for pointer in pointers]

        _, crossing, _, _, i, j, coefficient, _ = arguments
        own = load(rows(0, crossing, 0))
        other = load(rows(0, crossing, chunks * LANES))
        moved = load(rows(2, i, 0)) + load(rows(2, j, 0))
        total = None
        for a, b in zip(own + other, moved, strict=True):
            term = builder.fmul(a, b, flags=LOOSE)
            total = term if total is None else builder.fadd(total, term, flags=LOOSE)
        name = f"llvm.vector.reduce.fadd.v{LANES}f32"
        kind = ir.FunctionType(ir.FloatType(), [ir.FloatType(), lanes])
        add_lanes = cgutils.get_or_insert_function(  # type: ignore[no-untyped-call]
            builder.module, kind, name
        )
        zero = ir.Constant(ir.FloatType(), 0.0)
        dot = builder.call(add_lanes, [zero, total], fastmath=LOOSE)
        dot = builder.fmul(dot, coefficient)
        spread = ir.Constant(lanes, ir.Undefined)
        for lane in range(LANES):
            at = ir.Constant(ir.IntType(32), lane)
            spread = builder.insert_element(spread, dot, at)
        for row, vectors in ((i, own), (j, other)):
            pointers = rows(3, row, 0)
            for pointer, vector in zip(pointers, vectors, strict=True):
                term = builder.fmul(vector, spread, flags=("contract",))
                value = builder.fadd(builder.load(pointer, align=4), term, flags=("contract",))
                builder.store(value, pointer, align=4)
        return context.get_dummy_value()

    return signature, generate


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def multiply(
    count: int, weight: Any, factor: Any, cells: Any, g: float, modes: Any, direction: Any,
    product: Any,
) -> None:  # fmt: skip
    """Add g S H S direction to `product`."""
    share = np.float32(g)
    for r in range(count):
        i = cells[r, 0]
        j = cells[r, 1]
        push(weight, r, direction, product, i, j, share * factor[r], modes)  # type: ignore[call-arg]


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def solve(
    state: Any, right: Any, scale: Any, count: int, weight: Any, factor: Any, cells: Any,
    diagonal: Any, g: float, modes: Any, tolerance: float, most: int, work: Any, out: Any,
) -> int:  # fmt: skip
    """Solve (1 + diag + g M H) out = right by conjugate gradients; return the iterations.

    `right` and `out` have the columns of a state; `work` is (5, N, padded columns). Where `right`
    is not finite, neither is `out`.
    """
    n_cells = state.shape[0]
    n_modes = len(modes)
    fixed = work[0]
    rest = work[1]
    along = work[2]
    image = work[3]
    x = work[4]
    for i in range(n_cells):
        for d in range(3):
            fixed[i, d] = right[i, d] / scale[d] if scale[d] > 0.0 else 0.0
        if n_modes > 0:
            inverse = 1.0 / scale[3] if scale[3] > 0.0 else 0.0
            c = math.cos(state[i, 2])
            s = math.sin(state[i, 2])
            zr = c
            zi = s
            for m in range(n_modes):
                zr, zi = zr * c - zi * s, zr * s + zi * c
                a = right[i, 3 + m] * inverse
                b = right[i, 3 + n_modes + m] * inverse
                fixed[i, 3 + m] = a * zr - b * zi
                fixed[i, 3 + n_modes + m] = b * zr + a * zi
    b_flat = fixed.reshape(-1)
    x_flat = x.reshape(-1)
    rest_flat = rest.reshape(-1)
    along_flat = along.reshape(-1)
    image_flat = image.reshape(-1)
    stiff = diagonal.reshape(-1)
    square = np.float32(0.0)
    for n in range(x_flat.shape[0]):
        x_flat[n] = np.float32(0.0)
        rest_flat[n] = b_flat[n]
        along_flat[n] = b_flat[n]
        square += b_flat[n] * b_flat[n]
    if not math.isfinite(square):
        out[:] = math.nan
        return 0
    limit = np.float32(tolerance * tolerance) * square
    done = most
    for iteration in range(most):
        if not square > limit:
            done = iteration
            break
        for n in range(x_flat.shape[0]):
            image_flat[n] = along_flat[n] * (np.float32(1.0) + stiff[n])
        multiply(count, weight, factor, cells, g, modes, along, image)
        curvature = np.float32(0.0)
        for n in range(x_flat.shape[0]):
            curvature += along_flat[n] * image_flat[n]
        alpha = square / curvature
        fresh = np.float32(0.0)
        for n in range(x_flat.shape[0]):
            x_flat[n] += alpha * along_flat[n]
            rest_flat[n] -= alpha * image_flat[n]
            fresh += rest_flat[n] * rest_flat[n]
        beta = fresh / square
        for n in range(x_flat.shape[0]):
            along_flat[n] = rest_flat[n] + beta * along_flat[n]
        square = fresh
    for i in range(n_cells):
        for d in range(3):
            out[i, d] = scale[d] * x[i, d]
        if n_modes > 0:
            c = math.cos(state[i, 2])
            s = math.sin(state[i, 2])
            zr = c
            zi = s
            for m in range(n_modes):
                zr, zi = zr * c - zi * s, zr * s + zi * c
                a = scale[3] * x[i, 3 + m]
                b = scale[3] * x[i, 3 + n_modes + m]
                out[i, 3 + m] = a * zr + b * zi
                out[i, 3 + n_modes + m] = b * zr - a * zi
    return done


class StiffPart:
    """The stiff part M H of one layer: collected at a state, then solved with.

    Attributes
    ----------
    mean
        Mean stiffness of a contact at the last state collected, 1/t0.
    tension
        (N, padded columns) stiffness of the shape modes by the line tension, 1/t0.
    iterations
        Products with M H made so far.
    """

    def __init__(self, layer: Layer) -> None:
        scene = layer.scene
        n_cells = len(layer.radius)
        self._layer = layer
        self._modes = (0,) * (scene.modes - 1)
        self._scale = np.full(layer.n_columns, math.sqrt(scene.mu_ab))
        self._scale[:2] = math.sqrt(scene.mu_r)
        self._scale[2] = math.sqrt(scene.mu_theta)
        self._width = row_length(len(self._modes))
        n = np.arange(2, scene.modes + 1)
        stretch = np.tile(n**2 - 1.0, 2)
        self.tension = np.zeros((n_cells, self._width))
        self.tension[:, 3 : layer.n_columns] = (
            scene.mu_ab * scene.eta * math.pi * layer.radius[:, None] * stretch
        )
        self.mean = 0.0
        self.iterations = 0
        self._count = 0
        self._work = np.zeros((5, n_cells, self._width), np.float32)
        self._allocate(8 * n_cells)

    def collect(self) -> None:
        """Take the crossings of the state that the layer evaluated last."""
        while True:
            self._count, self.mean = gather(
                *self._layer.crossings, self._scale,  # type: ignore[call-arg]
                self._layer.scene.k, self._modes, self._rows, self._weight, self._factor,
                self._cells,
            )  # fmt: skip
            if self._count <= len(self._cells):
                return
            self._allocate(self._count + self._count // 4)

    def solve(
        self, state: Floats, right: Floats, g: float, diagonal: Any, out: Floats,
        *, share: float = 1.0,
    ) -> None:  # fmt: skip
        """Solve (1 + diagonal + g M H) out = right; `state` as when collected.

        The residual is at most `share` CG_TOLERANCE of the right-hand side.
        """
        self.iterations += solve(
            state, right, self._scale, self._count, self._weight, self._factor, self._cells,
            diagonal, g, self._modes, max(share * CG_TOLERANCE, 1e-6), CG_MOST, self._work, out,
        )  # fmt: skip

    def _allocate(self, room: int) -> None:
        self._rows = np.zeros((3, room + LANES), np.int64)
        self._weight = np.zeros((room + LANES, 2 * self._width), np.float32)
        self._factor = np.empty(room + LANES, np.float32)
        self._cells = np.empty((room, 2), np.int64)
