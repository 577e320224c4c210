"""What is in a stack of label masks, found in one pass over its frames."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from cellquant.errors import InputError
from cellquant.io.faults import FrameFaults, find_faults, same_content
from cellquant.io.stack import LabelStack

# Labels run through time when this share of the way from chance to certainty is reached.
_LINKED_AT = 0.75
# With fewer recurring labels, or with a chance level above this, the data cannot tell.
_MIN_PAIRS = 3
_MAX_CHANCE = 0.5
# So many recurring labels make a single pair of frames worth a judgement of its own.
_MIN_PAIRS_OF_FRAME = 6
# So many pieces per label are no segmentation.
_IMAGE_AT = 10
FAULTS = (
    "fragments",
    "specks",
    "holes",
    "border_cells",
    "empty_frames",
    "duplicated_frames",
    "vanished_frames",
)


@dataclass(frozen=True)
class Identity:
    """Whether a label means the same cell in the next frame.

    Attributes
    ----------
    ids
        ``linked`` through time, ``per frame``, or ``undecided``.
    agreement
        Of the labels that recur in the next frame, the fraction that lies within one mean cell
        spacing, sqrt(image area / number of cells), of where it was; None where none recurs.
    chance
        The same fraction for labels given at random.
    n_pairs
        Number of recurring labels over all pairs of consecutive frames.
    breaks
        Frames whose labels disagree with the frame before, where most other frames agree.
    """

    ids: str
    agreement: float | None
    chance: float | None
    n_pairs: int
    breaks: tuple[int, ...] = ()


@dataclass(frozen=True)
class Inspection:
    """What `inspect_labels` found.

    Attributes
    ----------
    path
        File or folder; None for an array in memory.
    axes, n_frames, shape, dtype
        As those of the stack.
    first_frame, last_frame
        Frame numbers.
    calibration
        ``pixel_size``, ``frame_interval``, ``length_unit``, ``time_unit``, ``source``; None
        where there is none.
    calibration_problem
        Why there is no calibration; empty where there is one.
    identity
        Whether labels run through time.
    cells_per_frame
        Number of labels in each frame.
    faults
        Counts by the names of `FAULTS`.
    empty_frames, duplicated_frames, vanished_frames
        Frame numbers: without any label, repeating the frame before, missing from the folder.
    fragmented
        Up to 20 pairs (frame number, label) with several parts.
    notes
        How the input was understood.
    """

    path: str | None
    axes: str
    n_frames: int
    shape: tuple[int, int]
    dtype: str
    first_frame: int
    last_frame: int
    calibration: Mapping[str, Any] | None
    calibration_problem: str
    identity: Identity
    cells_per_frame: tuple[int, ...]
    faults: Mapping[str, int]
    empty_frames: tuple[int, ...]
    duplicated_frames: tuple[int, ...]
    vanished_frames: tuple[int, ...]
    fragmented: tuple[tuple[int, int], ...]
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Everything as JSON-serialisable values."""
        counts = self.cells_per_frame
        return {
            "path": self.path,
            "axes": self.axes,
            "n_frames": self.n_frames,
            "shape": list(self.shape),
            "dtype": self.dtype,
            "first_frame": self.first_frame,
            "last_frame": self.last_frame,
            "calibration": None if self.calibration is None else dict(self.calibration),
            "calibration_problem": self.calibration_problem or None,
            "ids": self.identity.ids,
            "ids_agreement": self.identity.agreement,
            "ids_chance": self.identity.chance,
            "ids_pairs": self.identity.n_pairs,
            "ids_breaks": list(self.identity.breaks),
            "cells_per_frame": {
                "min": min(counts),
                "median": median(counts),
                "max": max(counts),
                "total": sum(counts),
                "each": list(counts),
            },
            "faults": dict(self.faults),
            "empty_frames": list(self.empty_frames),
            "duplicated_frames": list(self.duplicated_frames),
            "vanished_frames": list(self.vanished_frames),
            "fragmented": [list(pair) for pair in self.fragmented],
            "notes": list(self.notes),
        }

    def as_text(self) -> str:
        """The same in lines for a reader."""
        counts = self.cells_per_frame
        rows, columns = self.shape
        lines = [
            f"source: {self.path or 'array'}",
            f"frames: {self.n_frames} (numbers {self.first_frame} to {self.last_frame}) of "
            f"{columns} x {rows} px, axes {self.axes}, {self.dtype}",
            f"calibration: {self._calibration_text()}",
            f"labels: {self._identity_text()}",
            f"cells per frame: {min(counts)} to {max(counts)}, median {median(counts):g}, "
            f"{sum(counts)} in all",
        ]
        found = [
            f"{count} {name.replace('_', ' ')}" for name, count in self.faults.items() if count
        ]
        lines.append(f"faults: {', '.join(found) or 'none'}")
        for name in ("empty_frames", "duplicated_frames", "vanished_frames"):
            numbers = getattr(self, name)
            if numbers:
                listed = ", ".join(map(str, numbers[:20])) + (", ..." if numbers[20:] else "")
                lines.append(f"{name.replace('_', ' ')}: {listed}")
        if self.fragmented:
            listed = ", ".join(f"{label} in frame {frame}" for frame, label in self.fragmented[:5])
            lines.append(f"fragmented labels: {listed}{', ...' if self.fragmented[5:] else ''}")
        lines += [f"note: {text}" for text in self.notes]
        return "\n".join(lines)

    def _calibration_text(self) -> str:
        if self.calibration is None:
            return f"none ({self.calibration_problem.removeprefix(self.path or '').lstrip(': ')})"
        c = self.calibration
        return (
            f"{c['pixel_size']:g} {c['length_unit']} per px, {c['frame_interval']:g} "
            f"{c['time_unit']} per frame ({c['source']})"
        )

    def _identity_text(self) -> str:
        identity = self.identity
        meaning = {
            "linked": "linked: a label is the same cell in every frame",
            "per frame": "per frame: a label does not carry over to the next frame",
            "undecided": "undecided whether a label carries over to the next frame",
        }[identity.ids]
        if identity.breaks:
            listed = ", ".join(map(str, identity.breaks[:10]))
            meaning += f"; they jump at frame {listed}{', ...' if identity.breaks[10:] else ''}"
        if identity.agreement is None or identity.chance is None:
            reason = "no label recurs" if identity.ids == "per frame" else "too few cells"
            return f"{meaning} ({reason})"
        return (
            f"{meaning} (of {identity.n_pairs} recurring labels {identity.agreement:.1%} stay "
            f"within one cell spacing, {identity.chance:.1%} expected by chance)"
        )


def inspect_labels(
    stack: LabelStack, *, progress: Callable[[int, int], None] | None = None
) -> Inspection:
    """Describe a stack of label masks: cells, calibration, identity of labels, faults.

    Parameters
    ----------
    stack
        Label masks; each frame is read once, two are in memory at a time.
    progress
        Called with the number of frames done and of all frames.

    Returns
    -------
    Inspection

    Raises
    ------
    InputError
        If a frame cannot be read or holds what is no label.
    """
    counts: list[int] = []
    empty: list[int] = []
    duplicated: list[int] = []
    fragmented: list[tuple[int, int]] = []
    totals = dict.fromkeys(FAULTS, 0)
    pairs: list[_Pair] = []
    before: tuple[np.ndarray[Any, Any], FrameFaults] | None = None
    for index, number in enumerate(stack.frame_numbers):
        labels = stack[index]
        found = find_faults(labels)
        counts.append(found.n_labels)
        for name in ("fragments", "specks", "holes", "border_cells"):
            totals[name] += getattr(found, name)
        fragmented += [(number, int(label)) for label in found.fragmented]
        if found.n_labels == 0:
            empty.append(number)
        if before is not None:
            if same_content(before[0], labels, before[1], found):
                duplicated.append(number)
            elif found.n_labels and before[1].n_labels:
                pairs.append(_compare(number, before[1], found, stack.shape))
        before = labels, found
        if progress is not None:
            progress(index + 1, stack.n_frames)
    present = set(stack.frame_numbers)
    vanished = [
        number
        for number in range(stack.frame_numbers[0], stack.frame_numbers[-1])
        if number not in present
    ]
    totals["empty_frames"] = len(empty)
    totals["duplicated_frames"] = len(duplicated)
    totals["vanished_frames"] = len(vanished)
    notes = stack.notes
    if totals["fragments"] + totals["specks"] > _IMAGE_AT * sum(counts):
        notes += ("labels lie in many pieces each: this looks like images, not label masks",)
    calibration, problem = _calibration(stack)
    return Inspection(
        path=None if stack.path is None else str(stack.path),
        axes=stack.axes,
        n_frames=stack.n_frames,
        shape=stack.shape,
        dtype=str(stack.dtype),
        first_frame=stack.frame_numbers[0],
        last_frame=stack.frame_numbers[-1],
        calibration=calibration,
        calibration_problem=problem,
        identity=_identity(pairs),
        cells_per_frame=tuple(counts),
        faults=totals,
        empty_frames=tuple(empty),
        duplicated_frames=tuple(duplicated),
        vanished_frames=tuple(vanished),
        fragmented=tuple(fragmented[:20]),
        notes=notes,
    )


def _calibration(stack: LabelStack) -> tuple[Mapping[str, Any] | None, str]:
    try:
        calibration = stack.calibration
    except InputError as error:
        return None, str(error)
    return {
        "pixel_size": calibration.pixel_size,
        "frame_interval": calibration.frame_interval,
        "length_unit": calibration.units.length,
        "time_unit": calibration.units.time,
        "source": calibration.source,
    }, ""


@dataclass(frozen=True)
class _Pair:
    """Recurring labels of a frame: all, those that stayed, those expected to by chance."""

    frame: int
    recurring: int
    stayed: int
    by_chance: float

    def agrees(self) -> bool:
        """Whether most of the way from chance to certainty is reached."""
        return self.stayed > self.by_chance + _LINKED_AT * (self.recurring - self.by_chance)


def _compare(frame: int, before: FrameFaults, after: FrameFaults, shape: tuple[int, int]) -> _Pair:
    spacing = math.sqrt(shape[0] * shape[1] / after.n_labels)
    _, here, there = np.intersect1d(
        before.label, after.label, assume_unique=True, return_indices=True
    )
    moved = np.hypot(before.x[here] - after.x[there], before.y[here] - after.y[there])
    near = 0  # cells of the next frame in reach of each, in blocks that stay small
    for start in range(0, len(here), 512):
        block = here[start : start + 512]
        across = before.x[block, np.newaxis] - after.x
        down = before.y[block, np.newaxis] - after.y
        near += int(np.count_nonzero(across**2 + down**2 < spacing**2))
    stayed = int(np.count_nonzero(moved < spacing))
    return _Pair(frame, len(here), stayed, near / after.n_labels)


def _identity(pairs: list[_Pair]) -> Identity:
    total = _Pair(
        -1,
        sum(pair.recurring for pair in pairs),
        sum(pair.stayed for pair in pairs),
        sum(pair.by_chance for pair in pairs),
    )
    if total.recurring == 0:
        return Identity("per frame" if pairs else "undecided", None, None, 0)
    agreement, chance = total.stayed / total.recurring, total.by_chance / total.recurring
    breaks: tuple[int, ...] = ()
    if total.recurring < _MIN_PAIRS or chance > _MAX_CHANCE:
        ids = "undecided"
    elif not total.agrees():
        ids = "per frame"
    else:
        breaks = tuple(
            pair.frame
            for pair in pairs
            if pair.recurring >= _MIN_PAIRS_OF_FRAME and not pair.agrees()
        )
        ids = "undecided" if breaks else "linked"
    return Identity(ids, agreement, chance, total.recurring, breaks)
