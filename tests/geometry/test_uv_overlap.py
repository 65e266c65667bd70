"""How many faces cover a texel, and the share that more than one covers, against closed forms."""

import numpy as np
import pytest
from shapes import grid_plane

from shared.geometry.mesh import Mesh
from shared.geometry.mesh_checks import texel_cover, uv_overlap

SIZE = 32


def sheets(*rectangles, mirrored=False):
    """A mesh of rectangles (left, bottom, right, top) in texels of UV space, two triangles each."""
    uvs, faces = [], []
    for left, bottom, right, top in rectangles:
        start = len(uvs)
        uvs += [(left, bottom), (right, bottom), (right, top), (left, top)]
        faces += [(start, start + 1, start + 2), (start, start + 2, start + 3)]
    faces = np.array(faces, np.int32)[:, ::-1 if mirrored else 1]
    uvs = np.array(uvs, float) / SIZE
    return Mesh(np.column_stack([uvs, np.zeros(len(uvs))]), faces, uvs, faces)


def test_rectangles_overlap_by_their_common_area():
    """8 x 16 and 8 x 16 texels, shifted by 6 and 4: 2 x 12 of 232 texels, round their middle."""
    mesh = sheets((4, 4, 12, 20), (10, 8, 18, 24))
    cover = texel_cover(mesh, SIZE)
    assert cover.sum() == 256 and (cover == 2).sum() == 24 and cover.max() == 2
    assert (cover[SIZE - 20:SIZE - 8, 10:12] == 2).all()
    share, middle = uv_overlap(mesh, SIZE)
    assert share == pytest.approx(24 / 232) and middle == pytest.approx((11 / SIZE, 14 / SIZE))


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("shift", [0.0, 0.25, 0.5])
def test_neighbours_share_no_texel(mirrored, shift):
    """Centres on an edge, here on diagonals and on sides, are of one face; mirrored islands count as others do."""
    one, other = (0.0 + shift, 0, 8 + shift, 32), (8 + shift, 0, 24 + shift, 32)
    cover = texel_cover(sheets(one, other, mirrored=mirrored), SIZE)
    assert cover.max() == 1 and cover.sum() == 24 * 32
    assert uv_overlap(sheets(one, other, mirrored=mirrored), SIZE) == (0.0, (0.0, 0.0))


def test_a_fold_is_an_overlap():
    """A mirrored copy over the half of a sheet: half of the texels are covered twice."""
    sheet, fold = sheets((0, 0, 32, 32)), sheets((0, 0, 16, 32), mirrored=True)
    faces = np.concatenate([sheet.faces, fold.faces + 4])
    uvs = np.concatenate([sheet.uvs, fold.uvs])
    share, (u, v) = uv_overlap(Mesh(np.column_stack([uvs, 0 * uvs[:, :1]]), faces, uvs, faces), SIZE)
    assert share == 0.5 and (u, v) == pytest.approx((0.25, 0.5))


def test_any_triangulation_covers_the_square_once():
    """Random inner vertices, a map of more texels than are looked at together."""
    plane = grid_plane(14)
    inner = (plane.uvs > 0.0).all(1) & (plane.uvs < 1.0).all(1)
    moved = plane.uvs + inner[:, None] * np.random.default_rng(3).uniform(-0.01, 0.01, plane.uvs.shape)
    cover = texel_cover(plane.replace(uvs=moved), 1100)
    assert cover.min() == cover.max() == 1


def test_faces_outside_or_without_area_cover_nothing():
    assert texel_cover(sheets((40, 40, 50, 50), (4, 4, 4, 20)), SIZE).sum() == 0
    assert uv_overlap(sheets((40, 40, 50, 50)), SIZE) == (0.0, (0.0, 0.0))
