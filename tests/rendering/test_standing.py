"""What stands off the head: shaded by it, casting no shadow on it."""

import numpy as np
import pytest
from shapes import sphere

from shared.geometry.mesh import Mesh
from shared.imaging.image_sampling import SurfaceViewer
from shared.rendering.precomputed_transfer import Sizes, precompute_transfer
from shared.rendering.render import solid_viewer
from shared.rendering.transfer import mesh_points
from shared.rendering.views import HeadViews, orbit_camera

BALL, SHELL = sphere(60.0, 4), sphere(75.0, 4)
SIZES = Sizes(directions=640, nodes=200)


@pytest.fixture(scope="module")
def both():
    """A ball, and the half of a shell about it that lies behind."""
    behind = SHELL.vertices[SHELL.faces].mean(1)[:, 2] < 0.0
    return Mesh(np.concatenate([BALL.vertices, SHELL.vertices]),
                np.concatenate([BALL.faces, SHELL.faces[behind] + len(BALL.vertices)]),
                np.concatenate([BALL.uvs * [0.5, 1.0], SHELL.uvs * [0.3, 1.0] + [0.6, 0.0]]),
                np.concatenate([BALL.face_uvs, SHELL.face_uvs[behind] + len(BALL.uvs)]))


def test_the_head_keeps_its_light_and_the_shell_is_shaded(both):
    """The ball sees all of its hemisphere; the shell's outside does, too, and its inside nothing but the ball."""
    head = precompute_transfer(SurfaceViewer.of(BALL), SIZES)
    standing = head.with_standing(SurfaceViewer.of(both))
    assert len(standing.nodes.of_face) == len(both.faces)
    back = np.array([np.argmin(SHELL.vertices[:, 2])])
    points = mesh_points(SHELL, back)
    assert standing.trace(points).blocked[0] < 0.02
    inside = type(points)(points.positions * 0.99, -points.normals)
    blocked = standing.trace(inside)
    assert blocked.blocked[0] > 0.95
    assert blocked.bounce[0].astype(float).sum() == pytest.approx(float(blocked.blocked[0]), abs=0.02)


def test_views_light_the_head_as_if_alone(both):
    maps = {"diffuse_albedo": np.full((8, 16, 3), 0.4, np.float32), "specular_intensity": np.zeros((8, 16), np.float32),
            "roughness": np.full((8, 16), 0.5, np.float32), "alpha": np.ones((8, 16), np.float32)}
    camera, light = orbit_camera(BALL, 0.0, 0.0, 64), np.ones((16, 32, 3), np.float32)
    alone, shaded = (HeadViews(both, maps, SIZES, [camera], head_faces=count) for count in (len(BALL.faces), None))
    assert alone.render(light, [camera])[0][32, 32] == pytest.approx(0.4, rel=0.02), "albedo times radiance"
    assert alone.transfer.blocked[alone.index < len(BALL.vertices)].max() < 0.02
    assert shaded.transfer.blocked[shaded.index < len(BALL.vertices)].max() > 0.2
    assert np.array_equal(alone.index, shaded.index)


def test_light_goes_past_what_is_not_half_there(both):
    alpha = np.ones((8, 16), np.float32)
    alpha[:, 8:] = 0.4
    start, away = np.array([[0.0, 0.0, -61.0]]), np.array([[0.0, 0.0, -1.0]])
    assert SurfaceViewer.of(both).scene.occluded(start, away)[0]
    assert not solid_viewer(both, alpha).scene.occluded(start, away)[0]
    alpha[:, 8:] = 0.6
    assert solid_viewer(both, alpha).scene.occluded(start, away)[0]
