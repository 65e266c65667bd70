"""Close-ups of the eyes: where they are cut from, from which frames, and how the page shows them."""

import base64
import json
import re

import numpy as np
import pytest
from browser import DESKTOP, PHONE, needs_browser, visit
from shapes import LENS, nods
from toy_result import FRAMES, ToyJob, toy_eyed_surface, toy_gaze, write_toy_work

from shared.geometry.eyeballs import eyeballs_of
from shared.imaging.color import decode_srgb
from shared.report.eye_pictures import CLOSE_UP_PIXELS, close_up, close_up_frames, eye_rectangle
from shared.report.viewer import packed
from stages import export_usd

EYES = eyeballs_of(toy_eyed_surface())
SIZE = (160, 120)
LIMIT_BYTES = 6 * 2**20


def test_both_eyes_fill_the_close_up():
    """Seen from the front: the eyes' middle is the rectangle's, and its width 1.9 times their distance."""
    (pose,) = nods([0.0], distance=900.0)
    left, top, right, bottom = eye_rectangle(EYES, pose, LENS, SIZE)
    apart = 62.0 * 300.0 / (900.0 - 78.0)
    assert (left + right) / 2 == pytest.approx(80.0, abs=1.0)
    assert (top + bottom) / 2 == pytest.approx(60.0 - 20.0 * 300.0 / 822.0, abs=1.0)
    assert right - left == pytest.approx(1.9 * apart, abs=2.0)
    assert bottom - top == pytest.approx(0.75 * apart, abs=2.0)


def test_a_turned_head_is_seen_at_the_same_scale():
    """The eyes come closer together in the picture, and the close-up stays as wide but for the distance."""
    front, turned = (eye_rectangle(EYES, pose, LENS, SIZE) for pose in nods([0.0, 50.0]))
    assert turned[2] - turned[0] == pytest.approx(front[2] - front[0], rel=0.1)


def test_close_ups_end_at_the_picture():
    lens = LENS + np.array([[0, 0, -75.0], [0, 0, 0], [0, 0, 0]])
    assert eye_rectangle(EYES, nods([0.0])[0], lens, SIZE)[0] == 0
    assert eye_rectangle(EYES, nods([0.0])[0], lens - np.array([[0, 0, 200.0], [0, 0, 0], [0, 0, 0]]), SIZE) is None
    assert eye_rectangle(EYES, nods([0.0], distance=-900.0)[0], LENS, SIZE) is None


def test_frames_from_both_sides_and_the_front():
    poses = nods([-40.0, -20.0, -3.0, 10.0, 30.0, 45.0])
    gaze, frame_index = np.zeros((6, 2, 2)), np.arange(6) * 10
    assert close_up_frames([0, 10, 20, 30, 50, 70], frame_index, poses, gaze) == [0, 20, 50]
    gaze[[0, 5], 1] = np.nan
    assert close_up_frames([0, 10, 20, 30, 50], frame_index, poses, gaze) == [10, 20, 30]
    assert close_up_frames([0, 10, 20, 30, 50], frame_index, poses, gaze + np.nan) == [0, 20, 50]
    assert close_up_frames([20], frame_index, poses, gaze) == [20]
    assert close_up_frames([70], frame_index, poses, gaze) == []


@pytest.mark.parametrize("scale", [1, 20])
def test_close_ups_are_of_one_width(scale):
    """Small ones are enlarged, large ones averaged; a ramp stays one."""
    width, height = 100 * scale, 40 * scale
    codes = np.linspace(0.2, 0.8, width)[None, :, None] * np.ones((height, 1, 3))
    picture = np.pad(decode_srgb(codes), ((7, 0), (5, 0), (0, 0)))
    found = close_up(picture, (5, 7, 5 + width, 7 + height))
    assert found.shape == (224, CLOSE_UP_PIXELS, 3)
    np.testing.assert_allclose(found[100, [0, 280, 559], 0] / 255.0, [0.2, 0.5, 0.8], atol=0.02)


def test_eyes_are_marked_for_the_view():
    surface = toy_eyed_surface()
    wet = np.zeros(len(surface.mesh.vertices), bool)
    wet[EYES[0].vertices] = True
    normals = np.tile([0.0, 0.0, 1.0], (len(wet), 1))
    data = packed(surface.mesh, normals, wet)
    unpacked = np.frombuffer(base64.b64decode(data["normals"]), np.int8).reshape(-1, 4)
    index = np.frombuffer(base64.b64decode(data["faces"]), "<u4").reshape(-1, 3)
    marked = np.zeros(len(surface.mesh.faces), bool)
    marked[EYES[0].faces] = True
    np.testing.assert_array_equal(unpacked[index][..., 3], np.repeat(np.where(marked, 127, 0)[:, None], 3, axis=1))


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The report of the toy with eyes."""
    base = tmp_path_factory.mktemp("eyes")
    job = ToyJob(write_toy_work(base / "work", eyes=True), base / "export")
    export_usd.run(job)
    return job.out / "report.html"


def test_page_shows_the_eyes(page):
    """Clip and re-render of the frames from the sides and from the front, then each light; the nav leads there."""
    text = page.read_text(encoding="utf-8")
    section = re.search(r'<section id="eyes">(.*?)</section>', text, re.S).group(1)
    titles = re.findall(r"<figcaption><b>(.*?)</b>", section)
    shown = [int(frame) for frame in re.findall(r"<b>Clip</b>, frame (\d+)", section)]
    assert titles == ["Clip", "Re-render"] * len(shown) + ["window", "low sun", "overcast", "two lamps"]
    assert shown and set(shown) <= set(FRAMES[np.isfinite(toy_gaze()).all((1, 2))].tolist())
    assert 'href="#eyes"' in text and len(text.encode()) < LIMIT_BYTES
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S).group(1))
    assert data["viewer"]["mesh"]["count"] == 3 * len(toy_eyed_surface().mesh.faces)


def test_page_without_eyes_says_nothing_of_them(tmp_path):
    job = ToyJob(write_toy_work(tmp_path / "work"), tmp_path / "export", views=False)
    export_usd.run(job)
    text = (job.out / "report.html").read_text(encoding="utf-8")
    assert 'id="eyes"' not in text and 'href="#eyes"' not in text


@needs_browser
@pytest.mark.parametrize("window", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_eyes_stand_side_by_side(page, window):
    """Clip and re-render of a frame are neighbours of one height in either window, and the page does not complain."""
    with visit(page, window) as visited:
        visited.page.wait_for_function("document.getElementById('viewer').dataset.drawn === 'yes'")
        boxes = [image.bounding_box() for image in visited.page.locator("#eyes img").all()[:2]]
        width, inner = visited.page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
        assert visited.problems == [] and width <= inner
    assert boxes[0]["y"] == pytest.approx(boxes[1]["y"]) and boxes[0]["x"] + boxes[0]["width"] <= boxes[1]["x"]
