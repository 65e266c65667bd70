"""The pictures of the shape show what they are given."""

import numpy as np
from shapes import sphere

from shared.geometry.mesh import vertex_normals
from shared.report.shape_pictures import BACKDROP, shape_sheet

SIZE = 80


def test_sheet_shows_both_meshes_normals_and_where_they_differ():
    start = sphere(100.0, 4)
    normals = vertex_normals(start.vertices, start.faces)
    upper = start.vertices[:, 1] > 20.0
    lower = start.vertices[:, 1] < -20.0
    moved = start.vertices + (2.0 * upper - 2.0 * lower)[:, None] * normals
    sheet = shape_sheet(start, start.replace(vertices=moved), None, SIZE)
    assert sheet.shape == (4 * SIZE, 3 * SIZE, 3) and sheet.dtype == np.uint8
    middle = SIZE // 2
    # Normals: towards the camera in the middle, to the right at the right, whatever the side.
    for column in range(3):
        facing = sheet[2 * SIZE + middle, column * SIZE + middle].astype(int)
        np.testing.assert_allclose(facing, [127, 127, 255], atol=8)
        assert sheet[2 * SIZE + middle, column * SIZE + SIZE - 18, 0] > 190
    # Difference: red where it grew, blue where it shrank, white between.
    last = sheet[3 * SIZE :].astype(int)
    assert (last[middle - 20, middle] == [255, 0, 0]).all()
    assert (last[middle + 20, middle] == [0, 0, 255]).all()
    assert (last[middle, middle] == 255).all()
    assert (sheet[SIZE - 2, 2] == BACKDROP).all()


def test_a_mesh_that_has_not_moved_is_drawn_once_and_looks_the_same():
    start = sphere(100.0, 4)
    behind = np.argmin(start.vertices @ [1.0, 0.0, 1.0])  # where none of the views looks
    hardly = start.replace(vertices=start.vertices.copy())
    hardly.vertices[behind] *= 1.0 + 1e-12
    np.testing.assert_array_equal(shape_sheet(start, start, None, SIZE), shape_sheet(start, hardly, None, SIZE))
