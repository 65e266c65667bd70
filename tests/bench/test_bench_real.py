"""The bench of real clips: its cases, where it looks, its page, and a row of a run that is there."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from shared.appearance.measured_skin import SURFACE_INTENSITY
from shared.errors import InputError
from shared.io.arrays import read_json, write_json
from shared.io.images import read_png
from tools.bench import real
from tools.bench.real import COLUMNS, RealBench, all_clips, record_columns
from tools.bench.real_page import TILE_PX, head_window, html_page, tiled
from tools.bench.rerender import SolvedClip, filled_and_unclipped, region_pixels
from tools.bench.runner import run


def bench(*words):
    return run(RealBench, "real", [str(word) for word in words])


@pytest.fixture
def clips(tmp_path):
    """A folder with two clips, as far as a file's name tells."""
    folder = tmp_path / "clips"
    folder.mkdir()
    (folder / "anna.mp4").write_bytes(b"anna")
    (folder / "ben kept still.GIF").write_bytes(b"ben")
    (folder / "SOURCES.md").write_text("whose they are")
    return folder


def test_every_clip_of_the_folder_is_a_case_and_told_what_the_file_says(clips):
    found = all_clips(clips, None)
    assert list(found) == ["anna", "ben_kept_still"] and found["anna"].arguments() == [str(clips / "anna.mp4")]
    assert found["anna"].digest != found["ben_kept_still"].digest
    (clips / "clips.yaml").write_text("anna: {moves: camera, focal_length_px: 900}\n")
    anna = all_clips(clips, clips / "clips.yaml")["anna"]
    assert anna.arguments()[1:] == ["--moves", "camera", "--focal-length-px", "900"]
    assert anna.say() == "moves camera, focal_length_px 900"


def test_what_names_no_clip_is_refused(clips, tmp_path):
    exceptions = clips / "clips.yaml"
    exceptions.write_text("ann: {moves: camera}\n")
    with pytest.raises(InputError, match="anna"):
        all_clips(clips, exceptions)
    exceptions.write_text("anna: {move: camera}\n")
    with pytest.raises(InputError, match="moves"):
        all_clips(clips, exceptions)
    (clips / "anna.mov").touch()
    with pytest.raises(InputError, match="name of its own"):
        all_clips(clips, None)
    with pytest.raises(InputError, match="no clip"):
        all_clips(tmp_path / "nowhere", None)


def test_only_pixels_that_are_sure_count():
    """One pixel each: sure; clipped in one channel; outside the mask; half covered."""
    codes = np.full((1, 4, 3), 120, np.uint8)
    codes[0, 1, 0] = 251
    mask, coverage = np.array([[255, 255, 0, 128]], np.uint8), np.array([[1.0, 1.0, 1.0, 0.5]])
    assert filled_and_unclipped(codes, mask, coverage).tolist() == [[True, False, False, False]]


def test_regions_follow_the_segments():
    shown = np.array([["nose", "lids", "brows", "lips", "scalp", "chin", ""]])
    sure = np.array([[True, True, True, True, True, False, True]])
    found = {name: np.nonzero(pixels[0])[0].tolist() for name, pixels in region_pixels(shown, sure).items()}
    assert found == {"skin": [0], "eyes": [1], "lips": [3], "head": [0, 1, 2, 3, 4]}


def test_the_window_holds_the_head_and_a_margin():
    shown = np.zeros((100, 80), bool)
    shown[20:61, 30:50] = True
    assert head_window(shown) == (slice(18, 63), slice(28, 52))
    assert head_window(np.zeros((4, 4), bool)) == (slice(None), slice(None))


def test_tiles_keep_their_shape_on_grey():
    red = np.full((50, 100, 3), (255, 0, 0), np.uint8)
    sheet = tiled([[red, red], [red, red]])
    assert sheet.shape == (2 * TILE_PX, 2 * TILE_PX, 3)
    assert (sheet[TILE_PX // 2, :TILE_PX] == (255, 0, 0)).all() and len(np.unique(sheet[0])) == 1


def test_the_page_shows_what_there_is(tmp_path):
    (tmp_path / "sheets").mkdir()
    (tmp_path / "sheets" / "anna.png").touch()
    rows = [{"case": "anna", "skin_db": 31.25, "warnings": "a < b"}, {"case": "ben", "refused": "no face"}]
    page = html_page(rows, COLUMNS[1:], tmp_path / "sheets")
    assert page.count("<img") == 1 and "sheets/anna.png" in page and "31.25" in page
    assert "a &lt; b" in page and "no face" in page


def test_a_clip_is_run_and_measured_once(tiny_run, clips, tmp_path, monkeypatch):
    """The tiny subject's run, as if it were of one of the clips; the other clip is refused."""
    out, commands = tmp_path / "out", []

    def run_there(command, log, well=(0,)):
        commands.append(command)
        if "run" in command and "anna" in log.name:
            shutil.copytree(tiny_run, Path(command[command.index("--out") + 1]) / "anna", dirs_exist_ok=True)
        elif "run" in command:
            raise InputError("no face", where="clip.gif")

    monkeypatch.setattr(real, "measured", run_there)
    words = (clips, "--out", out, "--set", "init_albedo.size=64")
    assert bench(*words) == 0
    runs = [command for command in commands if "run" in command]
    assert len(runs) == 2 and all("init_albedo.size=64" in command for command in runs)
    anna, ben = read_json(out / "real.json")["rows"]
    assert "no face" in ben["refused"] and anna["held_out"] >= 1 and anna["frames"] == 12
    assert 20.0 < anna["skin_db"] < 60.0 and 0.5 < anna["skin_ssim"] <= 1.0 and anna["detail"] > 0.0
    assert anna["roughness_end"] == "" and anna["jitter_deg"] > 0.0 and anna["peak_mb"] > 100
    assert anna["highlights_fitted"] is True and anna["roughness"] != 0.45
    sheet = read_png(out / "sheets" / "anna.png")
    assert sheet.shape == (TILE_PX * min(anna["held_out"], 4), 5 * TILE_PX, 3)
    assert "sheets/anna.png" in (out / "real.html").read_text() and "| skin_db |" in (out / "real.md").read_text()
    commands.clear()
    assert bench(*words) == 0 and len([command for command in commands if "run" in command]) == 1, "the refused one"
    (clips / "clips.yaml").write_text("anna: {moves: camera}\n")
    commands.clear()
    assert bench(*words, "--only", "anna") == 0 and any("--moves" in command for command in commands)


def test_highlights_that_stayed_what_they_were_are_told(tiny_run, tmp_path):
    """The record of the tiny subject's run, as if its highlights had been left out of the fit."""
    for stage in ("track_landmarks", "inverse_render"):
        (tmp_path / "work" / stage).mkdir(parents=True)
        for path in (tiny_run / "work" / stage).glob("*.json"):
            shutil.copy(path, tmp_path / "work" / stage)
    solved = tmp_path / "work" / "inverse_render" / "solve.json"
    solve = read_json(solved)
    for highlights, fitted, end in ((SURFACE_INTENSITY, False, ""), (2.0, True, "upper")):
        solve["model"] |= {"roughness": 0.45, "specular_intensity": highlights}
        write_json(solved, solve)
        row = record_columns(tmp_path)
        assert (row["highlights_fitted"], row["specular_end"]) == (fitted, end)


def test_regions_of_a_run_lie_in_its_head(tiny_run):
    clip = SolvedClip(tiny_run, at_most=1)
    (item,) = clip.compared()
    shown = item.render.max(-1) > 0.0
    for name in ("skin", "eyes", "lips"):
        pixels = item.regions[name]
        assert pixels.any() and not (pixels & ~item.regions["head"]).any()
    assert item.regions["bare_skin"].any() and not (item.regions["bare_skin"] & ~item.regions["skin"]).any()
    assert not (item.regions["skin"] & item.regions["eyes"]).any() and shown[item.regions["head"]].all()
    albedo, relit = clip.albedo(clip.held_out[0]), clip.relit(clip.held_out[0])
    assert albedo[item.regions["skin"]].min() > 0.0 and relit[item.regions["skin"]].max() > 0.0
    assert clip.clipped_share() == 0.0


def test_an_unknown_preset_is_said(clips, tmp_path, capsys):
    assert bench(clips, "--out", tmp_path / "out", "--preset", "fast") == 2
    assert "unknown preset" in capsys.readouterr().err
