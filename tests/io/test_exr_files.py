"""Layouts and values of EXR files, read back by other programs, and crops and colours on the way to them."""

import shutil
import subprocess

import numpy as np
import OpenEXR
import OpenImageIO
import pytest

from shared.errors import LimnError
from shared.io.export_maps import acescg_from_rec709, paste_crop
from shared.io.images import read_exr, write_exr


def test_half_floats_are_clamped_not_infinite(tmp_path):
    write_exr(tmp_path / "sun.exr", np.full((2, 4, 3), 1e6), colour_space="lin_rec709_scene", half=True)
    np.testing.assert_array_equal(read_exr(tmp_path / "sun.exr"), 65504.0)


LEVELS = {"scanline": 1, "tiled": 1, "mipmap": 8}


@pytest.mark.parametrize("layout", LEVELS)
@pytest.mark.parametrize("half", [True, False])
def test_layouts_hold_the_same_pixels(tmp_path, layout, half):
    """Level 0 is exact, each further level the box mean of the one before; the bytes do not depend on the time."""
    values = np.random.default_rng(8).uniform(0.0, 2.0, (128, 128, 3)).astype(np.float16 if half else np.float32)
    for name in ("a.exr", "b.exr"):
        write_exr(tmp_path / name, values, colour_space="lin_ap1_scene", half=half, layout=layout,
                  attributes={"unit": "u"})
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr"), values.astype(np.float32))
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        header = dict(file.header())
    assert header["colorInteropID"] == "lin_ap1_scene" and header["limn:unit"] == "u"
    np.testing.assert_allclose(header["chromaticities"][:2], (0.713, 0.293), atol=1e-6)
    assert ("tiles" in header) == (layout != "scanline")
    buffer, levels = OpenImageIO.ImageBuf(str(tmp_path / "a.exr")), []
    assert buffer.nmiplevels == LEVELS[layout]
    for level in range(buffer.nmiplevels):
        levels.append(OpenImageIO.ImageBuf(str(tmp_path / "a.exr"), 0, level).get_pixels(OpenImageIO.FLOAT))
    for fine, coarse in zip(levels, levels[1:], strict=False):
        size = len(coarse)
        np.testing.assert_allclose(coarse, fine.reshape(size, 2, size, 2, 3).mean((1, 3)), rtol=2e-3, atol=1e-3)


@pytest.mark.skipif(shutil.which("exrheader") is None, reason="needs OpenEXR's own tools (Debian: openexr)")
@pytest.mark.parametrize("layout", LEVELS)
def test_openexrs_own_tools_read_the_files(tmp_path, layout):
    path = tmp_path / "a.exr"
    write_exr(path, np.full((64, 64), 0.5), colour_space="data", half=True, layout=layout, attributes={"unit": "share"})
    told = subprocess.run(["exrheader", str(path)], capture_output=True, text=True, check=True).stdout
    assert 'colorInteropID (type string): "data"' in told and 'limn:unit (type string): "share"' in told
    assert ("mip-map" in told) == (layout == "mipmap")
    subprocess.run(["exrmaketiled", str(path), str(tmp_path / "tiled.exr")], check=True)  # decodes every pixel
    np.testing.assert_array_equal(read_exr(tmp_path / "tiled.exr"), 0.5)


def test_unknown_layouts_are_refused(tmp_path):
    with pytest.raises(LimnError, match="layout"):
        write_exr(tmp_path / "a.exr", np.ones((4, 4)), colour_space="data", layout="ripmap")


def test_acescg_matrix():
    """Rows of the matrix in the ACEScg documents (Rec.709 D65 to AP1 D60, Bradford); grey stays grey."""
    published = [[0.613097, 0.339523, 0.047379], [0.070194, 0.916354, 0.013452], [0.020616, 0.109570, 0.869815]]
    np.testing.assert_allclose(acescg_from_rec709(np.eye(3)).T, published, atol=2e-5)
    np.testing.assert_allclose(acescg_from_rec709(np.full(3, 0.18)), 0.18, atol=2e-5)


@pytest.mark.parametrize("scale", [0.5, 0.8, 1.0, 2.0, 3.0])
def test_pasted_crop_lies_where_it_was_cut(scale):
    """A picture that is linear in source coordinates comes back as that function, whatever the crop's scale."""
    x0, y0, width, height = 12.0, 7.5, 60, 50
    columns, rows = np.meshgrid(np.arange(round(width * scale)) + 0.5, np.arange(round(height * scale)) + 0.5)
    source_u, source_v = columns / scale + x0, rows / scale + y0
    crop = np.stack([source_u, source_v, source_u + source_v], axis=-1)
    full = paste_crop(crop, (x0, y0, scale), (100, 80))
    u, v = np.meshgrid(np.arange(100) + 0.5, np.arange(80) + 0.5)
    inside = (u > x0 + 4) & (u < x0 + width - 4) & (v > y0 + 4) & (v < y0 + height - 4)
    np.testing.assert_allclose(full[inside], np.stack([u, v, u + v], axis=-1)[inside], atol=1e-3)
    assert full.shape == (80, 100, 3) and np.abs(full[:, :10]).max() == 0.0
