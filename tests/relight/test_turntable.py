"""`limn turntable`: what it writes, what it keeps, what it leaves alone."""

import shutil
from dataclasses import replace

import av
import numpy as np
import pytest
from toy_export import write_toy_export
from toy_result import EYE_CENTRES, FRAMES

from shared.imaging.material_labels import CLOTH, LABELS
from shared.io.arrays import read_json
from shared.io.images import read_png
from shared.io.material_maps import LABEL_COLOURS
from shared.rendering.views import orbit_camera
from tools.limn import main
from tools.relight import turntable
from tools.relight.inputs import open_asset
from tools.relight.map_sheet import LABEL_PX, TILE_PX, map_sheet
from tools.relight.options import CLAY
from tools.relight.turntable import (
    FARTHEST_GAZE,
    HEAD,
    LIGHT,
    RECORD,
    SHEET,
    TurntableSettings,
    looking,
    write_turntable,
)

SMALL = ("--size", "64", "--frames", "3")


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """An export and what the command says and writes of it, once."""
    base = tmp_path_factory.mktemp("turntable")
    write_toy_export(base, usdz=False, glb=False, plates=False, views=False)
    assert main(["turntable", str(base), *SMALL]) == 0
    shutil.rmtree(base / "work")
    return base


@pytest.fixture
def base(original, tmp_path):
    return shutil.copytree(original, tmp_path / "anna")


def times(base):
    return {path.name: path.stat().st_mtime_ns for path in (base / "turntable").iterdir()}


def frames_of(path):
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        return [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(stream)]


def test_two_videos_and_a_sheet(original):
    assert {path.name for path in (original / "turntable").iterdir()} == {HEAD, LIGHT, SHEET, RECORD}
    heads, lights = (frames_of(original / "turntable" / name) for name in (HEAD, LIGHT))
    assert [frame.shape for frame in heads] == [(64, 192, 3)] * 3
    assert [frame.shape for frame in lights] == [(64, 64, 3)] * 3
    assert read_png(original / "turntable" / SHEET).shape == (2 * (TILE_PX + LABEL_PX), 4 * TILE_PX, 3)
    data = (original / "turntable" / HEAD).read_bytes()
    assert data.index(b"moov") < data.index(b"mdat"), "browsers would wait for the end"


def test_lights_stand_still_while_the_head_turns_and_turn_while_it_does_not(original):
    """The window is on the picture's left in every frame; the low sun begins on the right and comes from the left
    after a third of a turn backwards or so: the brighter half changes."""
    def sides(picture):
        return picture[:, :32].mean(), picture[:, 32:64].mean()

    for frame in frames_of(original / "turntable" / HEAD):
        left, right = sides(frame[:, :64])
        assert left > 1.2 * right
    turned = [sides(frame) for frame in frames_of(original / "turntable" / LIGHT)]
    assert turned[0][1] > 1.2 * turned[0][0] and any(left > right for left, right in turned[1:])


def test_eyes_do_as_they_did_in_the_clip(original):
    """On the camera, or still in the head, or anything between; not farther aside than eyes go; without a gaze the
    camera is as it was."""
    asset = open_asset(original / "export", **CLAY)
    assert asset.eyes is not None and asset.eye_turn.shape == (len(FRAMES), 2, 2)
    np.testing.assert_allclose([ball.centre for ball in asset.eyes.balls], EYE_CENTRES, atol=1e-3)
    sides = np.radians([-20.0, -11.0, 0.0, 8.0, 18.0])
    poses = np.array([orbit_camera(asset.mesh, np.degrees(side), 0.0, 64).camera_from_head for side in sides])
    front, aside, behind = (orbit_camera(asset.mesh, yaw, 0.0, 64) for yaw in (0.0, 20.0, 150.0))
    for slope, expected in ((1.0, (0.05, 0.05 + np.radians(20.0), FARTHEST_GAZE)), (0.0, (0.05, 0.05, 0.05)),
                            (0.4, (0.05, 0.05 + 0.4 * np.radians(20.0), FARTHEST_GAZE))):
        gaze = np.stack([0.05 + slope * sides, np.full(len(sides), -0.1)], axis=1)
        turn = np.repeat(gaze[:, None], 2, axis=1)
        turn[2, 0] = np.nan
        own = replace(asset, poses=poses, eye_turn=turn)
        for camera, yaw in zip((front, aside, behind), expected, strict=True):
            np.testing.assert_allclose(looking(own, camera).gaze, [[yaw, -0.1]] * 2, atol=0.01)
    assert looking(replace(asset, eye_turn=None), front) is front


def test_what_is_there_is_kept_and_what_is_not_is_made(base, capsys):
    before = times(base)
    assert main(["turntable", str(base / "export"), *SMALL]) == 0
    assert capsys.readouterr().out.count("is there") == 3 and times(base) == before
    (base / "turntable" / SHEET).unlink()
    assert main(["turntable", str(base), *SMALL]) == 0
    out = capsys.readouterr().out
    assert out.count("is there") == 2 and f"{SHEET}: written" in out
    assert {name for name, time in times(base).items() if before[name] != time} == {SHEET, RECORD}


def test_other_settings_or_another_export_make_it_anew(base, capsys):
    assert main(["turntable", str(base), "--size", "64", "--frames", "2"]) == 0
    assert capsys.readouterr().out.count("written") == 3 and len(frames_of(base / "turntable" / HEAD)) == 2
    shutil.copy(base / "export" / "maps" / "confidence.exr", base / "export" / "maps" / "roughness.exr")
    assert main(["turntable", str(base), "--size", "64", "--frames", "2"]) == 0
    assert capsys.readouterr().out.count("written") == 3


def test_a_run_that_is_cut_off_goes_on(base):
    """What was finished is kept, nothing half-made is left under a final name."""
    shutil.rmtree(base / "turntable")

    def cut_off(items, label, total):
        if label == LIGHT:
            raise KeyboardInterrupt
        return items

    settings = TurntableSettings(64, 3)
    with pytest.raises(KeyboardInterrupt):
        list(write_turntable(base / "export", settings, cut_off))
    assert {path.name for path in (base / "turntable").iterdir()} == {HEAD, SHEET, RECORD}
    lines = list(write_turntable(base / "export", settings, lambda items, label, total: items))
    assert [line.rpartition(": ")[2][:7] for line in lines] == ["is ther", "is ther", "written"]
    assert set(read_json(base / "turntable" / RECORD)["files"]) == {HEAD, LIGHT, SHEET}


def test_cut_off_between_record_and_file(base):
    """The record tells of a file that is not there: it is made, not refused."""
    (base / "turntable" / HEAD).unlink()
    lines = list(write_turntable(base / "export", TurntableSettings(64, 3), lambda items, label, total: items))
    assert sum("written" in line for line in lines) == 1


@pytest.mark.parametrize(("arguments", "fault"), [
    (("--size", "65"), "even sizes"), (("--size", "10"), "--size: out of range; got 10; expected 64 .. 2048"),
    (("--frames", "1"), "out of range"), (("--fps", "0"), "out of range")])
def test_settings_out_of_range(base, capsys, arguments, fault):
    before = times(base)
    assert main(["turntable", str(base), *arguments]) == 2
    err = capsys.readouterr().err
    assert fault in err and err.count("\n") == 1 and times(base) == before


def test_files_of_others_are_left_alone(base, capsys):
    (base / "turntable" / HEAD).write_bytes(b"my own cut")
    assert main(["turntable", str(base), *SMALL]) == 2
    err = capsys.readouterr().err
    assert f"{HEAD}: not a file of this command, and not written over; move it elsewhere" in err
    assert (base / "turntable" / HEAD).read_bytes() == b"my own cut"


def test_a_record_that_is_none_is_passed_over(base, capsys):
    (base / "turntable" / RECORD).write_text("[]")
    assert main(["turntable", str(base), *SMALL]) == 2
    assert "not a file of this command" in capsys.readouterr().err
    shutil.rmtree(base / "turntable")
    (base / "export" / "poses.npz").unlink()
    assert main(["turntable", str(base), *SMALL]) == 2
    assert "no export of a head; expected poses.npz" in capsys.readouterr().err


def test_no_export_is_one_line(tmp_path, base, capsys):
    (tmp_path / "empty").mkdir()
    assert main(["turntable", str(tmp_path / "empty"), str(base), *SMALL]) == 2
    out, err = capsys.readouterr()
    assert err.count("\n") == 1 and "no export of a head" in err and out.count("is there") == 3
    assert list((tmp_path / "empty").iterdir()) == [] and not (tmp_path / "empty_turntable").exists()


def test_a_folder_of_another_name_gets_its_own(tmp_path):
    assert turntable.turntable_folder(tmp_path / "export") == tmp_path / "turntable"
    assert turntable.turntable_folder(tmp_path / "anna_v2") == tmp_path / "anna_v2_turntable"


def test_sheet_shows_values_as_the_labels_say():
    maps = {"diffuse_albedo": np.full((8, 8, 3), 0.2158605), "roughness": np.full((8, 8), 0.25),
            "specular_intensity": np.tile([0.2, 1.2], (8, 4)), "normal": np.full((8, 8, 3), [0.5, 0.5, 1.0]),
            "material": np.eye(len(LABELS))[np.full((8, 8), CLOTH)]}
    sheet = map_sheet({name: values.astype(np.float32) for name, values in maps.items()})
    middles = sheet[LABEL_PX + TILE_PX // 2::TILE_PX + LABEL_PX, 10::TILE_PX]
    # Albedo, intensity's least, roughness, normal; then cloth.
    assert middles[0].tolist() == [[128, 128, 128], [0, 0, 0], [64, 64, 64], [128, 128, 255]]
    assert middles[1, 0].tolist() == LABEL_COLOURS[CLOTH].tolist()
    assert sheet[LABEL_PX + 5, TILE_PX + 70].tolist() == [255, 255, 255]
    assert (sheet[:LABEL_PX, :TILE_PX] > 100).any(), "no label"
