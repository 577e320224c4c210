"""Agreement of the watershed backend with the masks that come with the recordings.

    python benchmarks/watershed_score.py [--every 4]

The recordings are found in CELLQUANT_DATA, or in ../shared/data beside the project. A cell is found
when its overlap (intersection over union) with a given one is above one half. Writes
benchmarks/results/watershed_score.json.
"""

import argparse
import json
import os
import tempfile
from pathlib import Path

import numpy as np

from cellquant.io import read_images, read_labels
from cellquant.segment.backends import segment_watershed

HERE = Path(__file__).parent
DATA = Path(os.environ.get("CELLQUANT_DATA", HERE.parents[1] / "shared" / "data"))


class EveryNth:
    """A movie of which only every n-th frame is looked at."""

    def __init__(self, movie, step: int) -> None:
        self.movie = movie
        self.frame_numbers = movie.frame_numbers[::step]
        self.shape, self.name = movie.shape, movie.name
        self.step = step

    def __len__(self) -> int:
        return len(self.frame_numbers)

    def __getitem__(self, index: int) -> np.ndarray:
        return self.movie[index * self.step]


def overlaps(found: np.ndarray, given: np.ndarray) -> tuple[np.ndarray, int, int]:
    """Overlap of each pair above one half, and the numbers of cells found and given."""
    given = np.unique(given, return_inverse=True)[1].reshape(given.shape)
    n_found, n_given = int(found.max()) + 1, int(given.max()) + 1
    both = np.bincount(
        (found.astype(np.int64) * n_given + given).ravel(), minlength=n_found * n_given
    )
    both = both.reshape(n_found, n_given)
    either = both.sum(axis=1)[:, np.newaxis] + both.sum(axis=0) - both
    ratio = (both / either)[1:, 1:]
    return ratio[ratio > 0.5], n_found - 1, n_given - 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--every", type=int, default=4)
    step = parser.parse_args().every
    result = {}
    for name in ("hela_fluorescence", "t98g_phase_contrast"):
        movie = EveryNth(read_images(DATA / name / "images.tif"), step)
        masks = EveryNth(read_labels(DATA / name / "masks.tif", units="pixel"), step)
        with tempfile.TemporaryDirectory() as folder:
            segment_watershed(movie, Path(folder) / "masks.tif")
            made = read_labels(Path(folder) / "masks.tif", units="pixel")
            scores = [overlaps(made[k], masks[k]) for k in range(len(masks))]
        matched = np.concatenate([score[0] for score in scores])
        n_found, n_given = (sum(score[k] for score in scores) for k in (1, 2))
        result[name] = {
            "frames": len(masks),
            "found": n_found,
            "given": n_given,
            "f1": round(2 * len(matched) / (n_found + n_given), 3),
            "precision": round(len(matched) / n_found, 3),
            "recall": round(len(matched) / n_given, 3),
            "mean_overlap": round(float(matched.mean()), 3),
        }
        print(name, result[name])
    (HERE / "results").mkdir(exist_ok=True)
    (HERE / "results" / "watershed_score.json").write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
