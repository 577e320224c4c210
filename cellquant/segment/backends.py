"""Label masks from raw images: a watershed of our own, and micro-sam in the user's own install."""

import math
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np
import tifffile
from scipy import ndimage as ndi
from skimage.filters import threshold_otsu
from skimage.morphology import h_maxima
from skimage.segmentation import watershed

from cellquant.errors import InputError
from cellquant.storage import atomic_path

if TYPE_CHECKING:
    from cellquant.io import ImageStack

Array = np.ndarray[Any, np.dtype[Any]]
Modality = Literal["auto", "phase_contrast", "fluorescence"]

MICRO_SAM = "micro_sam.automatic_segmentation"
_MAX_LABEL = np.iinfo(np.uint16).max
_STDERR_LINES = 5


def segment_watershed(
    images: "ImageStack",
    output: str | Path,
    *,
    modality: Modality = "auto",
    cell_diameter: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Segment every frame by thresholds and a watershed, and write the masks as a TIFF stack.

    Fluorescence: above the background by four standard deviations of its noise, split at necks,
    each cell cut at 0.4 of its own brightness. Phase contrast: where the local variance is high,
    without the bright halo, split at necks. Labels are per frame.

    Parameters
    ----------
    images
        The recorded movie.
    output
        TIFF file to write, uint16; replaced only when all frames are done.
    modality
        ``"auto"`` takes a movie for fluorescence when its first frame is bright on dark.
    cell_diameter
        Typical diameter of a cell in px; estimated from the first frame when None. Give it for
        crowded or elongated cells, where the estimate is rough.
    progress
        Called with the number of frames done and of all frames.

    Raises
    ------
    InputError
        If an option is wrong, a frame has more than 65535 cells, no diameter can be estimated, or
        the output cannot be written.
    """
    if modality not in ("auto", "phase_contrast", "fluorescence"):
        raise InputError(
            f"modality must be 'auto', 'phase_contrast' or 'fluorescence', got {modality!r}."
        )
    if cell_diameter is not None and not (math.isfinite(cell_diameter) and cell_diameter >= 4):
        raise InputError(
            f"cell_diameter must be at least 4 px, got {cell_diameter}; "
            "leave it out to have it estimated."
        )
    first = images[0]
    if modality == "auto":
        modality = guess_modality(first)
    diameter = cell_diameter or _estimate_diameter(images.name, first, modality)

    def frames() -> Iterator[Array]:
        for index in range(len(images)):
            labels = segment_frame(images[index], modality=modality, cell_diameter=diameter)
            if labels.max() > _MAX_LABEL:
                raise InputError(
                    f"{images.name}, frame {images.frame_numbers[index]}: found {labels.max()} "
                    f"cells, more than {_MAX_LABEL}; give a larger cell_diameter."
                )
            if progress is not None:
                progress(index + 1, len(images))
            yield labels.astype(np.uint16)

    with atomic_path(output) as temporary:
        tifffile.imwrite(
            temporary,
            frames(),
            shape=(len(images), *images.shape),
            dtype=np.uint16,
            bigtiff=2 * len(images) * images.shape[0] * images.shape[1] > 2**31,
            compression="zlib",
            photometric="minisblack",
            metadata={"axes": "TYX"},
            maxworkers=1,
        )


def guess_modality(image: Array) -> Literal["phase_contrast", "fluorescence"]:
    """Tell fluorescence (most of the field near its darkest value) from phase contrast.

    Parameters
    ----------
    image
        (H, W) one frame.
    """
    low, middle, high = np.percentile(image, [1.0, 50.0, 99.5])
    return "fluorescence" if middle - low < 0.15 * (high - low) else "phase_contrast"


def segment_frame(
    image: Array,
    *,
    modality: Literal["phase_contrast", "fluorescence"],
    cell_diameter: float,
) -> np.ndarray[Any, np.dtype[np.int32]]:
    """Segment one frame.

    Parameters
    ----------
    image
        (H, W) raw image.
    modality
        Kind of image.
    cell_diameter
        Typical diameter of a cell, px.

    Returns
    -------
    (H, W) labels from 1 on, one part each; 0 for background.
    """
    pixels = image.astype(np.float32)
    if modality == "fluorescence":
        bright, noise = _above_background(pixels, cell_diameter)
        labels = _split(bright > 4 * noise, cell_diameter, depth=0.03)
        if labels.any():
            labels *= bright > 0.4 * _brightness(bright, labels)
    else:
        labels = _split(_phase_cells(pixels, cell_diameter), cell_diameter, depth=0.05)
    return _tidy(labels, cell_diameter)


def _above_background(pixels: Array, diameter: float) -> tuple[Array, float]:
    """Brightness above the background, and the standard deviation of the background."""
    smooth = _blur(pixels, max(1.0, diameter / 25))
    small = cv2.resize(smooth, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    floor = _blur(cv2.morphologyEx(small, cv2.MORPH_OPEN, _disc(diameter / 4)), diameter / 4)
    rest = smooth - cv2.resize(floor, (pixels.shape[1], pixels.shape[0]))
    level = float(np.median(rest))
    noise = 1.4826 * float(np.median(np.abs(rest - level)))
    return rest - level, max(noise, 1e-6 * float(np.ptp(rest)) + 1e-30)


def _brightness(bright: Array, labels: Array) -> Array:
    """Upper quartile of each cell's brightness, at each pixel; infinite in the background."""
    numbers = np.arange(1, labels.max() + 1)
    upper = ndi.labeled_comprehension(
        bright, labels, numbers, lambda values: np.percentile(values, 75), float, np.inf
    )
    return np.asarray(np.concatenate([[np.inf], upper])[labels])


def _phase_cells(pixels: Array, diameter: float) -> Array:
    """Where phase contrast shows cells: high local variance, without the halo around them."""
    scale = max(1.0, diameter / 80)
    variance = _blur(pixels * pixels, scale) - _blur(pixels, scale) ** 2
    activity = np.log(np.maximum(variance, 1e-6 * float(np.ptp(pixels)) ** 2 + 1e-30))
    quiet = float(np.median(activity))
    otsu = float(threshold_otsu(activity))  # type: ignore[no-untyped-call]
    limit = quiet + 1.1 * (otsu - quiet)
    cells = (activity > limit).astype(np.uint8)
    cells = cv2.morphologyEx(cells, cv2.MORPH_CLOSE, _disc(diameter / 30))
    cells = _fill(cells, 0.1 * diameter**2)
    cells = cv2.erode(cells, _disc(5 * scale))
    # The halo: bright patches above the level of the background, larger than an organelle.
    flat = pixels - _blur(pixels, diameter / 2)
    level = float(np.median(flat))
    outside = np.abs(flat - level)[activity <= limit]
    noise = 1.4826 * float(np.median(outside)) if outside.size else 0.0
    halo = (_blur(flat, 1.0) > level + 10 * noise).astype(np.uint8)
    patches, _ = ndi.label(halo)
    large = np.bincount(patches.ravel()) > 0.06 * diameter**2
    large[0] = False
    cells[large[patches]] = 0
    cells = cv2.morphologyEx(cells, cv2.MORPH_OPEN, _disc(diameter / 14))
    return np.asarray(_fill(cells, 0.02 * diameter**2) > 0)


def _fill(mask: Array, area: float) -> Array:
    """Fill the gaps of a mask that are smaller than an area."""
    gaps, _ = ndi.label(mask == 0)
    small = np.bincount(gaps.ravel()) < area
    small[0] = False
    filled = mask.copy()
    filled[small[gaps]] = 1
    return filled


def _split(mask: Array, diameter: float, *, depth: float) -> Array:
    """Cut a mask at its necks: watershed of the distance to its edge.

    Summits of the smoothed distance count when they rise ``depth`` diameters above the pass to a
    higher one.
    """
    if not mask.any():
        return np.zeros(mask.shape, np.int32)
    distance = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    smooth = _blur(distance, diameter / 12)
    summits = h_maxima(smooth, depth * diameter)  # type: ignore[no-untyped-call]
    seeds, _ = ndi.label(summits)
    regions = watershed(-smooth, seeds, mask=mask)  # type: ignore[no-untyped-call]
    return np.asarray(regions, dtype=np.int32)


def _tidy(labels: Array, diameter: float) -> np.ndarray[Any, np.dtype[np.int32]]:
    """One part per label with a smooth edge and no hole; drops what is too small for a cell."""
    result = np.zeros(labels.shape, np.int32)
    brush = _disc(diameter / 30)
    edge = len(brush)
    number = 0
    for label, box in enumerate(ndi.find_objects(labels), start=1):
        if box is None:
            continue
        inside = np.pad((labels[box] == label).astype(np.uint8), edge, mode="edge")
        inside = cv2.morphologyEx(inside, cv2.MORPH_OPEN, brush)[edge:-edge, edge:-edge]
        parts, n_parts = ndi.label(inside)
        if n_parts == 0:
            continue
        largest = 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
        cell = ndi.binary_fill_holes(parts == largest) & (result[box] == 0)
        if np.count_nonzero(cell) < 0.08 * diameter**2:
            continue
        number += 1
        result[box][cell] = number
    return result


def _estimate_diameter(name: str, image: Array, modality: str) -> float:
    """Diameter of the cells in a frame, px: from the median width of what a rough pass finds."""
    guess: float = max(min(image.shape) / 25.0, 4.0)
    kind: Literal["phase_contrast", "fluorescence"] = (
        "fluorescence" if modality == "fluorescence" else "phase_contrast"
    )
    for _ in range(2):
        labels = segment_frame(image, modality=kind, cell_diameter=guess)
        areas = np.bincount(labels.ravel())[1:]
        if len(areas) == 0:
            raise InputError(
                f"{name}: no cell was found in the first frame to estimate the cell diameter "
                "from; give cell_diameter in px."
            )
        guess = max(math.sqrt(4 / math.pi * float(np.median(areas))), 4.0)
    return guess


def _blur(pixels: Array, sigma: float) -> Array:
    return np.asarray(cv2.GaussianBlur(pixels, (0, 0), sigma))


def _disc(radius: float) -> Array:
    size = 2 * max(1, round(radius)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))


def segment_micro_sam(
    images: str | Path,
    output: str | Path,
    *,
    executable: str = MICRO_SAM,
    model: str = "vit_b_lm",
    timeout: float | None = None,
) -> None:
    """Segment a movie with the micro-sam of the user's own install, run as a program.

    Parameters
    ----------
    images
        The recorded movie, a file that micro-sam can read.
    output
        TIFF file to write; replaced only when micro-sam has finished and its masks are valid.
    executable
        Its automatic segmentation program: a name on the PATH, a path, or a command such as
        ``"conda run -n sam micro_sam.automatic_segmentation"``.
    model
        Name of the micro-sam model.
    timeout
        Seconds after which the program is stopped; None for no limit.

    Raises
    ------
    InputError
        If the program is not found, fails, takes too long, or writes no label masks of the size
        of the movie.
    """
    from cellquant.io import read_images

    images = Path(images)
    movie = read_images(images)
    words = shlex.split(executable)
    program = shutil.which(words[0]) if words else None
    if program is None:
        raise InputError(
            f"micro-sam's program {executable!r} was not found; install micro-sam in an "
            "environment of its own and give the path of its automatic segmentation program."
        )
    with atomic_path(output) as temporary:
        written = temporary.with_suffix(".tif")
        command = [program, *words[1:], "-i", str(images), "-o", str(written), "-m", model]
        command += ["--ndim", "2" if movie.n_frames == 1 else "3"]
        try:
            done = subprocess.run(
                command,
                capture_output=True,
                check=False,
                stdin=subprocess.DEVNULL,
                text=True,
                errors="replace",
                timeout=timeout,
            )
        except subprocess.TimeoutExpired as error:
            raise InputError(
                f"{executable} took longer than {timeout:g} s on {images} and was stopped; "
                "give it more time or a shorter movie."
            ) from error
        except OSError as error:
            raise InputError(
                f"{executable} cannot be run ({error.strerror}); "
                "give the path of micro-sam's automatic segmentation program."
            ) from error
        if done.returncode != 0:
            tail = " / ".join(done.stderr.strip().splitlines()[-_STDERR_LINES:])
            raise InputError(
                f"{executable} ended with exit code {done.returncode} on {images}: "
                f"{tail or 'it printed no reason'}; mend that in the install of micro-sam."
            )
        _check_masks(written, movie, executable)
        if written != temporary:
            written.rename(temporary)


def _check_masks(path: Path, movie: "ImageStack", executable: str) -> None:
    """Refuse a file that is no label masks of the size of the movie."""
    from cellquant.io import read_labels

    if not path.is_file():
        raise InputError(f"{executable} ended without an error but wrote no masks; check its log.")
    try:
        masks = read_labels(path, units="pixel")
        if (masks.n_frames, masks.shape) != (movie.n_frames, movie.shape):
            raise InputError(
                f"they have {masks.n_frames} frames of {masks.shape}, "
                f"the movie has {movie.n_frames} of {movie.shape}"
            )
        if not any(frame.any() for frame in masks):
            raise InputError("they hold no cell")
    except InputError as error:
        reason = str(error).replace(str(path), "the masks")
        raise InputError(
            f"{executable} wrote masks that cannot be used: {reason}; "
            "check its model and options on this movie."
        ) from error
