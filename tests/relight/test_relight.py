"""tools.relight: results and meshes under given lights, from given sides, as stills and videos; and what it refuses."""

import shutil

import av
import numpy as np
import OpenImageIO
import pytest
from shapes import sphere

from shared.geometry.mesh import Mesh
from shared.geometry.transforms import rigid
from shared.io.arrays import load_arrays, save_arrays, write_json
from shared.io.images import read_exr, read_png, write_exr
from shared.io.meshes import save_mesh, write_obj
from shared.rendering.envmap import latlong_directions
from tools.relight.command import main
from tools.relight.inputs import MESH_HEIGHT_MM, open_asset, turned_head

FAST = ("--size", "48", "--directions", "256")


def side_light(towards, height=32):
    """[H, 2 H, 3]: a soft lamp of one colour on a dim sky."""
    lobe = np.exp(8.0 * (latlong_directions(height) @ np.array(towards, float) - 1.0))
    return (0.05 + 3.0 * lobe[..., None] * [1.0, 0.8, 0.6]).astype(np.float32)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """An export/ folder of a grey ball in three poses."""
    folder = tmp_path_factory.mktemp("relight") / "export"
    (folder / "maps").mkdir(parents=True)
    ball = sphere(90.0, 3)
    write_obj(folder / "mesh.obj", ball)
    full = np.ones((8, 8), np.float32)
    write_exr(
        folder / "maps" / "diffuse_albedo.exr", 0.5 * np.ones((8, 8, 3), np.float32), colour_space="lin_rec709_scene"
    )
    for name, value in (("specular_intensity", 0.0), ("roughness", 0.5)):
        write_exr(folder / "maps" / f"{name}.exr", value * full, colour_space="data")
    write_exr(folder / "envmap.exr", side_light([0, 0, 1.0]), colour_space="lin_rec709_scene", latlong=True)
    poses = rigid(
        np.tile(np.diag([1.0, -1, -1]), (3, 1, 1)), np.array([[0, 0, 800.0], [50.0, 0, 800], [0, 50.0, 900]])
    )
    lens = np.array([[400.0, 0, 80], [0, 400.0, 60], [0, 0, 1]])
    save_arrays(folder / "poses.npz", camera_from_head=poses, frame_index=np.array([2, 5, 9]), intrinsics=lens)
    write_json(folder / "run.json", {"model": {"moves": "head"}})
    return folder


def run(capsys, *arguments):
    """(exit code, lines of stdout, stderr)."""
    code = main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return code, out.split(), err


def halves(picture):
    """Mean brightness of the picture's left and right half."""
    middle = picture.shape[1] // 2
    return picture[:, :middle].mean(), picture[:, middle:].mean()


def test_a_lamp_on_the_right_lights_the_right(result, tmp_path, capsys):
    write_exr(tmp_path / "right.exr", side_light([1.0, 0, 0]), colour_space="lin_rec709_scene", latlong=True)
    code, files, _ = run(
        capsys, result, "--light", tmp_path / "right.exr", "--out", tmp_path / "o", "--format", "exr", *FAST
    )
    assert code == 0 and files == [str(tmp_path / "o" / "right_yaw+0_pitch+0.exr")]
    left, right = halves(read_exr(files[0]))
    assert right > 3.0 * left
    turned = ("--light-yaw", "-180", "--format", "exr", *FAST)
    _, files, _ = run(capsys, result, "--light", tmp_path / "right.exr", "--out", tmp_path / "p", *turned)
    left, right = halves(read_exr(files[0]))
    assert left > 3.0 * right


def test_hdr_files_are_read(result, tmp_path, capsys):
    """Radiance RGBE holds the same light to its eight bits."""
    light = side_light([0.6, 0.0, 0.8])
    path = tmp_path / "lamp.hdr"
    target = OpenImageIO.ImageOutput.create(str(path))
    target.open(str(path), OpenImageIO.ImageSpec(64, 32, 3, "float"))
    target.write_image(light)
    target.close()
    write_exr(tmp_path / "same.exr", light, colour_space="lin_rec709_scene", latlong=True)
    lights = (tmp_path / "lamp.hdr", tmp_path / "same.exr")
    code, files, _ = run(capsys, result, "--light", *lights, "--out", tmp_path, "--format", "exr", *FAST)
    assert code == 0 and len(files) == 2
    np.testing.assert_allclose(read_exr(files[0]), read_exr(files[1]), rtol=0.02, atol=1e-3)


def test_frames_of_the_clip_are_seen_through_its_lens(result, tmp_path, capsys):
    """Frame 5 stands 50 mm to the right: 25 px of 160, in half the size 12.5 of 80."""
    arguments = ("--light", "overcast", "--frames", "2,5", "--out", tmp_path, "--format", "exr", "--size", "60")
    code, files, _ = run(capsys, result, *arguments, "--directions", "256")
    assert code == 0 and [path[-10:] for path in files] == ["000002.exr", "000005.exr"]
    first, second = (read_exr(path).mean(-1) for path in files)
    assert first.shape == (60, 80)
    centres = [(image.sum(0) * (np.arange(80) + 0.5)).sum() / image.sum() for image in (first, second)]
    assert centres[0] == pytest.approx(40.0, abs=0.5) and centres[1] == pytest.approx(52.5, abs=1.0)


def test_a_background_fills_what_the_head_leaves(result, tmp_path, capsys):
    arguments = ("--light", "clip", "--out", tmp_path, "--format", "exr", *FAST)
    colour = read_exr(run(capsys, result, *arguments, "--background", "0.1,0.2,0.3")[1][0])
    assert np.allclose(colour[0, 0], [0.1, 0.2, 0.3], atol=1e-3)
    room = read_exr(run(capsys, result, *arguments, "--background", "environment")[1][0])
    assert np.allclose(room[20:28, 20:28], colour[20:28, 20:28], rtol=1e-3)
    expected = side_light([0, 0, 1.0])[16, 0]  # behind the head: straight ahead of the camera
    assert np.allclose(room[24, 0], expected, atol=0.02)


def test_what_turns_makes_a_difference(tmp_path, capsys):
    """A ball with a nose on the picture's right: the head turns it to the front, a camera walks round to it."""
    ball = sphere(90.0, 4)
    bump = 40.0 * np.exp(-np.square(ball.vertices / 90.0 - [1.0, 0, 0]).sum(1) / 0.05)
    save_mesh(tmp_path / "nose.npz", ball.replace(vertices=ball.vertices + bump[:, None] * [1.0, 0, 0]))

    def outline(*arguments):
        options = ("--light", "overcast", "--out", tmp_path, "--format", "exr", "--roughness", "0.6", *FAST)
        return read_exr(run(capsys, tmp_path / "nose.npz", *options, *arguments)[1][0]).mean(-1) > 0.01

    def lopsided(mask):
        return (mask != mask[:, ::-1]).sum()

    front = outline()
    assert lopsided(front) > 100
    assert lopsided(outline("--view=-90,0")) < 20
    assert lopsided(outline("--view", "90,0", "--turn", "camera")) < 20
    assert np.array_equal(outline("--view", "70,0", "--turn", "light"), front)


def test_a_head_turns_about_its_middle():
    mesh = sphere(50.0, 2)
    mesh = mesh.replace(vertices=mesh.vertices + [10.0, 20.0, 30.0])
    start = rigid(np.diag([1.0, -1, -1]), np.array([0.0, 0, 700.0]))
    pose = turned_head(mesh, start, 30.0, 20.0)
    for transform in (start, pose):
        assert np.allclose(transform[:3, :3] @ [10.0, 20.0, 30.0] + transform[:3, 3], [10.0, -20.0, 670.0])
    nose = pose[:3, :3] @ [0, 0, 1.0]
    assert nose[0] == pytest.approx(np.sin(np.radians(30))) and nose[1] < 0 and nose[2] < 0


def test_a_turntable_is_a_video(result, tmp_path, capsys):
    """As many frames as asked, of the pictures' own colours, one file per light and nothing left over."""
    arguments = ("--light", "overcast", "window", "--turntable", "5", "--video", "turn.mp4", "--out", tmp_path / "v")
    code, files, _ = run(capsys, result, *arguments, *FAST)
    assert code == 0 and sorted(p.name for p in (tmp_path / "v").iterdir()) == ["turn_overcast.mp4", "turn_window.mp4"]
    with av.open(files[0]) as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert stream.codec_context.name == "h264" and float(stream.average_rate) == 24.0
    assert len(frames) == 5 and frames[0].shape == (48, 48, 3)
    still = read_png(run(capsys, result, "--light", "overcast", "--out", tmp_path, *FAST)[1][0])
    assert np.abs(frames[0].astype(int) - still)[16:32, 16:32].mean() < 4.0


def test_visibility_is_black_where_nothing_is_open(tmp_path, capsys):
    """A bowl in the ball: V~ is 1 outside, lower inside, and lowest for a mirror that faces the wall."""
    ball = sphere(90.0, 5)
    inwards = np.exp(-np.square(ball.vertices / 90.0 - [0, 0, 1.0]).sum(1) / 0.12)
    write_obj(tmp_path / "bowl.obj", ball.replace(vertices=ball.vertices * (1.0 - 0.8 * inwards)[:, None]))
    options = ("--light", "overcast", "--out", tmp_path, "--visibility", "0.3", "0.9", *FAST)
    code, files, _ = run(capsys, tmp_path / "bowl.obj", *options)
    assert code == 0 and [path.rsplit("_")[-1] for path in files[1:]] == ["0.30.png", "0.90.png"]
    rough = read_png(files[2])
    on_mesh = (rough[..., 0] == rough[..., 2]) & (rough[..., 0] == rough[..., 1])
    assert rough[24, 24, 0] < 200 and rough[24, 9, 0] > 240
    assert 0.3 < on_mesh.mean() < 0.95


def test_meshes_of_any_unit_and_kind_are_taken(tmp_path):
    """Scaled to a head's size, split where sparse; a cube stays a cube."""
    corners = np.array([[x, y, z] for x in (0, 1.0) for y in (0, 1.0) for z in (0, 1.0)])
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = np.array([[q[0], q[k], q[k + 1]] for q in quads for k in (1, 2)], np.int32)
    write_obj(tmp_path / "cube.obj", Mesh(0.001 * corners, faces, np.zeros((1, 2)), np.zeros_like(faces)))
    for name in ("cube.obj", "cube.ply"):
        if name == "cube.ply":
            trimesh = pytest.importorskip("trimesh")
            trimesh.Trimesh(corners, faces).export(tmp_path / name)
        found = open_asset(tmp_path / name, (0.5, 0.5, 0.5), 1.0, 0.3).mesh
        assert np.allclose(np.ptp(found.vertices, axis=0), MESH_HEIGHT_MM) and len(found.vertices) >= 10_000
        assert np.abs(np.abs(found.vertices).max(1) - MESH_HEIGHT_MM / 2).max() < 1e-6


BAD = [
    (["nowhere"], "no such folder or file"),
    (["{result}", "--light", "moon"], "no such light"),
    (["{result}", "--light", "{text}"], "not a readable"),
    (["{result}", "--light", "{square}"], "not a lat-long map"),
    (["{result}", "--frames", "3"], "no pose of this frame"),
    (["{mesh}", "--frames", "3"], "a mesh has no frames"),
    (["{mesh}", "--light", "clip"], "no light of its own"),
    (["{result}", "--frames", "x"], "argument --frames"),
    (["{result}", "--size", "7"], "out of range"),
    (["{result}", "--video", "a.avi"], "not the name of a video"),
    (["{result}", "--turntable", "4", "--frames", "2"], "not allowed with"),
    (["{empty}"], "no result in this folder"),
    (["{text}"], "not a readable mesh"),
    (["{result}", "--visibility", "3"], "out of range"),
]


@pytest.mark.parametrize(("arguments", "fault"), BAD, ids=[fault for _, fault in BAD])
def test_bad_input_is_one_line(result, tmp_path, capsys, arguments, fault):
    """Exit code 2, one line, nothing written."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "light.exr").write_text("no picture")
    write_exr(tmp_path / "square.exr", np.ones((8, 8, 3), np.float32), colour_space="lin_rec709_scene")
    save_mesh(tmp_path / "ball.npz", sphere(1.0, 2))
    (tmp_path / "text.ply").write_text("nothing")
    text = tmp_path / ("light.exr" if "--light" in arguments else "text.ply")
    places = {"result": result, "text": text, "square": tmp_path / "square.exr", "mesh": tmp_path / "ball.npz"}
    filled = [argument.format(**places, empty=tmp_path / "empty") for argument in arguments]
    code, out, err = run(capsys, *filled, "--out", tmp_path / "out")
    assert code == 2 and out == []
    assert fault in err and err.count("\n") == 1 and err.startswith("error: ")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("name", "content", "fault"), [
    ("run.json", "[]", "not a record of a run"),
    ("poses.npz", {"frame_index": np.array(["one", "two", "six"])}, "frame_index is damaged"),
    ("poses.npz", {"camera_from_head": np.eye(4)}, "camera_from_head is damaged"),
    ("poses.npz", {"eye_turn": np.zeros((3, 2, 3, 3))}, "no group of an eye"),
], ids=lambda value: value if isinstance(value, str) else "")
def test_a_damaged_result_is_one_line(result, tmp_path, capsys, name, content, fault):
    export = shutil.copytree(result, tmp_path / "export")
    if isinstance(content, str):
        (export / name).write_text(content)
    else:
        save_arrays(export / name, **{**load_arrays(export / name), **content})
    code, out, err = run(capsys, export, "--out", tmp_path / "out")
    assert (code, out, err.count("\n")) == (2, [], 1) and fault in err


def test_a_mesh_that_is_a_point_is_one_line(tmp_path, capsys):
    corner = np.array([[0, 1, 2]])
    save_arrays(tmp_path / "mesh.npz", vertices=np.ones((3, 3)), faces=corner, uvs=np.zeros((3, 2)), face_uvs=corner)
    code, out, err = run(capsys, tmp_path / "mesh.npz", "--out", tmp_path / "out")
    assert (code, out, err.count("\n")) == (2, [], 1) and "all vertices of the mesh lie in one place" in err
