"""Compiled code: the same results from any cache, whoever filled it and in whatever order."""

import importlib
import os
import pkgutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core.registry import CPUDispatcher

import cellquant
from cellquant.sim import parts as parts_of_work
from cellquant.sim.parts import Shared

SIMULATE = """
import hashlib
import sys
import numpy as np
import cellquant as cq

def simulate(**fields):
    run = cq.simulate(cq.Scene(phi=0.95, n_cells=16, **fields), duration=40, seed=1)
    names = sorted(run._group.array_keys())
    data = b"".join(np.ascontiguousarray(run._group[name][:]).tobytes() for name in names)
    measured = cq.observe(run)
    data += repr(measured.summary).encode()
    data += b"".join(table.to_csv().encode() for table in measured.tables.values())
    return hashlib.sha1(data).hexdigest()

scenes = {"active": {}, "passive": {"v0": 0.0, "D_r": 0.0, "eta": 0.0}}
for name in sys.argv[1:]:
    print(name, simulate(**scenes[name]))
"""


def compiled(kind: type) -> Iterator[Any]:
    for module in pkgutil.walk_packages(cellquant.__path__, "cellquant."):
        if module.name.endswith("__main__"):
            continue
        for value in vars(importlib.import_module(module.name)).values():
            if isinstance(value, kind):
                yield value


def parts(function: Any) -> Iterator[CPUDispatcher]:
    for name in function.__code__.co_names:
        if isinstance(value := function.__globals__.get(name), CPUDispatcher):
            yield value


def test_a_kernel_calls_no_loosely_compiled_code_of_another() -> None:
    """A called kernel may be replaced, when it is loaded, by a copy that another kernel brought.

    Where its arithmetic may be reordered, the copies differ in the last digit.
    """
    shared = {kernel.function for kernel in compiled(Shared)}
    assert len(shared) > 5
    alone = {kernel.py_func for kernel in compiled(CPUDispatcher)}
    assert len(alone) > 50
    called = {part for function in shared | alone for part in parts(function)}
    assert len(called) > 20
    loose = [part for part in called if part.targetoptions.get("fastmath")]
    assert len(loose) > 10
    outside = [
        part.py_func.__name__
        for part in loose
        if not part.targetoptions.get("forceinline")
        and part.targetoptions.get("inline") != "always"
    ]
    assert not outside, f"add forceinline=True to {outside}"


def test_loosely_compiled_work_on_a_layer_is_shared_by_address() -> None:
    """The body of a parallel loop is compiled several times over: see `cellquant.sim.parts`."""
    loops = [
        kernel.py_func.__name__
        for kernel in compiled(CPUDispatcher)
        if kernel.py_func.__module__.startswith("cellquant.sim")
        and kernel.targetoptions.get("parallel")
        and kernel.targetoptions.get("fastmath")
    ]
    assert not loops, f"make {loops} shared"


def test_arrays_are_read_where_they_are_described() -> None:
    """Of every kind and dimension that kernels read, also after they were made anew."""

    def total(part: int, n_parts: int, kept: Any, state: Any, out: Any) -> None:
        flat, plane, solid, small = parts_of_work.taken(kept)
        modes, tension, torque = parts_of_work.features_of(kept)
        out[0, 0] = flat.sum() + plane[1, 2] + solid[1, 0, 1] + small[-1] + state[0, 1]
        out[0, 1] = plane.shape[1] * len(modes) + len(tension) - len(torque)

    rng = np.random.default_rng(1)

    def arrays() -> tuple[Any, ...]:
        return (
            rng.integers(0, 9, 5),
            rng.random((2, 3)),
            rng.random((2, 2, 2)).astype(np.float32),
            rng.integers(0, 9, 4).astype(np.int8),
        )

    state, out = rng.random((1, 3)), np.empty((1, 2))
    kernel = parts_of_work.Shared(total, set())
    work = parts_of_work.Bound(kernel, arrays(), (4, 1, 0))
    (compiled_kernel,) = kernel._compiled.values()
    assert "alignstack=32" in compiled_kernel.inspect_llvm()
    for _ in range(2):
        flat, plane, solid, small = work.arrays
        for n_parts in (1, 2):
            out[:] = np.nan
            work(n_parts, state, out)
            expected = flat.sum() + plane[1, 2] + solid[1, 0, 1] + small[-1] + state[0, 1]
            assert out.tolist() == [[pytest.approx(expected, rel=1e-15), 13.0]]
        work.describe(arrays())


@pytest.mark.slow
def test_code_just_compiled_and_code_from_the_cache_give_the_same_bits(tmp_path: Path) -> None:
    def run(orders: list[str], cache: str) -> list[dict[str, str]]:
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / cache)}
        processes = [
            subprocess.Popen(
                [sys.executable, "-c", SIMULATE, *order.split()],
                env=environment,
                stdout=subprocess.PIPE,
                text=True,
            )
            for order in orders
        ]
        answers = [process.communicate()[0] for process in processes]
        assert all(process.returncode == 0 for process in processes)
        return [dict(line.split() for line in answer.splitlines()) for answer in answers]

    side_by_side = run(["active passive", "passive active"], "one")
    cached = run(["active passive", "passive active"], "one")
    alone = run(["passive active"], "two")
    assert len(side_by_side[0]) == 2
    assert all(answer == side_by_side[0] for answer in [*side_by_side, *cached, *alone])
