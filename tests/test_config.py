"""Configuration files: the smallest that must work, the templates, and errors that name the key."""

import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cellquant.config import (
    TEMPLATES,
    ExperimentConfig,
    SceneConfig,
    SweepConfig,
    load,
    validate,
)
from cellquant.errors import InputError

MODELS = {"experiment": ExperimentConfig, "scene": SceneConfig, "sweep": SweepConfig}


@pytest.mark.parametrize("kind", TEMPLATES)
def test_templates_are_valid(kind: str) -> None:
    validate(tomllib.loads(TEMPLATES[kind]), MODELS[kind], where=kind)


@pytest.mark.parametrize("kind", TEMPLATES)
def test_examples_are_the_templates(kind: str) -> None:
    path = Path(__file__).resolve().parents[1] / "examples" / f"{kind}.toml"
    load(path, MODELS[kind])
    assert path.read_text(encoding="utf-8") == TEMPLATES[kind]


def test_grid_times_seeds() -> None:
    sweep = SweepConfig.model_validate(
        {"seeds": [1, 2], "scene": {"cells": 64}, "grid": {"phi": [0.9, 1.0], "v0": [0.01]}}
    )
    assert [(s.phi, s.v0, s.seed, s.cells) for s in sweep.scenes()] == [
        (0.9, 0.01, 1, 64),
        (0.9, 0.01, 2, 64),
        (1.0, 0.01, 1, 64),
        (1.0, 0.01, 2, 64),
    ]


@pytest.mark.parametrize(
    ("kind", "text", "says"),
    [
        ("scene", "phi = 0.97\nv_0 = 0.03", "unknown key 'v_0'"),
        ("scene", "phi = -1", "'phi'"),
        ("scene", "phi = nan", "'phi'"),
        ("scene", "phi = ", "not valid TOML"),
        ("experiment", "[calibration]\npixel_size = 1", "'condition' is missing"),
        (
            "experiment",
            '[[condition]]\nname = "../a"\n[[condition.trial]]\nname="t"\nstacks=["a"]',
            "'condition.0.name'",
        ),
        (
            "experiment",
            '[[condition]]\nname="a"\n[[condition.trial]]\nname="t"\nstacks=["a"]\n'
            '[[condition.trial]]\nname="t"\nstacks=["b"]',
            "more than once",
        ),
        ("sweep", "[scene]\nphi = 1\n[grid]\nphi = [1.0]", "both [scene] and [grid]"),
        ("sweep", "[grid]\nphy = [1.0]", "phy"),
        ("sweep", "seeds = [1, 1]", "more than once"),
    ],
)
def test_a_wrong_file_names_the_key(tmp_path: Path, kind: str, text: str, says: str) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        load(path, MODELS[kind])
    assert says in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value).strip() or "not valid TOML" in str(error.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"absent\.toml does not exist"):
        load(tmp_path / "absent.toml", SceneConfig)


@settings(deadline=None)
@given(st.binary(max_size=300))
def test_any_bytes_give_a_clear_error_or_a_config(content: bytes) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "any.toml"
        path.write_bytes(content)
        for model in MODELS.values():
            try:
                load(path, model)
            except InputError:
                continue
