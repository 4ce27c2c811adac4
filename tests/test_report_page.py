"""The report in a real browser: headless Chromium, where there is one."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from report_inputs import bare_inputs, full_inputs, page

from stages import artifacts
from stages.engine.stage import StageContext

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(BROWSER is None, reason="needs Chromium")]
WEBGL = ("--enable-unsafe-swiftshader", "--use-gl=angle", "--use-angle=swiftshader")


@pytest.fixture
def full(tmp_path) -> StageContext:
    return full_inputs(bare_inputs(tmp_path))


def browse(folder: Path, url: str, *options: str, webgl: bool = True) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [
            str(BROWSER), "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--hide-scrollbars",
            f"--user-data-dir={folder / 'profile'}", "--enable-logging=stderr", "--virtual-time-budget=5000",
            *(WEBGL if webgl else ("--disable-gpu", "--disable-3d-apis")), *options, url,
        ],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    errors = [line for line in done.stderr.splitlines() if "CONSOLE" in line and "GPU stall" not in line]
    assert not webgl or not errors, errors
    return done


def screenshot(folder: Path, url: str, *options: str) -> np.ndarray:
    """[H, W, 3] RGB of the page's first screen."""
    import cv2

    path = folder / "page.png"
    done = browse(folder, url, "--window-size=900,900", f"--screenshot={path}", *options)
    assert path.exists(), done.stderr[-2000:]
    return cv2.imread(str(path))[..., ::-1].astype(int)


def test_the_model_is_drawn_and_a_measure_changes_its_colours(full):
    page(full)
    url = artifacts.PAGE.load(full.out).as_uri()
    red, green, blue = screenshot(full.scratch, url).transpose(2, 0, 1)
    assert ((red > 180) & (green < 90) & (blue < 90)).sum() > 2000
    assert ((blue > 180) & (green < 110) & (red < 90)).sum() > 2000
    red, green, blue = screenshot(full.scratch, f"{url}#show=invented").transpose(2, 0, 1)
    assert ((red > 180) & (green < 90) & (blue < 90)).sum() == 0
    assert ((red > 140) & (green > 120) & (blue < 80)).sum() > 500  # yellow: made up
    assert ((red < 80) & (green < 40) & (blue > 40)).sum() > 50  # violet: the tip was seen


PRESS = """<script>
setTimeout(() => {
  document.querySelector('[data-show="camera-0"]').click();
  const kind = document.getElementById("photo-kind");
  kind.value = "out";
  kind.dispatchEvent(new Event("change"));
}, 2000);
</script></body>"""


def test_a_photo_is_shown_in_the_view_and_photos_are_filtered(full):
    report = artifacts.PAGE.load(full.out)
    report.write_text(page(full).replace("</body>", PRESS))
    html = browse(full.scratch, report.as_uri(), "--dump-dom").stdout
    assert 'data-viewer="ready"' in html.split(">")[1]
    options = re.findall(r'<option value="((?:camera|next)-\d+)">', html)
    assert options[0] == "camera-0"
    assert "next-0" in options
    assert re.search(r'<b id="card-name">a\.png</b>', html)
    assert "kept back from training and texture" in html
    states = re.findall(r'<figure [^>]*data-state="(\w+)"[^>]*?( hidden="")?>', html)
    assert [state for state, hidden in states if not hidden] == ["out"]


def test_without_webgl_the_page_says_so_and_keeps_its_pictures(full):
    page(full)
    html = browse(full.scratch, artifacts.PAGE.load(full.out).as_uri(), "--dump-dom", webgl=False).stdout
    assert 'data-viewer="none"' in html
    assert re.search(r'<p class="soft" id="view-missing">', html)
    assert re.search(r'<div id="view" hidden="">', html)
    assert html.count('alt="The model, view ') == 8
