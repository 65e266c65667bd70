"""tools.relight --frames: eyes and lids are in each frame of the clip as that frame had them."""

import numpy as np
import pytest
from shapes import turned
from toy_result import EYE_CENTRES, EYE_RADIUS, toy_eyed_surface, toy_mesh

from shared.geometry.blend_shapes import LID_ACTIONS, LOOK_RAD, BlendShape
from shared.geometry.eyeballs import eyeballs_of, gaze_direction
from shared.io.arrays import save_arrays, write_json
from shared.io.images import read_exr, write_exr
from shared.io.meshes import write_obj
from shared.io.usd import HeadAsset, write_head_usda
from shared.io.usd_capture import UsdCapture
from shared.io.usd_material import SHADER_INPUTS, TextureFile
from tools.relight.command import main
from tools.relight.inputs import open_asset
from tools.relight.options import CLAY

LENS = np.array([[400.0, 0, 80], [0, 400.0, 60], [0, 0, 1]])
SIZE, DISTANCE_MM = 240, 600.0
FRAMES = ASIDE, OTHER, SHUT, UP, DOWN, LOWERED, RIGHT_SHUT = 2, 5, 6, 7, 9, 10, 12
GAZE = np.array([[0.3, 0.0], [-0.3, 0.0], [np.nan, np.nan], [0.0, 0.3], [0.0, -LOOK_RAD],
                 [0.0, -LOOK_RAD / 3], [0.0, 0.0]])
"""[F, 2] of both eyes alike: yaw and pitch in radians. Lids are at rest at the middle of the pitches, 0."""
CLOSED = np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [1.0, 0.0]])


def lid_actions(vertices: np.ndarray) -> list[BlendShape]:
    """Blinks and looks down push the skin about an eye out so far that it hides it, looks up nothing."""
    found = []
    for name in LID_ACTIONS:
        centre = EYE_CENTRES[0 if name.endswith("Right") else 1]
        near = np.linalg.norm(vertices[:, :2] - centre[:2], axis=1) < 26.0
        near &= np.arange(len(vertices)) < len(toy_mesh().vertices)
        near &= (vertices[:, 2] > 0.0) & ("Up" not in name)
        moves = np.zeros_like(vertices)
        moves[near] = [0.0, 0.0, 14.0]
        found.append(BlendShape.of(name, moves, 0.0))
    return found


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """An export/ of a grey egg with red eyes and a blue disc straight ahead on each."""
    folder = tmp_path_factory.mktemp("relight_eyes") / "export"
    (folder / "maps").mkdir(parents=True)
    surface = toy_eyed_surface()
    balls, poses = eyeballs_of(surface), turned(np.zeros((len(FRAMES), 3)), (0.0, 0.0, DISTANCE_MM))
    v, u = np.meshgrid(1.0 - (np.arange(256) + 0.5) / 256, (np.arange(256) + 0.5) / 256, indexing="ij")
    albedo = np.where((u < 0.5)[..., None], 0.5, [0.6, 0.02, 0.02])
    for left in (0.5, 0.75):  # the atlas of a ball: longitude and height over a quarter of the map
        albedo[np.hypot((u - left) * 4 * 2 * np.pi - np.pi, v * 4 * 2 - 1.0) < 0.4] = [0.02, 0.02, 0.6]
    full = np.ones((256, 256), np.float32)
    maps = {"diffuse_albedo": albedo.astype(np.float32), "specular_intensity": 0.0 * full, "roughness": 0.5 * full}
    for name, values in maps.items():
        write_exr(folder / "maps" / f"{name}.exr", values,
                  colour_space="lin_rec709_scene" if name == "diffuse_albedo" else "data")
    write_exr(folder / "envmap.exr", np.ones((16, 32, 3), np.float32), colour_space="lin_rec709_scene", latlong=True)
    gaze = np.repeat(GAZE[:, None], 2, axis=1)
    save_arrays(folder / "poses.npz", camera_from_head=poses, frame_index=np.array(FRAMES), intrinsics=LENS,
                gaze=gaze, eye_turn=gaze, lids=CLOSED)
    write_json(folder / "run.json", {"model": {"moves": "head"}})
    write_obj(folder / "mesh.obj", surface.mesh, balls)
    capture = UsdCapture(poses, np.array(FRAMES), 25.0, LENS, 160, 120, "head", eye_turn=gaze)
    textures = {name: TextureFile(f"./maps/{name}.exr") for name in SHADER_INPUTS}
    write_head_usda(folder, HeadAsset("toy", surface.mesh, textures, TextureFile("./envmap.exr"), capture, eyes=balls,
                                      actions=lid_actions(surface.mesh.vertices)))
    return folder


@pytest.fixture(scope="module")
def seen(result, tmp_path_factory):
    """{frame: (pixels of both eyeballs [2, h, w] bool, of which the discs [2, h, w] bool)}, the right eye first."""
    out = tmp_path_factory.mktemp("relit")
    arguments = [result, "--light", "clip", "--frames", ",".join(map(str, FRAMES)), "--out", out, "--format", "exr",
                 "--size", SIZE, "--directions", 256]
    assert main([str(argument) for argument in arguments]) == 0
    found = {}
    for frame in FRAMES:
        red, green, blue = np.moveaxis(read_exr(out / f"clip_frame{frame:06d}.exr"), -1, 0)
        sides = np.arange(red.shape[1]) < red.shape[1] / 2
        sides = np.stack([sides, ~sides])[:, None]
        found[frame] = sides & (np.maximum(red, blue) > 2.0 * green), sides & (blue > 2.0 * np.maximum(red, green))
    return found


def place(mask: np.ndarray) -> np.ndarray:
    """[2] column and row of a mask's middle."""
    return np.argwhere(mask).mean(0)[::-1] + 0.5


@pytest.mark.parametrize("frame", [ASIDE, OTHER, UP])
def test_eyes_look_where_they_did(seen, frame):
    for eye, centre in enumerate(EYE_CENTRES):
        x, y, z = centre + EYE_RADIUS * gaze_direction(GAZE[FRAMES.index(frame)])
        expected = (LENS[:2, :2] @ [x, -y] / (DISTANCE_MM - z) + LENS[:2, 2]) * SIZE / 120
        assert np.abs(place(seen[frame][1][eye]) - expected).max() < 1.5


def test_lids_shut_the_eyes_that_were_shut(seen):
    """Each eye by itself."""
    open_eyes = seen[OTHER][0].sum((1, 2))
    assert (open_eyes > 400).all() and (seen[SHUT][0].sum((1, 2)) < 0.05 * open_eyes).all()
    one = seen[RIGHT_SHUT][0].sum((1, 2)) / open_eyes
    assert one[0] < 0.05 and one[1] == pytest.approx(1.0, abs=0.1)


def test_lids_follow_eyes_that_look_down(seen):
    """By as much as these do."""
    level, lowered, down = (seen[frame][0].sum() for frame in (OTHER, LOWERED, DOWN))
    assert down < 0.05 * level and 0.2 * level < lowered < 0.8 * level


def test_without_shapes_the_eyes_turn_alone(result):
    """As an export has them, whose head has no facial actions."""
    assert open_asset(result, **CLAY).lids is not None
    hidden = result / "head.usda"
    hidden.rename(result / "aside")
    try:
        found = open_asset(result, **CLAY)
    finally:
        (result / "aside").rename(hidden)
    assert found.eyes is not None and found.lids is None and found.shut is None
