"""Outlines of discs that lie a known way apart."""

import numpy as np
import pytest
from shapes import FACING, sphere

from shared.geometry.transforms import rigid
from shared.hair.hair_files import write_hair
from shared.hair.joined import HairSurface
from shared.imaging.material_labels import HAIR, SKIN
from shared.io.images import write_exr, write_png
from tools.scoring.hair_outline import hair_outline_errors, outline_offsets

SIZE, MIDDLE = (120, 140), (70.3, 58.8)


def disc(radius):
    rows, columns = ((np.arange(8 * side) + 0.5) / 8 for side in SIZE)
    inside = (columns - MIDDLE[0]) ** 2 + (rows[:, None] - MIDDLE[1]) ** 2 < radius**2
    return inside.reshape(SIZE[0], 8, SIZE[1], 8).mean((1, 3)).astype(np.float32)


UPPER = np.repeat((np.arange(SIZE[0]) < 60)[:, None], SIZE[1], 1)


@pytest.mark.parametrize("apart_px", [0.0, 0.5, 3.0, -2.0])
def test_discs(apart_px):
    true = disc(40.0)
    offsets = outline_offsets(true, disc(40.0 + apart_px), UPPER, np.where(true > 0.0, 1.5, 0.0))
    assert np.median(offsets) == pytest.approx(1.5 * apart_px, abs=0.25)
    assert np.abs(offsets - 1.5 * apart_px).max() < 1.0


def test_only_outlines_of_hair_count():
    """Below, where skin shows, the result may be anything; nor does the picture's border count."""
    found = np.where(UPPER, disc(40.0), 0.0).astype(np.float32)
    upper = UPPER & (np.arange(SIZE[0]) < 55)[:, None]
    offsets = outline_offsets(disc(40.0), found, upper, np.ones(SIZE))
    assert len(offsets) and np.abs(offsets).max() < 0.6
    assert len(outline_offsets(disc(40.0), found, np.zeros(SIZE, bool), np.ones(SIZE))) == 0
    full = np.ones(SIZE, np.float32)
    assert len(outline_offsets(full, full, np.ones(SIZE, bool), np.ones(SIZE))) == 0


def write_truth(folder, radius_px, depth_mm, label):
    size = (160, 200)
    rows, columns = np.mgrid[: size[0], : size[1]] + 0.5
    inside = np.hypot(columns - 100.0, rows - 80.0) < radius_px
    write_png(folder / "0003_head.png", np.where(inside, 255, 0).astype(np.uint8))
    write_png(folder / "0003_label.png", np.where(inside, label, 0).astype(np.uint8))
    write_exr(folder / "0003_depth.exr", np.where(inside, depth_mm, 0.0).astype(np.float32), colour_space="data")


def test_a_result_without_hair_and_one_with(tmp_path):
    """A ball of 60 mm seen from 600 mm, true hair 4 mm beyond it; then the result has hair there, which may be less."""
    lens = np.array([[500.0, 0.0, 100.0], [0.0, 500.0, 80.0], [0.0, 0.0, 1.0]])
    poses = {3: rigid(FACING, np.array([0.0, 0.0, 600.0])), 4: np.eye(4)}
    radius = 500.0 * 64.0 / np.sqrt(600.0**2 - 64.0**2)
    write_truth(tmp_path, radius, 600.0, HAIR)
    found = hair_outline_errors(tmp_path, tmp_path, sphere(60.0, 4), poses, lens)
    assert found["frames"] == 1 and found["outwards"] == pytest.approx(-4.0, abs=0.5)
    assert found["median"] == pytest.approx(4.0, abs=0.5)
    (tmp_path / "maps").mkdir()
    for there, outwards in ((1.0, 0.0), (0.0, -4.0)):
        alpha = np.full((16, 16), there, np.float32)
        write_hair(tmp_path, HairSurface(sphere(64.0, 4), np.full((16, 16, 3), 0.1, np.float32), alpha))
        found = hair_outline_errors(tmp_path, tmp_path, sphere(60.0, 4), poses, lens)
        assert found["outwards"] == pytest.approx(outwards, abs=0.5)
    write_truth(tmp_path, radius, 600.0, SKIN)
    assert hair_outline_errors(tmp_path, tmp_path, sphere(60.0, 4), poses, lens) is None
