"""The pages in a real browser: silent, offline, complete, readable, printable, accessible."""

import io
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pandas as pd
import pytest

import cellquant as cq
from cellquant.compare.report import experiment_report
from compare_examples import Stack, make_layer

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
axe_core = pytest.importorskip(
    "axe_playwright_python.sync_playwright", reason="axe-playwright-python is not installed"
)

CHROMIUM = os.environ.get("CELLQUANT_CHROMIUM") or next(
    (path for name in ("chromium", "chromium-browser", "google-chrome")
     if (path := shutil.which(name))), None,
)  # fmt: skip
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no chromium on the path; install one or set CELLQUANT_CHROMIUM"
)
FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip
PAGES = ("report", "comparison", "fit")
A4 = {"width": 688, "height": 1001}  # px inside the margins of the printed page


@pytest.fixture(scope="module")
def browser() -> Iterator[object]:
    with playwright.sync_playwright() as engine:
        started = engine.chromium.launch(executable_path=CHROMIUM, headless=True, args=FLAGS)
        yield started
        started.close()


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    movie = make_layer(seed=1, n_frames=8)
    model = make_layer(seed=2, n_frames=8, simulated=True, tau=200.0, shape=3.83)
    experiment_report(
        title="Untreated layer, first recording",
        tracks=movie.tracks,
        observables=movie.result("movie"),
        settings=movie.record,
        out=folder / "report.html",
        stack=Stack(movie.masks, 1.3, 10.0),  # type: ignore[arg-type]
        cells=movie.cells,
    )
    cq.compare(movie.result("untreated"), model.result("model")).to_html(folder / "comparison.html")
    scenes = [
        make_layer(
            seed=i,
            n_frames=3,
            side=5,
            size=80,
            simulated=True,
            tau=90 + 20 * i,
            shape=3.75 + 0.02 * i,
        ).result(f"φ = 0.97, v₀ = {0.01 * (i + 1):g}")
        for i in range(9)
    ]
    for i, scene in enumerate(scenes):
        scene.record["settings"] |= {"scene": {"phi": 0.97, "v0": 0.01 * (i + 1), "eta": 0.01}}
    cq.compare(movie.result("untreated"), *scenes, fit=True).to_html(folder / "fit.html")
    return {name: folder / f"{name}.html" for name in PAGES}


class Visit:
    """An open page, with what it said on the console and what it asked the network for."""

    def __init__(self, browser, path: Path, **options: object) -> None:
        options = {"viewport": {"width": 1280, "height": 900}} | options
        self.context = browser.new_context(offline=True, accept_downloads=True, **options)
        self.page = self.context.new_page()
        self.messages: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda message: self.messages.append(message.text))
        self.page.on("pageerror", lambda error: self.messages.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())

    def __enter__(self) -> "Visit":
        return self

    def __exit__(self, *_: object) -> None:
        self.context.close()


@pytest.fixture(params=PAGES)
def path(request: pytest.FixtureRequest, pages: dict[str, Path]) -> Path:
    return pages[request.param]


def test_loads_in_silence_and_asks_no_network(browser, path: Path) -> None:
    with Visit(browser, path) as visit:
        visit.page.wait_for_timeout(200)
        assert visit.messages == []
        assert {urlsplit(url).scheme for url in visit.requests} <= {"file", "data"}
        assert [url for url in visit.requests if url.startswith("file")] == [path.as_uri()]


def test_a_blocked_request_would_be_noticed(browser, path: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.html"
    text = path.read_text().replace("</main>", '<img src="https://example.org/x.png"></main>')
    broken.write_text(text)
    with Visit(browser, broken) as visit:
        visit.page.wait_for_timeout(200)
        assert any("Content Security Policy" in message for message in visit.messages)


def test_every_drawing_is_visible(browser, path: Path) -> None:
    with Visit(browser, path) as visit:
        picture = decode(visit.page.screenshot(full_page=True))
        boxes = visit.page.evaluate(
            """() => [...document.querySelectorAll('figure .panel > svg')].map(svg => {
                const box = svg.getBoundingClientRect();
                return [box.left, box.top + scrollY, box.width, box.height].map(Math.round);
            })"""
        )
        assert len(boxes) >= 7
        for left, top, width, height in boxes:
            assert width > 200
            assert height > 60
            # Something is drawn: the part of the picture is not one flat colour.
            part = picture[top : top + height, left : left + width].reshape(-1, 3)
            assert len(np.unique(part[::7], axis=0)) > 8


def decode(picture: bytes) -> np.ndarray:
    import cv2

    return cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)


def test_text_in_drawings_does_not_leave_them(browser, path: Path) -> None:
    with Visit(browser, path) as visit:
        outside = visit.page.evaluate(
            """() => [...document.querySelectorAll('figure .panel > svg')].flatMap(svg => {
                const frame = svg.getBoundingClientRect();
                return [...svg.querySelectorAll('text')].filter(t => {
                    const box = t.getBoundingClientRect();
                    return box.left < frame.left - 2 || box.right > frame.right + 2
                        || box.top < frame.top - 2 || box.bottom > frame.bottom + 2;
                }).map(t => t.textContent);
            })"""
        )
        assert outside == []


def test_contents_links_lead_to_their_sections(browser, path: Path) -> None:
    with Visit(browser, path, reduced_motion="reduce") as visit:
        links = visit.page.locator("nav a")
        assert links.count() >= 6
        for index in range(links.count()):
            link = links.nth(index)
            title = link.inner_text()
            link.click()
            target = visit.page.evaluate(
                "document.querySelector(location.hash + ' h2').textContent"
            )
            assert target == title
            top = visit.page.evaluate(
                "document.querySelector(location.hash).getBoundingClientRect().top"
            )
            at_end = visit.page.evaluate(
                "Math.abs(innerHeight + scrollY - document.body.scrollHeight) < 2"
            )
            assert at_end or 0 <= top < 60


def test_downloaded_numbers_are_those_on_the_page(
    browser, pages: dict[str, Path], tmp_path: Path
) -> None:
    movie = make_layer(seed=1, n_frames=8)
    with Visit(browser, pages["report"]) as visit:
        links = visit.page.locator("a.csv")
        assert links.count() >= 8
        for index in range(links.count()):
            with visit.page.expect_download() as download:
                links.nth(index).click()
            name = download.value.suggested_filename
            download.value.save_as(tmp_path / name)
            assert len(pd.read_csv(tmp_path / name)) > 0
    results = pd.read_csv(tmp_path / "results.csv").set_index("quantity")
    assert results.loc["shape_index.mean", "value"] == movie.summary["shape_index"]["mean"]
    curve = pd.read_csv(tmp_path / "self-intermediate-scattering.csv")
    table = movie.tables["self_intermediate_scattering"]
    np.testing.assert_allclose(curve["value"], table["value"], rtol=1e-5)
    paths = pd.read_csv(tmp_path / "trajectories.csv")
    first = paths[(paths["track_id"] == 1) & (paths["frame"] == 0)].iloc[0]
    row = movie.tracks.table.query("track_id == 1 and frame == 0").iloc[0]
    assert first["x"] == pytest.approx(row["x"], rel=1e-5)


def test_saved_drawing_stands_alone(browser, path: Path, tmp_path: Path) -> None:
    with Visit(browser, path) as visit:
        with visit.page.expect_download() as download:
            visit.page.locator("button[data-svg]").last.click()
        download.value.save_as(tmp_path / "figure.svg")
        text = (tmp_path / "figure.svg").read_text()
        assert "var(" not in text
        visit.page.goto((tmp_path / "figure.svg").as_uri())
        assert visit.page.evaluate("document.documentElement.nodeName") == "svg"
        assert visit.messages == []


def test_enlarging_works_with_mouse_and_keyboard(browser, path: Path) -> None:
    with Visit(browser, path) as visit:
        page = visit.page
        page.locator("figure .panel > svg").first.click()
        assert page.locator("dialog[open] svg").count() >= 1
        page.keyboard.press("Escape")
        assert page.locator("dialog[open]").count() == 0
        page.locator("button[data-enlarge]").nth(1).focus()
        page.keyboard.press("Enter")
        box = page.locator("dialog[open] .panel > svg").first.bounding_box()
        assert box is not None
        assert box["height"] <= 900
        page.get_by_role("button", name="Close").press("Enter")
        assert page.locator("dialog[open]").count() == 0
        assert visit.messages == []


def test_stepping_through_frames_by_keyboard(browser, pages: dict[str, Path]) -> None:
    with Visit(browser, pages["report"]) as visit:
        page = visit.page
        figure = page.locator("#segmented-frame")
        slider = figure.get_by_role("slider", name="Step through")
        frames = figure.locator("svg .step")
        assert frames.count() > 2
        shown = figure.locator("svg .step:not([display])")
        first = shown.get_attribute("data-title")
        slider.focus()
        page.keyboard.press("Home")
        assert shown.count() == 1
        assert shown.get_attribute("data-title") == frames.nth(0).get_attribute("data-title")
        page.keyboard.press("End")
        last = frames.nth(frames.count() - 1).get_attribute("data-title")
        assert shown.get_attribute("data-title") == last != first
        assert figure.locator("output").text_content() == last
        assert slider.get_attribute("aria-valuetext") == last
        # The enlarged copy steps by itself.
        figure.get_by_role("button", name="Enlarge").click()
        page.locator("dialog[open]").get_by_role("slider").press("Home")
        assert page.locator("dialog[open] svg .step:not([display])").count() == 1
        assert shown.get_attribute("data-title") == last
        assert visit.messages == []


def test_stepping_through_both_sides_of_a_comparison(browser, pages: dict[str, Path]) -> None:
    with Visit(browser, pages["comparison"]) as visit:
        panels = visit.page.locator("#layer .panel")
        assert panels.count() == 2
        for index in range(2):
            shown = panels.nth(index).locator("svg .step:not([display])")
            title = shown.get_attribute("data-title")
            panels.nth(index).get_by_role("slider").press("Home")
            assert shown.count() == 1
            assert shown.get_attribute("data-title") != title
        assert visit.messages == []


@pytest.mark.parametrize("width", [320, 390, 768])
def test_narrow_screens_do_not_scroll_sideways(browser, path: Path, width: int) -> None:
    with Visit(browser, path, viewport={"width": width, "height": 800}) as visit:
        assert visit.page.evaluate("document.documentElement.scrollWidth") == width
        wide = visit.page.evaluate(
            """width => [...document.querySelectorAll('main *, header *, nav *')]
                .filter(e => !e.closest('svg') && e.getBoundingClientRect().right > width + 1)
                .map(e => e.outerHTML.slice(0, 80))""",
            width,
        )
        assert wide == []


def test_figures_are_not_cut_in_print(browser, path: Path) -> None:
    with Visit(browser, path, viewport=A4, color_scheme="dark") as visit:
        visit.page.emulate_media(media="print")
        figures = visit.page.evaluate(
            """() => [...document.querySelectorAll('figure')].map(f => {
                const box = f.getBoundingClientRect();
                return [f.id, box.height, box.right, getComputedStyle(f).breakInside];
            })"""
        )
        for name, height, right, break_inside in figures:
            assert height < A4["height"], name
            assert right <= A4["width"] + 1, name
            assert break_inside == "avoid", name
        # Paper is white whatever the screen.
        assert visit.page.evaluate(
            "getComputedStyle(document.body).backgroundColor"
        ) == "rgb(255, 255, 255)"  # fmt: skip
        printed = visit.page.pdf(format="A4", print_background=True)
        assert printed.startswith(b"%PDF")
        assert len(re.findall(rb"/Type\s*/Page\b", printed)) >= 3


CONTRAST = """() => {
    const channel = v => (v /= 255) <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
    const luminance = c => {
        const [r, g, b] = c.match(/[\\d.]+/g).map(Number).map(channel);
        return 0.2126 * r + 0.7152 * g + 0.0722 * b;
    };
    const ground = luminance(getComputedStyle(document.body).backgroundColor);
    const ratio = c => {
        const [a, b] = [luminance(c), ground].sort((x, y) => y - x);
        return (a + 0.05) / (b + 0.05);
    };
    // Numbers on the fields of a map choose black or white by their field.
    return [...document.querySelectorAll('.panel:not([data-name^="map-"]) > svg text')]
        .map(t => getComputedStyle(t.querySelector('tspan') ?? t).fill)
        .filter(c => c.startsWith('rgb')).map(ratio).sort((x, y) => x - y)[0];
}"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_readable_in_both_schemes_and_accessible(browser, path: Path, scheme: str) -> None:
    with Visit(browser, path, color_scheme=scheme) as visit:
        assert visit.page.evaluate(CONTRAST) >= 4.5
        # axe needs to run its own script, which the page's policy for strangers forbids.
        findings = axe_core.Axe().run(visit.page).response["violations"]
        serious = [f["id"] for f in findings if f["impact"] in {"serious", "critical"}]
        assert serious == []


def test_page_is_complete_without_scripts(browser, path: Path) -> None:
    with Visit(browser, path, java_script_enabled=False) as visit:
        assert visit.page.locator("figure .panel > svg").first.is_visible()
        assert not visit.page.locator("button[data-enlarge]").first.is_visible()
        href = visit.page.locator("a.csv").first.get_attribute("href")
        assert href.startswith("data:text/csv")


def test_headings_descend_one_level_at_a_time(browser, path: Path) -> None:
    with Visit(browser, path) as visit:
        levels = visit.page.evaluate(
            "[...document.querySelectorAll('h1, main h2, main h3, main h4')]"
            ".map(h => Number(h.nodeName[1]))"
        )
        assert levels[0] == 1
        assert max(np.diff(levels)) <= 1


def test_csv_of_the_verdicts_names_them(browser, pages: dict[str, Path]) -> None:
    with Visit(browser, pages["comparison"]) as visit:
        with visit.page.expect_download() as download:
            visit.page.locator('a[download="verdicts-1.csv"]').click()
        table = pd.read_csv(io.BytesIO(Path(download.value.path()).read_bytes()))
        assert set(table["verdict"]) == {"agree within errors", "differ", "not comparable"}
