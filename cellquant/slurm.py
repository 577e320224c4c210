"""A job array for sites without Dask: one script that SLURM runs once per part of the work."""

import shlex
import sys
from pathlib import Path

from cellquant.errors import InputError
from cellquant.storage import atomic_path

SCRIPT = "slurm_array.sh"
MAX_PARTS = 1000  # what most sites allow in one array

_TEMPLATE = """\
#!/bin/bash
# {tasks} tasks in {parts} parts. Submit the parts, then the job that gathers their results:
#   job=$(sbatch --parsable {script})
#   sbatch --dependency=afterany:$job --array=0 {script} gather
# Submitting again resumes: finished work is not repeated. Adapt time and memory to your site.
#SBATCH --job-name=cellquant-{command}
#SBATCH --array=0-{last}
#SBATCH --cpus-per-task=1
#SBATCH --mem=4G
#SBATCH --time=24:00:00

export NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
part=(--part "${{SLURM_ARRAY_TASK_ID:-0}}/{parts}")
if [ "${{1:-}}" = gather ]; then
    part=()
fi
exec {program} -m cellquant {command} {file} -o {out} "${{part[@]}}"
"""


def write_array(
    command: str, file: Path, out: Path, *, n_tasks: int, parts: int | None = None
) -> Path:
    """Write ``slurm_array.sh`` into the output folder of a run or a sweep.

    Each element of the array works on one part of the tasks, with one kernel thread, and may be
    killed and submitted again like any other call.

    Parameters
    ----------
    command
        ``"run"`` or ``"sweep"``.
    file, out
        Its file and its output folder, which every node must see under the same path.
    n_tasks
        Number of stacks or runs.
    parts
        Elements of the array; as many as tasks, and at most `MAX_PARTS`, when None.

    Raises
    ------
    InputError
        If `parts` is below one, or the script cannot be written.
    """
    if parts is not None and parts < 1:
        raise InputError(f"--parts must be at least 1, got {parts}.")
    number = min(n_tasks, parts or MAX_PARTS)
    script = out.resolve() / SCRIPT
    text = _TEMPLATE.format(
        tasks=n_tasks,
        parts=number,
        last=number - 1,
        command=command,
        program=shlex.quote(sys.executable),
        file=shlex.quote(str(file.resolve())),
        out=shlex.quote(str(out.resolve())),
        script=shlex.quote(str(script)),
    )
    with atomic_path(script) as path:
        path.write_text(text, encoding="utf-8")
        path.chmod(0o755)
    return script
