"""What the program says while it works."""

import json

import pytest

from cellquant.cli import console


class Clock:
    now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(console, "time", clock)
    return clock


def work(clock: Clock) -> None:
    """40 t0 of 400 were done before; 90 more take 60 s."""
    with console.step("simulate", unit="t0") as move:
        move(40, 400)
        for done in (70, 100, 130):
            clock.now += 20.0
            move(done, 400)


def test_lines_tell_speed_and_time_left(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    work(clock)
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "simulate: 100 of 400 t0 after 40 s, 1.5 t0/s, about 3 min left",
        "simulate: 60.0 s, 400 t0",
    ]


def test_json_tells_speed_and_time_left(
    clock: Clock, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console, "_chosen", console.Progress.json)
    work(clock)
    events = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [event["event"] for event in events] == ["start", *["progress"] * 4, "end"]
    assert events[1] == {
        "event": "progress", "step": "simulate", "unit": "t0", "done": 40, "total": 400,
        "elapsed_s": 0.0, "left_s": None, "per_s": None,
    }  # fmt: skip
    assert events[4]["left_s"] == pytest.approx(180.0)
    assert events[4]["per_s"] == pytest.approx(1.5)
