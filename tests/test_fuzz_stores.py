"""Damaged and hostile tables, runs and configuration files; see `test_io_fuzz` for images.

Only `InputError` may come out, in one sentence, within 5 s and a gigabyte. The quick profile runs
with the suite; the slow one is the campaign of 10 000 cases per reader.
"""

import io
import json
import re
import struct
import tempfile
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cellquant.cli.text import run_lines
from cellquant.config import (
    TEMPLATES,
    ExperimentConfig,
    SceneConfig,
    SweepConfig,
    load,
)
from cellquant.errors import InputError
from cellquant.io.runstore import read_arrays
from cellquant.sim import Scene, open_run, simulate
from cellquant.tables import (
    CELL_COLUMNS,
    PHYSICAL,
    TRACK_COLUMNS,
    Cells,
    Tracks,
    read_cells,
    read_table,
    read_tracks,
    write_table,
)
from test_io_fuzz import COMMON, HOSTILE, PARTS, campaign, edited_bytes, only_input_errors

QUICK = 60

# ------------------------------------------------------------------------------------- parquet


@cache
def table(index: int) -> bytes:
    """A small valid parquet file of each kind."""
    rng = np.random.default_rng(index)
    columns = TRACK_COLUMNS if index == 0 else CELL_COLUMNS
    frame = pd.DataFrame({n: rng.integers(0, 9, 40).astype(k) for n, k in columns.items()})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "t.parquet"
        if index == 0:
            Tracks(frame, PHYSICAL, 10.0, 1e4).write(path)
        elif index == 1:
            Cells(frame, PHYSICAL, 0.6, 10.0, (9.0, 9.0), 9, np.full(9, 81.0)).write(path)
        else:
            text = pd.DataFrame({"condition": ["a", "bb", None, "a"] * 10, "x": rng.random(40)})
            write_table(text, path, units=PHYSICAL)
        return path.read_bytes()


@st.composite
def parquets(draw: st.DrawFn) -> bytes:
    """A damaged table; half of the damage is in the footer."""
    content = table(draw(st.integers(0, 2)))
    if draw(st.booleans()):
        return draw(edited_bytes(content))
    start = len(content) - 8 - struct.unpack("<I", content[-8:-4])[0]
    footer = draw(edited_bytes(content[start:-8]))
    return content[:start] + footer + struct.pack("<I", len(footer)) + b"PAR1"


def check_parquet(content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "t.parquet"
        path.write_bytes(content)
        for read in (read_table, read_tracks, read_cells):
            only_input_errors(lambda read=read: read(path))


@settings(max_examples=QUICK, **COMMON)
@given(parquets())
def test_damaged_table(content: bytes) -> None:
    check_parquet(content)


def test_an_empty_table_is_read(tmp_path: Path) -> None:
    empty = pd.DataFrame({"x": np.empty(0), "condition": np.empty(0, str)})
    write_table(empty, tmp_path / "t.parquet", units=PHYSICAL)
    assert list(read_table(tmp_path / "t.parquet")[0].columns) == ["x", "condition"]


def with_rows(rows: int) -> bytes:
    """A valid table whose footer promises `rows` rows, in the file and in its row group."""
    content = table(2)
    start = len(content) - 8 - struct.unpack("<I", content[-8:-4])[0]
    footer = content[start:-8]
    old = b"\x16\x50"  # field of type i64, zigzag of 40
    number, new = rows * 2, b""
    while number >= 0x80:
        new += bytes([number & 0x7F | 0x80])
        number >>= 7
    footer = footer.replace(old, b"\x16" + new + bytes([number]))
    assert footer != content[start:-8]
    return content[:start] + footer + struct.pack("<I", len(footer)) + b"PAR1"


def test_a_table_of_a_million_million_rows_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "t.parquet"
    path.write_bytes(with_rows(10**12))
    with pytest.raises(InputError, match="promises 1000000000000 rows"):
        read_table(path)


@pytest.mark.parametrize("codec", ["zstd", "gzip", "snappy", "none"])
def test_a_page_that_grows_to_gigabytes_is_refused(tmp_path: Path, codec: str) -> None:
    text = pa.table({"text": ["x" * 40_000_000], "n": [1]})
    meta = {b"length_unit": b"um", b"time_unit": b"min", b"cellquant": b"{}"}
    path = tmp_path / "t.parquet"
    pq.write_table(text.replace_schema_metadata(meta), path, compression=codec)
    with pytest.raises(InputError, match="promises 4000"):
        read_table(path)


def test_a_text_that_is_repeated_too_often_is_refused(tmp_path: Path) -> None:
    indices = pa.array(np.zeros(200_000, np.int32))
    column = pa.DictionaryArray.from_arrays(indices, ["x" * 100_000])
    meta = {b"length_unit": b"um", b"time_unit": b"min", b"cellquant": b"{}"}
    path = tmp_path / "t.parquet"
    pq.write_table(pa.table({"text": column}).replace_schema_metadata(meta), path)
    with pytest.raises(InputError, match=r"more than|promises"):
        read_table(path)


# ---------------------------------------------------------------------------------------- zarr


@cache
def run_files() -> dict[str, bytes]:
    """Files of a small valid run, by path."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "r.zarr"
        simulate(Scene(n_cells=4, phi=0.5, modes=3), duration=3.0, output=path)
        files = [p for p in sorted(path.rglob("*")) if p.is_file()]
        return {p.relative_to(path).as_posix(): p.read_bytes() for p in files}


def places(content: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place in a JSON value."""
    inner = (
        content.items()
        if isinstance(content, dict)
        else enumerate(content)
        if isinstance(content, list)
        else ()
    )
    return [path, *(place for key, value in inner for place in places(value, (*path, key)))]


ANY = (
    st.sampled_from(HOSTILE)
    | st.none()
    | st.booleans()
    | st.floats()
    | st.text(max_size=5)
    | st.sampled_from(("float32", "object", "sharding_indexed", "gzip", "blosc", [], {}, [[1]]))
)


@st.composite
def stores(draw: st.DrawFn) -> dict[str, bytes]:
    """A run with a damaged file, a missing file, or a hostile description."""
    files = dict(run_files())
    for _ in range(draw(st.integers(1, 2))):
        kind = draw(st.sampled_from(("value", "value", "bytes", "missing")))
        name = draw(st.sampled_from([n for n in files if kind != "value" or "zarr.json" in n]))
        if kind == "missing":
            del files[name]
            continue
        if kind == "bytes":
            files[name] = draw(edited_bytes(files[name]))
            continue
        try:
            content = json.loads(files[name])
            place = draw(st.sampled_from(places(content)[1:]))
        except (ValueError, IndexError):
            continue
        inner = content
        for key in place[:-1]:
            inner = inner[key]
        inner[place[-1]] = draw(ANY)
        files[name] = json.dumps(content).encode()
    return files


def use(path: Path) -> None:
    run = open_run(path)
    assert len(run.time) == run.n_frames
    run.to_tracks(columns=["x", "y", "track_id", "time"])
    assert run.modes.shape[0] == run.polarity.shape[0] == run.n_frames
    assert run_lines(run)
    assert run.failure is None or isinstance(run.failure, dict)


def check_store(files: dict[str, bytes]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "r.zarr"
        for name, content in files.items():
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (path / name).write_bytes(content)
        only_input_errors(lambda: use(path))
        only_input_errors(lambda: read_arrays(path / "checkpoint.npz"))


@pytest.mark.parametrize(
    ("name", "value"),
    [("save_every", ""), ("save_every", None), ("save_every", 0), ("dt", "x"), ("dt", None),
     ("duration", -1), ("points", True), ("transient", 10**400), ("contact", 3)],
)  # fmt: skip
def test_a_run_with_an_impossible_setting_is_refused(
    tmp_path: Path, name: str, value: object
) -> None:
    for file, content in run_files().items():
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_bytes(content)
    described = json.loads((tmp_path / "zarr.json").read_text())
    described["attributes"]["settings"][name] = value
    (tmp_path / "zarr.json").write_text(json.dumps(described))
    with pytest.raises(InputError, match="is not a readable run"):
        open_run(tmp_path)


@settings(max_examples=QUICK, **COMMON)
@given(stores())
def test_damaged_run(files: dict[str, bytes]) -> None:
    check_store(files)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("time", {"shape": [10**12]}),
        ("position", {"shape": [10**12, 4, 2]}),
        ("radius", {"shape": [10**12]}),
        ("polarity", {"chunk_grid": {"name": "regular",
                                     "configuration": {"chunk_shape": [10**9, 4]}}}),
        ("modes", {"codecs": [{"name": "bytes"}, {"name": "gzip", "configuration": {}}]}),
    ],
)  # fmt: skip
def test_a_run_that_promises_too_much_is_refused(name: str, change: dict[str, Any]) -> None:
    files = dict(run_files())
    content = {**json.loads(files[f"{name}/zarr.json"]), **change}
    files[f"{name}/zarr.json"] = json.dumps(content).encode()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        for file, content in files.items():
            (path / file).parent.mkdir(parents=True, exist_ok=True)
            (path / file).write_bytes(content)
        with pytest.raises(InputError, match=f"{name} promises|compressed|do not belong|instead"):
            open_run(path)


@pytest.mark.parametrize("name", ["radius", "box", "position", "modes"])
def test_a_lost_chunk_is_not_read_as_numbers(name: str, tmp_path: Path) -> None:
    for file, content in run_files().items():
        if not file.startswith(f"{name}/c/"):
            (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / file).write_bytes(content)
    with pytest.raises(InputError, match=f"{name} is incomplete"):
        open_run(tmp_path).to_tracks(columns=["x", "area", "shape_index"])


def test_a_chunk_that_grows_to_gigabytes_is_refused() -> None:
    files = dict(run_files())
    name = next(n for n in files if n.startswith("position/c/"))
    files[name] = b"\x28\xb5\x2f\xfd\xa0" + struct.pack("<I", 2**32 - 1) + b"\0" * 40
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        for file, content in files.items():
            (path / file).parent.mkdir(parents=True, exist_ok=True)
            (path / file).write_bytes(content)
        with pytest.raises(InputError, match=r"promises 4294967295 bytes instead of"):
            open_run(path)


@pytest.mark.parametrize("hostile", ["shape", "object", "compressed", "pickle"])
def test_a_hostile_checkpoint_is_refused(tmp_path: Path, hostile: str) -> None:
    path = tmp_path / "checkpoint.npz"
    member = io.BytesIO()
    if hostile == "object":
        np.save(member, np.array([{}], dtype=object), allow_pickle=True)
    elif hostile == "pickle":
        member.write(b"cos\nsystem\n(S'true'\ntR.")
    else:
        np.save(member, np.zeros(4))
    content = member.getvalue()
    if hostile == "shape":
        content = content.replace(b"(4,), }          ", b"(1000000000000,),}")[: len(content)]
        assert b"1000000000000" in content
    kind = zipfile.ZIP_DEFLATED if hostile == "compressed" else zipfile.ZIP_STORED
    with zipfile.ZipFile(path, "w", kind) as archive:
        archive.writestr("state.npy", content)
    with pytest.raises(InputError, match="is damaged"):
        read_arrays(path)


# ---------------------------------------------------------------------------------------- TOML

MODELS = {"experiment": ExperimentConfig, "scene": SceneConfig, "sweep": SweepConfig}
VALUES = (
    st.sampled_from([str(number) for number in HOSTILE])
    | st.sampled_from(("nan", "inf", "-1", "1e400", "[]", "{}", "[[]]", '""', '"../../x"', "true",
                       '"\\u0000"', '"<script>"', "1979-05-27", "[1, 2, 2]", '["a", 1]', "0.5"))
    | st.integers().map(str)
    | st.floats().map(str)
    | st.lists(st.integers(0, 3), max_size=4).map(str)
)  # fmt: skip


@st.composite
def tomls(draw: st.DrawFn) -> tuple[str, bytes]:
    """A configuration file with hostile values, damaged text, or random bytes."""
    kind = draw(st.sampled_from(sorted(MODELS)))
    text = TEMPLATES[kind].replace("# ", "") if draw(st.booleans()) else TEMPLATES[kind]
    if draw(st.booleans()):
        lines = text.splitlines()
        for _ in range(draw(st.integers(1, 4))):
            place = draw(st.integers(0, len(lines) - 1))
            match = re.match(r"(\w+) = ", lines[place])
            key = match.group(1) if match else draw(st.sampled_from(("phi", "seeds", "name", "x")))
            lines[place] = f"{key} = {draw(VALUES)}"
        return kind, "\n".join(lines).encode()
    return kind, draw(edited_bytes(text.encode()) | st.binary(max_size=200))


def check_toml(case: tuple[str, bytes]) -> None:
    kind, content = case
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file.toml"
        path.write_bytes(content)

        def use() -> None:
            config = load(path, MODELS[kind])
            if isinstance(config, SceneConfig):
                Scene.from_config(config)

        only_input_errors(use)


@settings(max_examples=200, **COMMON)
@given(tomls())
def test_damaged_configuration(case: tuple[str, bytes]) -> None:
    check_toml(case)


def test_a_sweep_without_end_is_refused(tmp_path: Path) -> None:
    names = ("phi", "v0", "eta", "polydispersity", "mu_theta", "mu_ab", "dt")
    text = "[grid]\n" + "".join(f"{name} = {[0.1] * 100}\n" for name in names)
    (tmp_path / "s.toml").write_text(text)
    with pytest.raises(InputError, match="100000000000000 runs"):
        load(tmp_path / "s.toml", SweepConfig)


def test_nested_brackets_do_not_crash_the_reader(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text("a = " + "[" * 100_000)
    with pytest.raises(InputError, match="not valid TOML"):
        load(tmp_path / "s.toml", SceneConfig)


# ----------------------------------------------------------------------------------- campaigns


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize(
    ("cases", "check"),
    [(parquets(), check_parquet), (stores(), check_store), (tomls(), check_toml)],
    ids=["parquet", "zarr", "toml"],
)
def test_campaign(cases: st.SearchStrategy[Any], check: Callable[[Any], None], part: int) -> None:
    campaign(cases, check, part)
