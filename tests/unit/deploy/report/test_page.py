"""The page: well-formed, complete, escaped, and in need of nothing else."""

from __future__ import annotations

import dataclasses
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from broker_config.errors import StorageError
from deploy.report.command import report
from deploy.report.page import render
from deploy.report.record import RunRecord
from deploy.report.sources import open_source
from tests.unit.deploy.report.conftest import MadeRun

VOID = {"meta", "img", "br", "link", "hr", "input"}
LOADING = {"src", "href", "xlink:href", "srcset", "data", "action", "poster"}
BROWSER = shutil.which("chromium") or shutil.which("google-chrome")


class Page(HTMLParser):
    """Follows the tags of a page, and complains of those that do not match."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.text: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag, f"</{tag}> at {self.getpos()}"

    def handle_data(self, data: str) -> None:
        self.text.append(data)

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.elements if name == tag]


@pytest.fixture(scope="module")
def written(run: MadeRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    report(run.folder.path, path)
    return path


@pytest.fixture(scope="module")
def text(written: Path) -> str:
    return written.read_text()


@pytest.fixture(scope="module")
def page(text: str) -> Page:
    return Page(text)


def test_it_is_well_formed_and_has_every_section(page: Page, text: str) -> None:
    sections = [attributes["id"] for attributes in page.all("section")]
    assert sections == [
        *("learning", "rewards", "episodes", "attention", "time", "processes", "faults"),
        "settings",
    ]
    links = [attributes["href"] for attributes in page.all("a")]
    assert links == [f"#{name}" for name in sections]
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    assert len(text) < 5_000_000


def test_it_loads_nothing(page: Page, text: str) -> None:
    for tag, attributes in page.elements:
        for name in LOADING & attributes.keys():
            assert attributes[name].startswith(("data:", "#")), f"{tag} {name}={attributes[name]}"
    assert not re.findall(r"url\((?!#)", text)
    assert not re.findall(r"https?://|@import|<script|<link|<iframe", text)
    (policy,) = [it["content"] for it in page.all("meta") if "http-equiv" in it]
    assert policy.startswith("default-src 'none'")


def test_whoever_does_not_see_the_figures_is_told(page: Page) -> None:
    assert len(page.all("figure")) == len(page.all("svg")) == 10
    assert all(svg["role"] == "img" and len(svg["aria-label"]) > 20 for svg in page.all("svg"))
    pictures = page.all("img")
    assert len(pictures) > 3 * 10
    assert all(picture["alt"] for picture in pictures)
    inside = {attributes["href"][1:] for attributes in page.all("use")}
    assert inside <= {attributes.get("id") for _, attributes in page.elements}


def test_it_says_what_happened(page: Page, gathered: RunRecord) -> None:
    said = " ".join(" ".join(page.text).split())
    assert f"{gathered.name} complete" in said
    assert "imitation-smoke (derived from table 4.1)" in said
    assert "4 episodes count, each of them once. Further attempts, which did not count: 1." in said
    assert "actor-9 not heard of for 5 s" in said
    assert "the learner started again 1" in said
    assert "live messages not recorded 3" in said
    assert "Grad-CAM of policy version 2 on pictures of episode 4" in said
    assert f"return {gathered.shown['best'].return_:.2f}" in said


def test_names_are_escaped(gathered: RunRecord) -> None:
    evil = "<script>alert('&')</script>"
    preset = dataclasses.replace(gathered.preset, name=evil, source='"><b>')
    wrong = [dataclasses.replace(it, reason=evil) for it in gathered.wrong]
    text = render(dataclasses.replace(gathered, preset=preset, name=evil, wrong=wrong))
    assert "<script" not in text
    assert "<b>" not in text
    page = Page(text)
    assert "".join(page.text).count(evil) >= 4
    assert not [it for it in page.all("section") if it["id"] == "attention"], "there was no policy"


def test_a_run_of_another_kind_has_fewer_sections(gathered: RunRecord) -> None:
    plain = dataclasses.replace(
        gathered,
        rewarded=(),
        iterations=(),
        scores=(),
        recorded=None,
        lives=(),
        wrong=(),
        orders=(),
    )
    page = Page(render(plain))
    assert "rewards" not in {it["id"] for it in page.all("section")}
    said = " ".join(page.text)
    assert "No policy of this run has been evaluated" in said
    assert "No iteration has led to a policy yet" in said


def test_a_run_without_an_episode_says_what_to_do(gathered: RunRecord) -> None:
    none = dataclasses.replace(gathered.episodes, indices=np.zeros(0, np.int64))
    with pytest.raises(StorageError, match="expected a complete episode"):
        render(dataclasses.replace(gathered, episodes=none))


def test_a_recording_alone_is_enough(run: MadeRun, tmp_path: Path) -> None:
    output = tmp_path / "alone.html"
    report(run.folder.recording, output)
    said = " ".join(" ".join(Page(output.read_text()).text).split())
    assert "This is made of a recording alone" in said
    assert "Grad-CAM of policy version 2" in said


def test_a_folder_that_cannot_be_written_is_named(run: MadeRun, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"report .*expected a file that can be written"):
        report(run.folder.path, tmp_path / "file" / "report.html")


def test_a_policy_is_asked_on_pictures_of_the_last_episode(
    run: MadeRun, gathered: RunRecord
) -> None:
    policy = open_source(run.folder.path).newest_policy()
    assert policy is not None
    page = Page(render(gathered, policy))
    attended = [it for it in page.all("img") if "what speaks for action" in it["alt"]]
    pictures = gathered.shown["last"].parts[0].observations
    preferred = policy[1].greedy(pictures[0])
    assert attended[0]["alt"] == f"before step 1: what speaks for action {preferred}, as heat"


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium: deploy/install_system_packages.sh")
@pytest.mark.timeout(240)
def test_a_browser_shows_it_in_light_and_dark(written: Path, tmp_path: Path) -> None:
    brightness = {}
    for name, scheme in {"dark": 0, "light": 1}.items():
        shot = tmp_path / f"{name}.png"
        taken = subprocess.run(
            [
                *(str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic"),
                *("--no-first-run", "--disable-background-networking", "--hide-scrollbars"),
                *("--disable-component-update", "--disable-sync"),
                f"--user-data-dir={tmp_path / 'profile'}",
                f"--blink-settings=preferredColorScheme={scheme}",
                f"--screenshot={shot}",
                "--window-size=1200,3000",
                written.as_uri(),
            ],
            capture_output=True,
            text=True,
            timeout=100,
        )
        picture = cv2.imread(str(shot))
        assert picture is not None, taken.stderr[-2000:]
        assert picture.shape == (3000, 1200, 3)
        brightness[name] = float(np.median(picture))
        # Curves, film strips and headings: far from a blank page.
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 1000
        assert float(picture.std()) > 15
    assert brightness["light"] > 225
    assert brightness["dark"] < 60
