"""The report in a real browser: headless Chromium, where there is one."""

from __future__ import annotations

import html
import json
import re
import shlex
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chromium import BROWSER, HEADLESS, WEBGL
from relit_workspace import ball
from report_inputs import BOX, bare_inputs, full_inputs, manifest, page

from configs.texts import read_region
from hineus_cli.viewing import serving, watch
from stages import artifacts
from stages.artifacts import write_png
from stages.engine.stage import StageContext
from stages.engine.workspace import Workspace
from stages.files.light_files import write_hdr
from stages.geometry.normalisation import rotation_onto
from stages.geometry.place import GivenRegion, Place, given_region
from stages.geometry.point_cloud import PointCloud
from stages.geometry.similarity import Similarity
from stages.light.environment import directions

pytestmark = [pytest.mark.slow, pytest.mark.skipif(BROWSER is None, reason="needs Chromium")]


@pytest.fixture
def full(tmp_path) -> StageContext:
    return full_inputs(bare_inputs(tmp_path))


def browse(folder: Path, url: str, *options: str, webgl: bool = True) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [
            str(BROWSER), *HEADLESS,
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


LOOK = """<script>
setTimeout(() => {
  document.querySelector('[data-layer="dense"]').click();
  document.getElementById("surface").value = "none";
  document.getElementById("surface").dispatchEvent(new Event("change"));
}, 2000);
</script></body>"""


def test_dense_points_are_drawn_alone_in_their_colours(full):
    normals = np.array([[1.0, 0, 0], [-1, 0, 0]])
    random = np.random.default_rng(0)
    points = np.repeat(normals * 0.4, 20_000, axis=0) + random.uniform(-0.3, 0.3, (40_000, 3))
    colors = np.repeat(np.array([[20, 200, 40], [230, 120, 20]], np.uint8), 20_000, axis=0)
    starts, photos = np.arange(40_001), np.zeros(40_000, np.int32)
    cloud = PointCloud(points, np.repeat(normals, 20_000, 0), colors, np.ones(40_000), starts, photos)
    artifacts.POINT_CLOUD.save(full.inputs["densify"], cloud)
    report = artifacts.PAGE.load(full.out)
    report.write_text(page(full).replace("</body>", LOOK))
    shown = screenshot(full.scratch, report.as_uri())
    for color in ((20, 200, 40), (230, 120, 20)):  # as in the photos: no light falls on them
        assert (np.abs(shown - color).max(2) < 8).sum() > 2000
    red, green, blue = shown.transpose(2, 0, 1)
    assert ((red > 180) & (green < 90) & (blue < 90)).sum() == 0  # the mesh is hidden


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
    assert "held out from training and texture" in html
    states = re.findall(r'<figure [^>]*data-state="(\w+)"[^>]*?( hidden="")?>', html)
    assert [state for state, hidden in states if not hidden] == ["out"]


def test_without_webgl_the_page_says_so_and_keeps_its_pictures(full):
    page(full)
    html = browse(full.scratch, artifacts.PAGE.load(full.out).as_uri(), "--dump-dom", webgl=False).stdout
    assert 'data-viewer="none"' in html
    assert re.search(r'<p class="soft" id="view-missing">', html)
    assert re.search(r'<div id="view" hidden="">', html)
    assert html.count('alt="The model, view ') == 8


def tilted(context: StageContext) -> StageContext:
    """The same capture, far from its poses' origin, in a world that is turned, of another scale, and far away."""
    axes = np.eye(3)
    poses = Similarity(2.3, rotation_onto(axes[2], np.array([0.6, 0, 0.8])), np.array([30.0, -4, 7]))
    world = Similarity(0.031, rotation_onto(axes[0], np.array([0, 0.8, -0.6])), np.array([310.0, 20, -5]))
    scene = artifacts.SCENE.load(context.inputs["train"])
    artifacts.SCENE.save(context.inputs["train"], replace(scene, poses_from_scene=poses))
    artifacts.WORLD_PLACE.save(context.inputs["place"], Place(world, True, "markers", 0.01))
    artifacts.GIVEN_REGION.save(context.inputs["place"], None)
    return context


def after_a_while(script: str) -> str:
    """The end of a page that runs a script once the view is there."""
    return f"<script>setTimeout(() => {{ {script} }}, 2000);</script></body>"


def edited(context: StageContext, script: str = "") -> tuple[GivenRegion, str]:
    """The region that the page's command would give, and what it says of the sparse points, after a script."""
    report = artifacts.PAGE.load(context.out)
    report.write_text(page(context).replace("</body>", after_a_while(script)))
    dom = browse(context.scratch, f"{report.as_uri()}#edit=region", "--dump-dom").stdout
    *words, setting = command_in(dom)
    assert words == ["hineus", "run", "--workspace", "WORKSPACE", "--set"]
    key, _, text = setting.partition("=")
    assert key == "place.region"
    world_from_poses = artifacts.WORLD_PLACE.load(context.inputs["place"]).world_from_poses
    return given_region(*read_region(text), world_from_poses), re.search(r'id="region-count">(.*?)</p>', dom)[1]


def command_in(dom: str) -> list[str]:
    """The words of the page's command, as a shell reads them."""
    return shlex.split(html.unescape(re.search(r'<pre id="region-command">(.*?)</pre>', dom)[1]))


def says(context: StageContext, region: GivenRegion) -> str:
    """What the page should say of the sparse points inside a region."""
    scene = artifacts.SCENE.load(context.inputs["train"])
    points = scene.poses_from_scene.apply(scene.points)
    inside = np.linalg.norm(points - region.center, axis=1) < region.radius
    if region.box is not None:
        world = region.world_from_poses.apply(points)
        inside = ((world > region.box[0]) & (world < region.box[1])).all(1)
    return f"{inside.sum()} of 300 sparse points are inside ({100 * inside.mean():.1f} %)."


def test_commands_beside_warnings_name_the_workspace_that_the_page_lies_in(full):
    warned = manifest("cleanup", warnings=[{"sentence": "Cut.", "command": "hineus run --workspace WORKSPACE --x"}])
    text = page(replace(full, manifests={**full.manifests, "cleanup": warned}))
    report = full.scratch / "my photos" / "report" / "report.html"
    report.parent.mkdir(parents=True)
    report.write_text(text)
    dom = browse(full.scratch, report.as_uri(), "--dump-dom").stdout
    assert f"<pre>hineus run --workspace '{full.scratch}/my photos' --x</pre>" in dom


def test_the_command_of_an_unchanged_region_gives_the_same_sphere(full):
    region, count = edited(tilted(full))
    poses_from_scene = artifacts.SCENE.load(full.inputs["train"]).poses_from_scene
    assert region.box is None
    assert abs(region.radius - poses_from_scene.scale) < 1e-4 * poses_from_scene.scale
    assert np.linalg.norm(region.center - poses_from_scene.translation) < 1e-4 * poses_from_scene.scale
    assert count == says(full, region)


def test_the_command_of_an_unchanged_box_gives_the_same_box(full):
    region, count = edited(full)
    np.testing.assert_allclose(region.box, BOX, atol=1e-5)
    assert count == says(full, region)


def test_the_command_names_the_workspace_from_its_file_and_from_view(full, tmp_path):
    workspace = Workspace.open(tmp_path / "it's one", create=True)
    with workspace.lock():
        workspace.remember({"photos": None}, "cpu", {})
    report = artifacts.PAGE.load(workspace.stage_folder("report"))
    report.parent.mkdir()
    report.write_text(page(full))
    with serving(watch(workspace.root, ())) as url:
        for address in (report.as_uri(), url):
            dom = browse(full.scratch, address, "--dump-dom").stdout
            assert command_in(dom)[:4] == ["hineus", "run", "--workspace", str(workspace.root)]


TYPE = """
  const type = (what, value) => {
    const field = document.querySelector(what);
    field.value = value;
    field.dispatchEvent(new Event(what === "#region-form" ? "change" : "input"));
  };
"""


def test_a_typed_region_is_that_of_the_command(full):
    typed = """type('[data-region="center"][data-axis="1"]', 20.5); type('[data-region="radius"]', 0.05);"""
    region, count = edited(tilted(full), TYPE + typed)
    assert region.radius == pytest.approx(0.05 / 0.031)
    assert region.world_from_poses.apply(region.center)[1] == pytest.approx(20.5)
    assert count == says(full, region)


def test_a_box_comes_to_where_the_sphere_is(full):
    before, _ = edited(tilted(full))
    after, count = edited(full, TYPE + """type("#region-form", "box");""")
    np.testing.assert_allclose(after.center, before.center, atol=1e-4)
    np.testing.assert_allclose(np.ptp(after.box, axis=0), 2 * 2.3 * 0.031, rtol=1e-4)
    assert count == says(full, after)


# Moves over the view until the pointer says that it is on a handle of the region, and drags that one.
DRAG = """
  const canvas = document.getElementById("viewer");
  canvas.setPointerCapture = () => {};
  const box = canvas.getBoundingClientRect();
  const send = (kind, x, y, buttons) =>
    canvas.dispatchEvent(new PointerEvent(kind, { clientX: x, clientY: y, buttons, button: 0, bubbles: true }));
  const handles = [];
  for (let y = box.top; y < box.bottom; y += 7)
    for (let x = box.left; x < box.right; x += 7) {
      send("pointermove", x, y, 0);
      if (canvas.style.cursor === "move") handles.push([x, y]);
    }
  const [x, y] = handles[0];
  send("pointerdown", x, y, 1);
  send("pointermove", x - 3, y - 60, 1);
  send("pointerup", x - 3, y - 60, 0);
"""


def test_a_handle_moves_one_face_of_the_box(full):
    region, count = edited(full, DRAG)
    moved = np.abs(region.box - BOX)
    assert np.count_nonzero(moved > 1e-3) == 1
    assert region.box[1, 2] > BOX[1, 2] + 0.05  # the uppermost handle is that of the upper face
    assert count == says(full, region)


def test_what_lies_outside_the_region_fades(full):
    report = artifacts.PAGE.load(full.out)
    html = page(full)
    pure = []
    for top in ("0.9", "-0.15"):  # above the mesh, and below it
        script = TYPE + f"""type('[data-region="high"][data-axis="2"]', {top});"""
        report.write_text(html.replace("</body>", after_a_while(script)))
        red, green, blue = screenshot(full.scratch, f"{report.as_uri()}#edit=region").transpose(2, 0, 1)
        pure.append(((blue > 180) & (green < 110) & (red < 90)).sum())
    assert pure[0] > 1000
    assert pure[1] < 0.01 * pure[0]


def test_the_live_page_draws_under_its_policy(tmp_path):
    workspace = Workspace.open(tmp_path / "ws", create=True)
    with workspace.lock():
        workspace.remember({"photos": None}, "cpu", {})
        scratch = workspace.begin("train", "print")[1]
        lines = [json.dumps({"step": step, "psnr": 10 + step}) for step in range(4)]
        artifacts.METRICS.load(scratch).write_text("\n".join(lines))
        with serving(watch(workspace.root, ())) as url:
            dom = browse(tmp_path, url, "--dump-dom").stdout  # which asserts that nothing was refused
    assert 'data-live="ready"' in dom
    assert re.search(r"<figure><svg [^>]*>.*<polyline .*</svg><figcaption>psnr: now 13<", dom)


# ---------------------------------------------------------------- in a light
START = np.array([0.53, 0.34, 0.78])  # where the view looks from, see viewer.js
YAW = np.radians(40)


def in_a_light(context: StageContext, lamp: np.ndarray) -> StageContext:
    """A polished metal ball whose learned light comes from one direction of the GLB's frame; world and scene differ."""
    artifacts.ATLAS_MESH.save(context.inputs["atlas"], ball())
    turn = np.array([[np.cos(YAW), -np.sin(YAW), 0], [np.sin(YAW), np.cos(YAW), 0], [0, 0, 1]])
    artifacts.WORLD_PLACE.save(context.inputs["place"], Place(Similarity(2.0, turn, np.array([5.0, 6, 7]))))
    folder = context.inputs["materials"]
    write_png(artifacts.MATERIAL_COLOR.load(folder), np.full((16, 16, 3), 255, np.uint8))
    write_png(artifacts.ORM.load(folder), np.full((16, 16, 3), (255, 60, 255), np.uint8))
    light = np.full((64, 128, 3), 0.02, np.float32)
    light[directions(64) @ lamp > np.cos(np.radians(12))] = 30
    write_hdr(artifacts.LIGHT_HDR.load(folder), light)
    return context


def highlight(picture: np.ndarray) -> np.ndarray:
    """Where the ball of a screenshot is brightest: right and up of its middle, in radii."""
    stage = picture[315:900, 40:860]
    grey = np.ptp(stage, axis=2) < 12
    rows, columns = np.nonzero(grey & (stage.mean(2) < 90))
    dark = np.array([columns.min(), columns.max(), rows.min(), rows.max()])
    middle, radius = np.array([dark[:2].mean(), dark[2:].mean()]), (dark[1] - dark[0]) / 2
    y, x = np.indices(stage.shape[:2])
    inside = np.hypot(x - middle[0], y - middle[1]) < 0.97 * radius
    lit = np.argwhere(inside & (stage.mean(2) > 0.8 * stage.mean(2)[inside].max()))[:, ::-1].mean(0)
    return (lit - middle) / radius * [1, -1]


@pytest.mark.parametrize("turn", [0, 60])
def test_the_learned_light_comes_from_where_it_came_and_turns(tmp_path, turn):
    """The view is not in the GLB's frame: it is turned about the vertical, back by the world's yaw."""
    ahead, lamp = START / np.linalg.norm(START), np.array([0.2, 0.5, 0.84])
    lamp /= np.linalg.norm(lamp)
    context = in_a_light(bare_inputs(tmp_path), lamp)
    page(context)
    url = f"{artifacts.PAGE.load(context.out).as_uri()}#show=learned&turn={turn}"
    found = highlight(screenshot(context.scratch, url, "--window-size=900,1200"))
    # a yaw about the scene's +Z is one about the view's +Y; to greater φ is a negative turn about +Y
    back = -YAW - np.radians(turn)
    cosine, sine = np.cos(back), np.sin(back)
    towards = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]) @ lamp
    right = np.cross([0, 1, 0], ahead)
    right /= np.linalg.norm(right)
    halfway = (towards + ahead) / np.linalg.norm(towards + ahead)
    expected = np.array([halfway @ right, halfway @ np.cross(ahead, right)])
    assert np.linalg.norm(found - expected) < 0.12, (found, expected)


def test_a_light_lights_the_texture_where_no_materials_were_learned(full):
    page(full)
    text = artifacts.PAGE.load(full.out).read_text()
    assert 'value="studio"' in text
    assert 'value="learned"' not in text
    assert 'value="roughness"' not in text
    url = artifacts.PAGE.load(full.out).as_uri()
    plain, lit = (screenshot(full.scratch, f"{url}#show={what}") for what in ("texture", "sun"))
    turned = screenshot(full.scratch, f"{url}#show=sun&turn=180")
    red = (plain[..., 0] > 180) & (plain[..., 1] < 90)
    assert np.abs(lit - plain)[red].mean() > 10
    assert np.abs(lit - turned)[red].mean() > 5
    assert (lit[red][:, 0] > 1.3 * lit[red][:, 2]).mean() > 0.9  # it is still red


def test_the_materials_maps_are_shown_in_grey(tmp_path):
    context = in_a_light(bare_inputs(tmp_path), np.array([0, 1.0, 0]))
    page(context)
    url = artifacts.PAGE.load(context.out).as_uri()
    for what, grey in (("roughness", 60), ("metalness", 255), ("color", 255)):
        shown = screenshot(context.scratch, f"{url}#show={what}", "--window-size=900,1200")
        middle = shown[560:640, 410:490]
        assert np.abs(middle - grey).max() <= 3, what
