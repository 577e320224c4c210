"""The example study: its files fit together, and what was planted is what they say."""

import importlib.util
import sys
import tomllib
from fnmatch import fnmatch
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from cellquant.compare.ranking import units_of_file
from cellquant.config import ExperimentConfig, SweepConfig, load

FOLDER = Path(__file__).parents[1] / "examples" / "hela_study"


@pytest.fixture(scope="module")
def study() -> ModuleType:
    spec = importlib.util.spec_from_file_location("hela_study", FOLDER / "study.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["hela_study"] = module
    spec.loader.exec_module(module)
    return module


def test_every_movie_belongs_to_one_trial(study: ModuleType, tmp_path: Path) -> None:
    config = load(FOLDER / "experiment.toml", ExperimentConfig)
    assert [len(condition.trial) for condition in config.condition] == [8, 8, 8]
    patterns = [p for c in config.condition for t in c.trial for p in t.stacks]
    movies = study.planned_movies(tmp_path / "movies")
    assert len({movie.path for movie in movies}) == len({movie.seed for movie in movies}) == 72
    for movie in movies:
        name = str(movie.path.relative_to(tmp_path))
        assert sum(fnmatch(name, pattern) for pattern in patterns) == 1, name


def test_what_is_planted(study: ModuleType, tmp_path: Path) -> None:
    movies = study.planned_movies(tmp_path)
    assert movies == study.planned_movies(tmp_path)
    speed = {
        condition: np.mean([m.v0 for m in movies if condition in m.path.parts])
        for condition in study.SPEED
    }
    # The eight trials of a condition differ by 5 %.
    assert speed["low nutrient"] / speed["untreated"] == pytest.approx(0.74, rel=0.06)
    assert speed["Rac1 inhibitor"] / speed["untreated"] == pytest.approx(0.92, rel=0.06)
    assert all(1100 - 125 <= m.density < 2600 + 125 for m in movies)


def test_sweep_and_units_are_valid() -> None:
    sweep = load(FOLDER / "sweep.toml", SweepConfig)
    assert len(sweep.scenes()) == 24
    units = units_of_file(FOLDER / "units.toml")
    assert units.length[0] == 23.9
    with (FOLDER / "experiment.toml").open("rb") as file:
        assert tomllib.load(file)["calibration"]["frame_interval"] == 10
