"""Compiled code: the same results from any cache, whoever filled it and in whatever order."""

import importlib
import os
import pkgutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from numba.core.registry import CPUDispatcher

import cellquant

SIMULATE = """
import hashlib
import sys
import numpy as np
import cellquant as cq

def simulate(**fields):
    run = cq.simulate(cq.Scene(phi=0.95, n_cells=16, **fields), duration=20, seed=1)
    names = sorted(run._group.array_keys())
    data = b"".join(np.ascontiguousarray(run._group[name][:]).tobytes() for name in names)
    return hashlib.sha1(data).hexdigest()

scenes = {"active": {}, "passive": {"v0": 0.0, "D_r": 0.0, "eta": 0.0}}
for name in sys.argv[1:]:
    print(name, simulate(**scenes[name]))
"""


def kernels() -> Iterator[tuple[str, CPUDispatcher]]:
    for module in pkgutil.walk_packages(cellquant.__path__, "cellquant."):
        if module.name.endswith("__main__"):
            continue
        for name, value in vars(importlib.import_module(module.name)).items():
            if isinstance(value, CPUDispatcher) and value.py_func.__module__ == module.name:
                yield f"{module.name}.{name}", value


def parts(kernel: CPUDispatcher) -> Iterator[CPUDispatcher]:
    function = kernel.py_func
    for name in function.__code__.co_names:
        if isinstance(value := function.__globals__.get(name), CPUDispatcher):
            yield value


def test_a_kernel_calls_no_loosely_compiled_code_of_another() -> None:
    """A called kernel may be replaced, when it is loaded, by a copy that another kernel brought.

    Where its arithmetic may be reordered, the copies differ in the last digit.
    """
    found = dict(kernels())
    assert len(found) > 50
    called = {part for kernel in found.values() for part in parts(kernel)}
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
