"""The report: its mathematics against closed forms, its page against what a browser and a stranger would object to."""

import base64
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from browser import DESKTOP, PHONE, needs_browser, visit
from shapes import sphere
from toy_result import FRAMES, RENDERED, ToyJob, toy_poses, write_toy_work

from shared.geometry.blend_shapes import BlendShape
from shared.geometry.mesh import subdivide, vertex_normals
from shared.geometry.transforms import rigid, rotation_from_vector
from shared.report.advice import advice
from shared.report.charts import line_chart, nice_ticks
from shared.report.content import chosen_frames, excluded_frames, motion, number, warnings_of
from shared.report.page import TURNTABLE, flat
from shared.report.pictures import ERROR_RANGE, error_bytes, grey_bytes, shrunk, srgb_bytes, viridis_bytes
from shared.report.viewer import ACTION_STEP_MM, irradiance_harmonics, packed
from stages import export_usd

NAME = '<script>alert("é")</script> & co'
LIMIT_BYTES = 6 * 2**20


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The report of a toy result whose name tries to break the page."""
    base = tmp_path_factory.mktemp("report")
    job = ToyJob(write_toy_work(base / "work"), base / "export", NAME)
    export_usd.run(job)
    return job.out / "report.html"


class Reader(HTMLParser):
    """Collects attributes that could fetch something and complains about tags that do not match."""

    VOID = {"meta", "img", "input", "link", "br"}

    def __init__(self):
        super().__init__()
        self.open, self.references, self.text, self.ids = [], [], [], []

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.references += [values[key] for key in ("src", "href", "srcset", "action", "data") if key in values]
        self.ids += [values["id"]] if "id" in values else []
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def read(page) -> Reader:
    """The parsed page."""
    reader = Reader()
    reader.feed(page.read_text(encoding="utf-8"))
    assert reader.open == []
    return reader


def test_page_is_well_formed_and_needs_no_network(page):
    reader, text = read(page), page.read_text(encoding="utf-8")
    assert reader.references
    beside = [reference for reference in reader.references if not reference.startswith(("data:", "#"))]
    assert beside == [f"../turntable/{file}" for file in TURNTABLE]
    assert len(set(reader.ids)) == len(reader.ids)
    anchors = [reference[1:] for reference in reader.references if reference.startswith("#")]
    assert set(anchors) <= set(reader.ids)
    assert not re.search(r"https?://|@import|url\(|fetch\(|XMLHttpRequest", text)
    assert "default-src 'none'" in text
    assert len(text.encode()) < LIMIT_BYTES


def test_names_are_text_wherever_they_stand(page):
    text = page.read_text(encoding="utf-8")
    assert NAME not in text and "<sample_frames>" not in text
    shown = "".join(read(page).text)
    assert NAME in shown and "<sample_frames> is a toy" in shown and 'a "clip".mp4' in shown


def test_page_says_what_was_found(page):
    shown = " ".join(" ".join(read(page).text).split())
    for words in ("frames used", "landmarks absent", "blurred", "the focal length is not given", "held out",
                  "cubemap 16", "1.5", "render minus clip", "head.usdz", "png_copies", "roughness 0.3", "low sun",
                  "50\u00b0 to the left", "Models tried", "The colour chart as found",
                  "light, cubemap 16", "specular map, one value"):
        assert words in shown, words


def test_composites_have_a_section(page):
    text = read(page)
    assert "composites" in text.ids and all(f"Frame {frame}" in text.text for frame in RENDERED)


def test_folders_that_the_page_names_are_there(page):
    named = re.findall(r"<code>(\w+)/</code>", page.read_text(encoding="utf-8"))
    assert "layers" in named and "patches" in named and all((page.parent / folder).is_dir() for folder in named)


def test_data_of_the_slider(page):
    text = page.read_text(encoding="utf-8")
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S).group(1))
    assert [frame["label"].split(",")[0] for frame in data["frames"]] == [
        "frame 3", "frame 5", "frame 8", "frame 13"]
    assert [frame["held_out"] for frame in data["frames"]] == [False, True, True, False]
    assert "held out" in data["frames"][1]["label"] and "fitted" in data["frames"][0]["label"]
    assert all(frame["psnr"] > 1.0 for frame in data["frames"])
    assert data["viewer"]["mesh"]["count"] == 3 * len(subdivide(sphere(levels=2)).faces)


@pytest.fixture(scope="module", params=[DESKTOP, PHONE], ids=["desktop", "phone"])
def opened(request, page):
    """A visit to the page, drawn, in a window of either size."""
    with visit(page, request.param) as visited:
        visited.page.wait_for_function("document.getElementById('viewer').dataset.drawn === 'yes'")
        yield visited


def canvas(opened):
    """What the 3D view shows."""
    return opened.page.evaluate("document.getElementById('viewer').toDataURL()")


@needs_browser
def test_page_opens_without_a_complaint_or_a_request(opened, page):
    assert opened.problems == []
    assert {request for request in opened.requests if not request.startswith("data:")} == {page.resolve().as_uri()}
    width, window = opened.page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    assert width <= window
    assert opened.page.evaluate("[...document.querySelectorAll('figure img')].every(image => image.naturalWidth > 0)")


@needs_browser
def test_slider_changes_the_frame(opened):
    shown = "[document.getElementById('frame-label').textContent, document.getElementById('frame-clip').src]"
    label, clip = opened.page.evaluate(shown)
    assert label.startswith("frame 8, 0.32 s, held out")
    half = 0.49 * opened.page.locator("#frame").bounding_box()["width"]
    opened.drag("#frame", half)
    later, other = opened.page.evaluate(shown)
    assert later.startswith("frame 13") and other != clip
    opened.drag("#frame", -2 * half, start=(half, 0.0))
    assert opened.page.evaluate(shown)[0].startswith("frame 3,")


@needs_browser
def test_view_turns_and_its_lamp_moves(opened):
    """Drag turns the head; with the lamp chosen it moves the lamp; each control changes the picture."""
    pictures = [canvas(opened)]
    opened.drag("#viewer", 80, 20)
    pictures.append(canvas(opened))
    opened.page.click("#viewer-moves-lamp")
    opened.drag("#viewer", -120, -30)
    pictures.append(canvas(opened))
    for control, value in (("viewer-clip", 0.2), ("viewer-lamp", 3.0)):
        opened.page.evaluate(f"(e => {{ e.value = {value}; e.dispatchEvent(new Event('input')); }})"
                        f"(document.getElementById('{control}'))")
        pictures.append(canvas(opened))
    opened.page.click("#viewer-plain")
    pictures.append(canvas(opened))
    assert len(set(pictures)) == len(pictures)
    assert opened.problems == []


@needs_browser
def test_maps_enlarge(opened):
    state = "[document.getElementById('zoom').open, document.getElementById('zoom').className]"
    opened.page.click("#maps .zoomable")
    assert opened.page.evaluate(state) == [True, "fit"]
    opened.page.click("#zoom img")
    assert opened.page.evaluate(state) == [True, "close-up"]
    opened.page.click("#zoom button")
    assert opened.page.evaluate(state)[0] is False


@needs_browser
def test_print_leaves_out_what_paper_cannot_do(opened):
    opened.page.emulate_media(media="print")
    hidden = "getComputedStyle(document.querySelector('%s')).display === 'none'"
    try:
        assert all(opened.page.evaluate(hidden % name) for name in ("nav", "#view", ".slider input", ".on-screen"))
        assert not any(opened.page.evaluate(hidden % name) for name in ("#frames", "#maps", "#novel", "#warnings"))
    finally:
        opened.page.emulate_media(media="screen")


def test_error_colours():
    clip = np.full((1, 5, 3), 0.5)
    render = clip + np.array([0.0, -ERROR_RANGE, ERROR_RANGE, 1.0, 0.0])[None, :, None]
    render[0, 4] = 0.0
    clipped = np.array([[False, False, False, True, False]])
    equal, darker, brighter, full, nothing = error_bytes(clip, render, clipped)[0].astype(int)
    assert equal.min() == equal.max() > 240 and (full == equal).all()
    assert darker[2] > darker[0] + 100 and brighter[0] > brighter[2] + 100
    assert len(set(nothing)) == 1 and nothing[0] < 210
    beyond = error_bytes(clip, clip + 10 * ERROR_RANGE, np.zeros((1, 5), bool))[0, 0]
    assert (beyond == brighter).all()


def test_pictures():
    np.testing.assert_array_equal(srgb_bytes(np.array([0.0, 0.2140, 1.0, 7.0])), [0, 127, 255, 255])
    np.testing.assert_array_equal(grey_bytes(np.array([[-1.0, 0.0, 1.0, 2.0, 9.0]]), 0.0, 2.0), [[0, 0, 128, 255, 255]])
    low, high = viridis_bytes(np.array([[0.0, 1.0]]), 0.0, 1.0)[0].astype(int)
    assert low[2] > low[1] and high[1] > high[2] and high.sum() > low.sum() + 200
    assert shrunk(np.zeros((400, 100, 3)), 200).shape == (200, 50, 3)
    assert shrunk(np.zeros((40, 10)), 200).shape == (40, 10)


def test_ticks_are_round_and_inside():
    np.testing.assert_allclose(nice_ticks(0.0, 10.0), [0, 2, 4, 6, 8, 10])
    np.testing.assert_allclose(nice_ticks(-0.013, 0.031), [-0.01, 0.0, 0.01, 0.02, 0.03])


def test_chart_draws_each_curve_and_leaves_gaps():
    curves = {"a<b": [0.0, 1.0, float("nan"), 1.0], "flat": [2.0] * 4}
    chart = line_chart([0, 1, 2, 3], curves, x_label="x", y_label="y")
    paths = re.findall(r'class="curve"[^>]* d="([^"]*)"', chart)
    assert len(paths) == 2
    assert paths[0].count("M") == 2 and paths[0].count("L") == 1
    assert paths[1].count("M") == 1 and paths[1].count("L") == 3
    assert "a&lt;b" in chart and "a<b" not in chart
    assert "nan" not in chart


def test_motion_names_the_turn():
    """A head turned by 20 degrees to the viewer's right and nodding by 10 towards the camera's x axis."""
    yaw, pitch = np.radians(20.0), np.radians(10.0)
    world_from_head = rotation_from_vector([0.0, yaw, 0.0]) @ rotation_from_vector([pitch, 0.0, 0.0])
    camera_from_head = rigid(np.diag([1.0, -1.0, -1.0]) @ world_from_head, [10.0, 20.0, 600.0])[None]
    angles, position = motion(camera_from_head, "head")
    np.testing.assert_allclose(angles[0], [20.0, 10.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(position[0], [10.0, -20.0, -600.0], atol=1e-9)
    angles, position = motion(camera_from_head, "camera")
    np.testing.assert_allclose(position[0], -world_from_head.T @ [10.0, -20.0, -600.0], atol=1e-9)
    assert motion(toy_poses(), "head")[0].shape == (len(FRAMES), 3)


def test_chosen_frames_spread_and_hold_one_out():
    frames = list(range(0, 100, 3))
    chosen = chosen_frames(frames, [51], 5)
    assert len(chosen) == 5 and 51 in chosen and chosen[0] == 0 and chosen[-1] == 99
    assert chosen_frames([4, 2], [], 5) == [2, 4]


def test_gathering_of_warnings_and_left_out_frames(tmp_path):
    work = write_toy_work(tmp_path / "work")
    rows = excluded_frames(work / "sample_frames", work / "track_landmarks")
    assert rows == [(4, "track_landmarks", "landmarks absent"), (6, "sample_frames", "blurred")]
    said_twice = {"warnings": ["the focal length is not given"]}
    assert warnings_of("sample_frames", work / "sample_frames", said_twice) == [
        ("sample_frames", "the focal length is not given")
    ]


@pytest.mark.parametrize(
    ("warning", "words"),
    [
        ("the focal length is a guess: the clip does not determine it; give camera.focal_length_mm", "subject.yaml"),
        ("the tracks ask for a focal length +8 % off the given one (deviation 1.0 %): check", "Correct the lens"),
        ("the view of the head changes by only 3 degrees: depth rests on the head model", "30 degrees"),
        ("the skin around the mouth moves 2.1 times as much as the rest: the expression changes", "closed mouth"),
        ("40 of 150 frames do not fit and were left out", "frames left out"),
        ("13% of the face is overexposed: expose it darker", "darker"),
        ("the clip has no colour: the maps will be grey", "in colour"),
        ("3 faces in the clip: the largest and most lasting one is taken", "wrong person"),
        ("the face is only 74 px high: maps will be coarse (200 px or more are good)", "600 pixels"),
        ("only 12 usable frames: expect less detail (30 or more are good)", "5 to 20 seconds"),
        ("40 of 100 frames dropped: 30 blurred, 10 no face found", "camera file"),
        ("the head reaches beyond the picture's edge in 4 of 48 frames", "room around the head"),
        ("the background's brightness wanders by 5%: lock the exposure and keep the light still", "Lock the exposure"),
        ("frames held out fit worse (0.0337) than fitted ones (0.0194): poses or shape may be off", "Motion"),
        ("the model explains the clip poorly: residual 0.080 of full scale", "error maps"),
        ("the clip determines hardly any of the maps (see the confidence map): its frames", "lamps that stay"),
        ("the colours are HDR (hlg): they are converted to linear light", "contact sheet"),
        ("the colours are Display P3: they are converted to Rec.709", "contact sheet"),
        ("the images' values do not lie between 0 and 1: all are divided by 128", "contact sheet"),
        ("negative values count as zero: 0.3% of the light in the first image", "noise"),
        ("the file holds 2 videos: the largest, 1920 x 1080 px, is taken", "wrong one"),
        ("the images are linear but read as srgb: set colour.transfer to linear", "subject.yaml"),
        ("the video is interlaced: film progressive, or de-interlace it first", "bwdif"),
        ("the video does not say its colour matrix: BT.709 assumed from 1280 x 577 px on", "matrix stated"),
        ("3 numbers are missing in the sequence", "all frames"),
        ("the images' alpha channel is ignored", "opaque"),
        ("3 of 35744 faces have no area", "Clean the mesh"),
        ("the background stands still while the head turns by 60 degrees, so the head moved: set capture.moves to head",
         "Correct capture.moves"),
        ("the colour chart in frame 6 is not used: its grey patches are overexposed: expose darker", "chart.png"),
        ("the grey place at (12, 30) is not used: its red is 3.20 and its blue 0.90 times its green", "nobody walks"),
        ("person masks miss much of the head in 2 of 8 re-rendered frames: the alpha of these is the mesh's alone",
         "plain background"),
        ("3 edges join faces of opposite winding", "Clean the mesh"),
        ("clip sun lies 2.1 px beside the shared mesh: other lens, another expression?", "its own lens"),
    ],
)
def test_every_warning_gets_its_advice(warning, words):
    """The wording of the stages' own warnings."""
    assert words in advice(warning)


def test_unknown_warnings_get_advice_too():
    assert advice("something never heard of").endswith(".")


def test_values_read_well():
    values = (0.0123456, 12, True, None, [1.0, 0.5], "a")
    assert [number(value) for value in values] == ["0.01235", "12", "yes", "-", "1, 0.5", "a"]
    assert flat({"fitted": 1.0, "held_out": {"p_95": 2.0}}) == [("fitted", 1.0), ("held out, p 95", 2.0)]


def test_packed_mesh_unpacks():
    mesh = sphere(80.0, 2)
    data = packed(mesh, vertex_normals(mesh.vertices, mesh.faces))

    def unpack(name, kind, width):
        return np.frombuffer(base64.b64decode(data[name]), kind).reshape(-1, width)

    index = unpack("faces", "<u4", 3)
    assert data["count"] == index.size
    positions = np.array(data["low"]) + np.array(data["size"]) * unpack("positions", "<u2", 4)[:, :3] / 65535
    np.testing.assert_allclose(positions[index], mesh.vertices[mesh.faces], atol=0.002)
    np.testing.assert_allclose(unpack("uvs", "<u2", 2)[index] / 65535, mesh.uvs[mesh.face_uvs], atol=1e-4)
    normals = unpack("normals", np.int8, 4)[index][..., :3] / 127
    np.testing.assert_allclose(normals, mesh.vertices[mesh.faces] / 80.0, atol=0.03)


def test_packed_actions_move_every_corner_of_their_vertices():
    """Those that the page shows, in hundredths of a millimetre; the half-way shape only where there is one."""
    mesh = sphere(80.0, 2)
    moves = np.zeros((2, *mesh.vertices.shape))
    moves[:, 3:30] = np.random.default_rng(1).normal(0.0, 6.0, (2, 27, 3))
    moves[:, 40:50] = 0.02
    shapes = [BlendShape.of("jawOpen", moves[0], 0.0), BlendShape.of("tongueOut", moves[0], 0.0),
              BlendShape.of("eyeBlinkLeft", moves[0], 0.0, ((0.5, moves[1]),))]
    data = packed(mesh, vertex_normals(mesh.vertices, mesh.faces), actions=shapes)
    jaw, blink = data["actions"]
    assert (jaw["name"], blink["name"], jaw["half"]) == ("jawOpen", "eyeBlinkLeft", "")

    def unpack(text, kind, width):
        return np.frombuffer(base64.b64decode(text), kind).reshape(-1, width)

    index = unpack(data["faces"], "<u4", 1)[:, 0]
    for action, key, expected in ((jaw, "offsets", moves[0]), (blink, "offsets", moves[0]), (blink, "half", moves[1])):
        found = np.zeros((index.max() + 1, 3))
        found[unpack(action["vertices"], "<u4", 1)[:, 0]] = ACTION_STEP_MM * unpack(action[key], "<i2", 3)
        expected = np.where(np.arange(len(expected))[:, None] < 40, expected, 0.0)
        np.testing.assert_allclose(found[index], expected[mesh.faces.ravel()], atol=0.5 * ACTION_STEP_MM + 1e-6)


def test_harmonics_give_the_irradiance_of_a_known_sky():
    """L = 1 + d.x / 2 + d.y d.z is of order two, so E / pi = 1 + (2/3) n.x / 2 + (1/4) n.y n.z exactly."""
    height, width = 256, 512
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    x, y = np.sin(2 * np.pi * u) * np.sin(np.pi * v), np.cos(np.pi * v)
    z = -np.cos(2 * np.pi * u) * np.sin(np.pi * v)
    c = irradiance_harmonics(np.repeat((1 + x / 2 + y * z)[..., None], 3, axis=2))[:, 0]
    n = np.random.default_rng(3).normal(size=(20, 3))
    nx, ny, nz = (n / np.linalg.norm(n, axis=1, keepdims=True)).T
    basis = [np.ones(20), ny, nz, nx, nx * ny, ny * nz, 3 * nz**2 - 1, nx * nz, nx**2 - ny**2]
    np.testing.assert_allclose(c @ np.stack(basis), 1 + nx / 3 + ny * nz / 4, atol=1e-3)
