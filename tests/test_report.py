"""The report: one self-contained page, whatever an earlier stage left behind."""

from __future__ import annotations

import base64
import json
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from globe import globe
from report_inputs import BOX, UP, bare_inputs, full_inputs, manifest, page, pyramid, quality
from rigs import scene_without_points, shell, three_rings

from configs.load import load_config
from configs.params import ReportParams
from stages import artifacts
from stages.artifacts import ImageRecord, ImageSet, Registration, SkippedImage, Unregistered, VertexQuality, write_png
from stages.drawing.overview import overview_svg
from stages.drawing.tone_mapping import on_screen
from stages.engine.stage import StageContext
from stages.engine.workspace import Record
from stages.geometry.normalisation import rotation_onto
from stages.geometry.place import ControlMark, ControlPoint, Place, given_region
from stages.geometry.point_cloud import PointCloud
from stages.geometry.similarity import Similarity
from stages.geometry.up import y_up_rotation
from stages.report import THREE, region_corners
from stages.reporting import view3d
from stages.reporting.curves import line_chart
from stages.reporting.materials import describe_materials, light_picture
from stages.reporting.numbers import describe_history, describe_where, duration
from stages.reporting.photo_table import PhotoResult
from stages.reporting.pictures import draw_stills
from stages.reporting.stereo import describe_stereo
from stages.reporting.view3d import (
    NO_VALUE,
    light_enough,
    pack_dense,
    pack_mesh,
    pack_overlays,
    pack_region,
    pack_scene,
)

ROOT = Path(__file__).parents[1]
MATERIALS = (artifacts.MATERIAL_COLOR, artifacts.ORM, artifacts.KNOWN, artifacts.LIGHT_HDR)


@pytest.fixture
def context(tmp_path) -> StageContext:
    return bare_inputs(tmp_path)


@pytest.fixture
def full(context) -> StageContext:
    return full_inputs(context)


class Links(HTMLParser):
    """Collects what a page refers to, and checks that its tags close."""

    VOID = frozenset({"meta", "img", "br", "input"})

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.links += [value for key, value in attrs if key in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.links += [value for key, value in attrs if key in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def parsed(html: str) -> Links:
    links = Links()
    links.feed(html)
    assert links.open == []
    return links


def test_the_page_says_it_all_and_refers_to_nothing_outside(full):
    html = page(full)
    links = parsed(html).links
    assert len(links) >= 8 + 2 + 1 + 3
    assert all(link.startswith("data:image/") for link in links)
    own = html.replace(THREE.read_text(encoding="utf-8"), "")
    assert len(html) - len(own) > 500_000
    assert not re.search(r"https?://|import\b.*\bfrom\b", own)
    assert "Permission is hereby granted" in own  # three.js travels with its licence
    for text in (
        "only 3 matches",
        "Expected error of the camera centres: 0.05 % of the distance (0.002 m)",
        "2 of 3 photos were placed",
        "1 were held out",
        "b &lt;odd&gt;.png",
        "notes.txt: not an image",
        "1 min 15 s",
        "1.00 GB",
        "faces 1,234",
        "share 0.1235",
        "preview at step 100",
        "&#34;speed&#34;: 3",
        "hineus 0.1.0",
        "75.0 %",
        "Lengths are in metres ± 0.42 %, from 2 markers (8 sides).",
        "The ground (dashed) holds 50 %",
        "has a radius of 1 m, from",
        "from the side</text>",
        "Held-out photos, and the final mesh drawn from there",
        "a.png: photo, then mesh. PSNR",
        "Where to stand for the next photos",
        "From a side that no photo shows",
        'data-state="held" data-name="a.png"',
        "42 % of the photos' pixels, by 400 dense points".replace("'", "&#39;"),
        "stereo explains 42 %",
        '<option value="explained">',
        'data-layer="dense"',
    ):
        assert text in html, text
    assert html.count("<polyline") == 2  # psnr and loss; rgb is never a number, mask never changes


def test_the_overview_shows_each_camera_from_both_sides(full):
    scene = artifacts.SCENE.load(full.inputs["train"])
    corners = region_corners(scene, artifacts.GIVEN_REGION.load(full.inputs["place"]))
    drawing = ET.fromstring(overview_svg(scene, corners))
    views = drawing.findall("{*}svg")
    assert [view.find("{*}text").text for view in views] == ["from above", "from the side"]
    for view, height in zip(views, (0.0, -3.0), strict=True):  # the camera is at z = -3
        camera = view.find("{*}g/{*}circle")
        reach = 1.08 * 3
        assert float(camera.get("cx")) == pytest.approx(180, abs=0.1)
        assert float(camera.get("cy")) == pytest.approx(180 * (1 - height / reach), abs=0.1)
        region = view.find("{*}circle")
        assert float(region.get("r")) == pytest.approx(180 / reach, abs=0.1)
        strokes = "".join(path.get("d") for path in view.findall("{*}path"))
        assert 200 < strokes.count("h1") <= 300
    assert len(views[1].findall("{*}path")) == len(views[0].findall("{*}path")) + 1  # the ground


@pytest.mark.slow
def test_the_size_is_told_in_metres_where_they_are_known(full):
    def sized(units: str) -> StageContext:
        exported = manifest("export", extent=[0.31234, 0.2, 12.0], units=units)
        return replace(full, manifests={**full.manifests, "export": exported})

    assert "0.312 x 0.2 x 12 m" in page(sized("metres"))
    assert "0.312 x" not in page(sized("arbitrary units"))


def test_materials_and_light_are_shown_where_they_were_learned(full):
    folder = full.inputs["materials"]
    write_png(artifacts.MATERIAL_COLOR.load(folder), np.full((16, 16, 3), (200, 40, 10), np.uint8))
    write_png(artifacts.ORM.load(folder), np.full((16, 16, 3), (255, 60, 220), np.uint8))
    material = describe_materials(*(full.read(each) for each in MATERIALS))
    assert [tuple(decoded(shown["image"])[8, 8]) for shown in material["maps"]] == [
        pytest.approx(color, abs=3) for color in ((200, 40, 10), (60, 60, 60), (220, 220, 220))
    ]
    assert material["light"] is None
    write_png(artifacts.KNOWN.load(folder), np.full((16, 16), 128, np.uint8))
    radiance = np.zeros((8, 16, 3), np.float32)
    radiance[:4] = 40.0
    hdr = cv2.imencode(".hdr", radiance)[1].tobytes()
    artifacts.LIGHT_HDR.load(folder).write_bytes(hdr)
    html = page(full)
    parsed(html)
    shown = html[html.index("Materials and light") : html.index("<h2>Where</h2>")]
    assert shown.count("<figure") == 5
    light = decoded(shown.split('src="')[-1].split('"')[0])
    grey = 255 * on_screen(np.full(3, 2 * 0.18))[0]  # half of it is black
    assert light.shape[:2] == (256, 512)
    np.testing.assert_allclose([light[10].mean(), light[-10].mean()], [grey, 0], atol=3)
    artifacts.ORM.load(folder).write_text("not an image")
    artifacts.LIGHT_HDR.load(folder).write_text("not an image")
    assert describe_materials(*(full.read(each) for each in MATERIALS)) is None
    assert light_picture(artifacts.LIGHT_HDR.load(folder)) is None


def decoded(uri: str) -> np.ndarray:
    """[H, W, 3] RGB of a data URI."""
    data = np.frombuffer(base64.b64decode(uri.split(",")[1]), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]


def test_photos_left_out_come_first_and_pictures_are_capped(full):
    html = page(replace(full, params=ReportParams(thumbnails=1)))
    shown = html[html.index('class="thumbs"') :]
    assert shown.count("<figure") == 3
    assert [part.split('"')[0] for part in shown.split('data-state="')[1:]] == ["out", "held", "used"]
    assert shown.split("</figure>")[0].count("<img") == 1
    assert "<img" not in shown.split("</figure>")[1]
    assert "The first 1 have a picture." in html


def test_a_report_from_almost_nothing(context):
    html = page(context)
    parsed(html)
    assert "<h2>The model</h2>" in html
    assert "<h2>Stages</h2>" not in html
    assert "<h2>Photos</h2>" not in html
    assert "<h2>Training</h2>" not in html
    assert "<h2>Where to stand" not in html
    assert "<h2>Held-out photos" not in html
    assert "<h2>Materials and light" not in html
    assert "Run it again" not in html


def test_damaged_inputs_are_left_out(full):
    full = replace(full, manifests={name: full.manifests[name] for name in full.manifests if name != "train"})
    artifacts.Pictures(full.inputs["ingest"]).path("c.png").write_text("not an image")
    artifacts.PROVENANCE.load(full.inputs["bake"]).write_text("not an image")
    html = page(full)
    assert "<td>train</td>" not in html
    assert "<td>sfm</td>" in html
    assert "Where each texel comes from" not in html


def decode(text: str, kind: str, columns: int = 1) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind).reshape(-1, columns)


def test_the_viewer_gets_the_mesh_y_up():
    atlas = pyramid()
    packed = pack_mesh(atlas, np.zeros((16, 16, 3), np.uint8), UP)
    positions = packed["low"] + decode(packed["positions"], "<u2", 3) / 65535 * packed["size"]
    np.testing.assert_allclose(positions, atlas.vertices @ y_up_rotation(UP).T, atol=1e-4)
    assert positions[4].argmax() == 1  # the tip points along +Y
    assert packed["face_bits"] == 16
    np.testing.assert_array_equal(decode(packed["faces"], "<u2", 3), atlas.faces)
    uvs = decode(packed["uvs"], "<u2", 2) / 65535
    np.testing.assert_allclose(uvs[:, 1], 1 - atlas.uvs[:, 1], atol=1e-4)  # images start at the top
    normals = decode(packed["normals"], "i1", 3) / 127
    np.testing.assert_allclose(normals, atlas.normals @ y_up_rotation(UP).T, atol=5e-3)


def test_measures_are_packed_between_their_ends_and_unknown_ones_marked():
    overlays = {overlay["key"]: overlay for overlay in pack_overlays(quality())}
    values = {key: decode(overlay["values"], "u1").ravel().tolist() for key, overlay in overlays.items()}
    assert values["seen"] == [0, 0, 0, 0, round(254 / 8)]
    assert values["density"][:4] == [NO_VALUE] * 4
    assert values["density"][4] == 254  # two texels a pixel, the scale's end
    assert values["ambiguity"] == [NO_VALUE] * 5  # one photo has none to disagree with
    assert values["invented"] == [254, 254, 254, 254, 0]


def caption() -> dict[str, object]:
    return {"name": "a.jpg", "held_out": True, "error": 0.5, "points": 7, "explained": None}


def test_drawn_cameras_look_where_the_photos_look(full):
    scene = artifacts.SCENE.load(full.inputs["train"])
    packed = pack_scene(scene, [caption()], (), pyramid())
    camera = packed["cameras"][0]
    assert camera["name"] == "a.jpg"
    turn = y_up_rotation(UP)
    apex, corners = np.array(camera["apex"]), np.array(camera["corners"]).reshape(4, 3)
    np.testing.assert_allclose(apex, turn @ [0, 0, -3], atol=1e-4)
    ahead = (corners - apex) @ turn  # back in the scene's frame
    np.testing.assert_allclose(ahead[:, 2], ahead[0, 2], atol=1e-4)
    assert ahead[0, 2] > 0.05
    np.testing.assert_allclose(ahead[2, :2], ahead[2, 2] / 3, rtol=1e-3)  # 8 pixels, focal length 24
    ground = np.array(packed["ground"]).reshape(-1, 3)
    np.testing.assert_allclose(ground[:, 1], -0.2, atol=1e-4)


def test_the_view_gets_the_region_in_the_world_and_the_way_from_there(full):
    poses = Similarity(2.0, rotation_onto(np.array([0.0, 0, 1]), np.array([0.6, 0, 0.8])), np.array([3.0, -4, 7]))
    world = Similarity(0.5, rotation_onto(np.array([1.0, 0, 0]), np.array([0, 0.8, -0.6])), np.array([31.0, 2, 5]))
    scene, place = replace(full.read(artifacts.SCENE), poses_from_scene=poses), Place(world, metric=True)
    sphere = pack_region(scene, place, None)
    assert (sphere["form"], sphere["radius"], sphere["units"]) == ("sphere", 1.0, "metres")
    np.testing.assert_allclose(sphere["center"], world.apply(poses.translation))
    np.testing.assert_allclose(np.subtract(sphere["high"], sphere["low"]), 2)
    view_from_world = np.array(sphere["view_from_world"]).reshape(4, 4)
    in_scene = np.array([0.1, -0.2, 0.7])
    np.testing.assert_allclose(
        (view_from_world @ [*world.apply(poses.apply(in_scene)), 1])[:3], y_up_rotation(UP) @ in_scene, atol=1e-9
    )
    box = pack_region(scene, place, given_region("box", BOX.ravel().tolist(), world))
    assert box["form"] == "box"
    np.testing.assert_array_equal([box["low"], box["high"]], BOX)


def test_points_that_a_small_region_leaves_out_are_drawn(full):
    random, scene = np.random.default_rng(1), full.read(artifacts.SCENE)
    points = np.concatenate([random.normal(size=(40, 3)), 20 + random.random((940, 3)), np.full((20, 3), 1e4)])

    def packed_times(count: int) -> dict[str, Any]:
        many = np.tile(points, (count, 1)).astype(np.float32)
        return pack_scene(replace(scene, points=many, point_errors=many[:, 0]), [caption()], (), pyramid())

    packed = packed_times(1)
    drawn = decode(packed["points"]["positions"], "<u2", 3)
    assert (len(drawn), packed["points_each"], packed["points_total"]) == (980, 1, 1000)  # all but the stray ones
    many = packed_times(100)
    assert many["points_each"] == 3
    assert len(decode(many["points"]["positions"], "<u2", 3)) == pytest.approx(98_000 / 3, abs=1)


def test_a_set_without_a_single_dense_point_has_a_report(full):
    artifacts.POINT_CLOUD.save(full.inputs["densify"], PointCloud.empty())
    assert 'data-layer="dense"' not in page(full)


def test_trusted_dense_points_are_packed_with_their_colours(full, monkeypatch):
    scene = replace(full.read(artifacts.SCENE), poses_from_scene=Similarity(2.0, np.eye(3), np.array([3.0, -4, 7])))
    cloud = shell().moved(scene.poses_from_scene)
    packed = pack_dense(cloud, scene)
    trusted = cloud.trust >= 0.5
    assert (packed["shown"], packed["total"]) == (trusted.sum(), 400) == (200, 400)
    positions = packed["low"] + decode(packed["positions"], "<u2", 3) / 65535 * packed["size"]
    expected = shell().points[trusted] @ y_up_rotation(UP).T
    nearest = np.linalg.norm(positions[:, None] - expected, axis=2).argmin(1)  # they are shuffled
    assert len(set(nearest)) == 200
    np.testing.assert_allclose(positions, expected[nearest], atol=1e-4)
    np.testing.assert_array_equal(decode(packed["colors"], "u1", 3), cloud.colors[trusted][nearest])
    monkeypatch.setattr(view3d, "MAX_DENSE", 50)
    monkeypatch.setattr(view3d, "MAX_AROUND", 20)
    assert pack_dense(cloud, scene)["shown"] == 50
    around = pack_dense(shell(radius=1.5).moved(scene.poses_from_scene), scene)
    assert around["shown"] == len(decode(around["positions"], "<u2", 3)) == 20
    assert pack_dense(cloud.chosen(~trusted), scene) is None
    far = Similarity(1.0, np.eye(3), np.array([2 * view3d.POINTS_REACH, 0, 0]))
    assert pack_dense(shell().moved(scene.poses_from_scene.compose(far)), scene) is None


def results(*explained: float | None) -> list[PhotoResult]:
    return [
        PhotoResult(ImageRecord(f"{i}.jpg", f"{i}.jpg", 40, 30, None, "0", 5.0, False, "00"), "", None, i, False, share)
        for i, share in enumerate(explained)
    ]


def test_it_is_said_how_far_stereo_explains_the_photos_and_what_to_do():
    (plain,) = describe_stereo(results(0.5, 0.3, None), {"points": 1234})
    assert plain == "Stereo explains 40 % of the photos' pixels, by 1,234 dense points."
    _, advice = describe_stereo(results(0.05, 0.03), {"points": 9})
    assert advice.startswith("That is little")
    _, blurred = describe_stereo(results(*[0.5] * 8, *[0.0] * 7), {"points": 9})
    assert "next to nothing of 8.jpg, 9.jpg, 10.jpg, 11.jpg, 12.jpg and 2 more" in blurred
    assert len(describe_stereo(results(0.0, 0.0), {"points": 0})) == 2  # not each by its name
    assert describe_stereo(results(None), {"points": 9}) == describe_stereo(results(0.5), {}) == []


def test_a_mesh_too_heavy_for_the_page_is_decimated_with_its_measures(monkeypatch):
    monkeypatch.setattr(view3d, "MAX_FACES", 2000)
    atlas = globe()
    assert len(atlas.faces) > 4000
    high = (atlas.vertices[:, 2] > 0).astype(float)
    ones = np.ones(len(high))
    light, measured = light_enough(atlas, VertexQuality(ones.astype(np.uint16), ones, ones, ones, ones, high))
    assert 1500 < len(light.faces) <= 2000
    assert np.abs(np.linalg.norm(light.vertices, axis=1) - 0.5).max() < 0.02
    clear = np.abs(light.vertices[:, 2]) > 0.05
    np.testing.assert_array_equal(measured.invented[clear], light.vertices[clear, 2] > 0)
    assert light_enough(light, measured) == (light, measured)


def test_it_is_said_where_the_region_grew():
    def said(**train: float) -> str:
        scene = scene_without_points(three_rings())
        return " ".join(describe_where(scene, Place(Similarity.identity()), {"train": train}))

    assert "It grew to 1.44 times its radius in training" in said(region_grown=1.437)
    assert "It grew" not in said(region_grown=1.0)
    assert "It grew" not in said()


class Structure(HTMLParser):
    """The tags of a page with the names of their attributes, and its scripts."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, ...]] = []
        self.scripts: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, *(name for name, _ in attrs)))
        if tag == "script":
            self.scripts.append("")

    def handle_data(self, data):
        if self.cdata_elem == "script":
            self.scripts[-1] += data


def named(full: StageContext, name: str) -> Structure:
    """The structure of a page whose names, sentences, settings and places all hold `name`."""
    photo = f"{name}.png"
    write_png(artifacts.Pictures(full.inputs["ingest"]).path(photo), np.full((30, 40, 3), 120, np.uint8))
    write_png(artifacts.Pictures(full.inputs["undistort"]).path(photo), np.full((16, 16, 3), 77, np.uint8))
    records = [ImageRecord(each, each, 40, 30, None, "0", 5.0, False, "00") for each in (photo, f"out {photo}")]
    skipped = (SkippedImage(photo, name),)
    artifacts.IMAGE_SET.save(full.inputs["ingest"], ImageSet(tuple(records), skipped))
    left_out = (Unregistered(name=f"out {photo}", reason=name),)
    ladder = ({"rung": name, "registered": 1}, {"rung": name, "registered": 1})
    artifacts.REGISTRATION.save(full.inputs["sfm"], Registration(unregistered=left_out, ladder=ladder))
    scene = artifacts.SCENE.load(full.inputs["train"])
    scene = replace(scene, cameras=replace(scene.cameras, names=(photo,)))
    artifacts.SCENE.save(full.inputs["train"], scene)
    artifacts.HELD_OUT.save(full.inputs["train"], [photo])
    point = ControlPoint(name, (0, 0, 0), True, True, None, None, (ControlMark(photo, 2.0, False),))
    place = replace(artifacts.WORLD_PLACE.load(full.inputs["place"]), scale_from=name, control=(point,), crs=name)
    artifacts.WORLD_PLACE.save(full.inputs["place"], place)
    said = {"warnings": [{"sentence": name, "command": name}], "up_from": name, "region_from": name, "text": name}
    manifests = {stage: manifest(stage, **said) for stage in full.manifests}
    manifests = {
        stage: replace(
            each, versions={"hineus": name}, created=name, identity=replace(each.identity, params={name: name})
        )
        for stage, each in manifests.items()
    }
    record = Record(sources={"photos": f"/{name}", "masks": f"/{name}"}, preset=name)
    config = load_config("tiny", sets=["ingest.leave_out=" + json.dumps([name])])
    structure = Structure()
    structure.feed(page(replace(full, manifests=manifests, record=record, config=config)))
    return structure


ODD = (
    "<img src=x onerror=alert(1)>", '"]]><script>alert(1)</script>', "</script><script>alert(1)</script>", "\u2028",
    "' onmouseover='alert(1)' x='", '" onmouseover="alert(1)" x="', "</title></style></pre></svg>", "&lt;img src=x&gt;",
    "{{ 7 * 7 }}{% x %}", "`${alert(1)}`", "\u202egpj.exe", "<!--<script>", "-->",
)  # fmt: skip


@pytest.mark.slow
def test_names_of_all_kinds_stay_text(full):
    name = "".join(ODD)
    plain, odd = named(full, "plain"), named(full, name)
    assert odd.tags == plain.tags
    code = [script for script in odd.scripts if not script.startswith("{")]
    assert code == [script for script in plain.scripts if not script.startswith("{")]
    [data] = [json.loads(script) for script in odd.scripts if script.startswith("{")]
    assert [camera["name"] for camera in data["cameras"]] == [f"{name}.png"]


def test_warnings_of_stages_are_on_top_of_the_page(full):
    sentence, command = "The region's border cuts the <mesh>.", "hineus run --workspace WS --set place.region=auto"
    warned = manifest("cleanup", warnings=[{"sentence": sentence, "command": command}])
    html = page(replace(full, manifests={**full.manifests, "cleanup": warned}))
    assert f"<p>The region&#39;s border cuts the &lt;mesh&gt;.</p><pre>{command}</pre>" in html.split("<h2>")[0]
    assert 'class="warning"' not in page(full)


def test_the_page_says_how_to_run_it_again(full):
    record = Record(sources={"photos": "/my photos", "masks": None}, preset="tiny")
    html = page(replace(full, record=record, config=load_config("tiny", sets=["train.steps=123"])))
    expected = "hineus run '/my photos' --preset tiny --workspace again_hineus --set train.steps=123"
    assert f'<pre id="replay">{expected.replace(chr(39), "&#39;")}</pre>' in html


def test_stills_show_texture_then_shape():
    texture = np.zeros((16, 16, 3), np.uint8)
    texture[:] = (230, 40, 40)
    stills = draw_stills(pyramid(), texture, UP)
    assert len(stills) == 8
    for still in stills[:4]:
        assert ((still == (230, 40, 40)).all(2)).mean() > 0.05
    for still in stills[4:]:
        drawn = still[(still < 250).all(2)]
        assert len(drawn) > 0.05 * still.shape[0] ** 2
        assert np.ptp(drawn.astype(int), axis=1).max() <= 1  # grey


def test_chart_runs_from_corner_to_corner():
    root = ET.fromstring(line_chart([(0, 1.0), (50, 2.0), (100, 3.0)], 420, 180))
    points = [tuple(map(float, p.split(","))) for p in root.find("polyline").get("points").split()]
    assert points[0] == (52, 158)
    assert points[-1] == (412, 8)
    assert points[1] == (232, 83)


def test_chart_of_a_constant_and_of_decades():
    assert "nan" not in line_chart([(0, 1.0), (1, 1.0)])
    assert ">log<" in line_chart([(0, 1.0), (1, 0.001)])
    assert ">log<" not in line_chart([(0, 1.0), (1, -1.0)])


def test_durations_are_readable():
    assert [duration(s) for s in (3.21, 61)] == ["3.2 s", "1 min 01 s"]


def test_what_was_kept_of_an_earlier_result_is_said() -> None:
    sfm = manifest("sfm", known=40, new=7, gone=1, poses_stayed=True, moved_percent=0.019)
    undistort = manifest("undistort", region_kept=True)
    train = manifest("train", kept_of_budget=0.7, steps_in_all=1950)
    (sentence,) = describe_history({"sfm": sfm, "undistort": undistort, "train": train})
    assert sentence == (
        "This result goes on from an earlier one: 40 photos were known, 7 are new, 1 gone; known poses stayed (they "
        "moved by 0.019 % of the distance to what they see); the region stayed; training went on with 70 % of its "
        "budget counted as spent, 1,950 steps in all."
    )
    (alone,) = describe_history({"undistort": undistort, "train": train})
    assert alone.startswith("This result goes on from an earlier one: the region stayed; training went on with 70 %")
    unchanged = manifest("sfm", known=40, new=0, gone=0, poses_stayed=True, moved_percent=0.0)
    assert describe_history({"sfm": unchanged, "undistort": undistort, "train": manifest("train", steps=9)}) == []
