"""CPU time to compile what the default scene needs, from an empty cache, and to load it again."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

RESULTS = Path(__file__).parent / "results"
SIMULATE = """
import json
import time
import numpy as np
import cellquant as cq
from cellquant.sim import parts
from numba.core import event

begin = time.process_time()
own, stack = {}, []

def start():
    stack.append([time.process_time(), 0.0])

def stop(function):
    moment, inner = stack.pop()
    whole = time.process_time() - moment
    if stack:
        stack[-1][1] += whole
    name = function.__module__.split(".", 1)[-1] + "." + function.__name__
    seconds, count = own.get(name, (0.0, 0))
    own[name] = seconds + whole - inner, count + 1

class Clock(event.Listener):
    def on_start(self, event):
        start()

    def on_end(self, event):
        stop(event.data["dispatcher"].py_func)

address = parts.Shared.address

def timed(self, *arguments):
    start()
    try:
        return address(self, *arguments)
    finally:
        stop(self.function)

parts.Shared.address = timed
event.register("numba:compile", Clock())
cq.simulate(cq.Scene(n_cells=16), duration=2, seed=1)
print(json.dumps({"seconds": time.process_time() - begin, "kernels": own}))
"""


def measure(cache):
    """CPU time of a short run of the default scene, with what each kernel took to compile."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
    answer = subprocess.run(
        [sys.executable, "-c", SIMULATE],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(answer.stdout.splitlines()[-1])


def main():
    with tempfile.TemporaryDirectory() as cache:
        cold, warm = measure(cache), measure(cache)
    kernels = sorted(cold["kernels"].items(), key=lambda item: -item[1][0])
    for name, (seconds, count) in kernels:
        print(f"{seconds:7.2f} s  {count:2d}  {name}")
    print(f"cold {cold['seconds']:.1f} s of CPU, cached {warm['seconds']:.1f} s")
    content = {
        "compile_and_run": cold["seconds"],
        "cached": warm["seconds"],
        "kernels": {name: seconds for name, (seconds, _) in kernels},
    }
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "compile_time.json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
