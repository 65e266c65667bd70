"""Frames rendered in image space from maps and vertex shading, against closed forms on a ball."""

import numpy as np
import pytest
from shapes import FACING, grid_plane, sphere, turned

from shared.geometry.mesh import Mesh
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import fibonacci_sphere, rigid
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.texture import sample_bilinear
from shared.rendering.brdf import directional_albedo
from shared.rendering.render import SurfaceMaps, render_frame
from shared.rendering.shading import Material, VertexShading
from shared.rendering.transfer import bounce_nodes, mesh_points, trace_transfer

RADIUS, DISTANCE, ROUGHNESS = 80.0, 600.0, 0.45
LENS = np.array([[250.0, 0, 48], [0, 250.0, 40], [0, 0, 1]])
SIZE = (96, 80)
RADIANCE = np.array([1.0, 2.0, 0.5])


@pytest.fixture(scope="module")
def ball():
    """Viewer and shading of a ball under uniform light in two frames, the second turned and off centre."""
    mesh = sphere(RADIUS, 4)
    scene, nodes, points = RayScene(mesh.vertices, mesh.faces), bounce_nodes(mesh, 40), mesh_points(mesh)
    directions = fibonacci_sphere(768)
    transfer, node_transfer = (trace_transfer(scene, some, nodes, directions) for some in (points, nodes.points))
    poses = turned([[0.0, 0, 0], [0, 0.04, 0]], [[0.0, 0, DISTANCE], [30.0, -20.0, DISTANCE]])
    shading = VertexShading(
        np.arange(len(points)),
        points.positions,
        points,
        transfer,
        node_transfer,
        Material(np.full((len(nodes.points), 3), 0.5), 0.0, ROUGHNESS),
        np.broadcast_to(RADIANCE, (6 * 4**2, 3)),
        directions,
        poses,
        "head",
    )
    return SurfaceViewer(mesh, scene), shading, poses


def maps(albedo, specular, size=16):
    return SurfaceMaps(
        np.broadcast_to(np.float32(albedo), (size, size, 3)).copy(), np.full((size, size), specular, np.float32)
    )


def silhouette(centre):
    """[H, W] angle of each pixel inside the ball's outline, degrees; negative outside."""
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]] + 0.5
    rays = np.stack([(u - 48) / 250, (v - 40) / 250, np.ones_like(u)], axis=-1)
    cosine = rays @ centre / np.linalg.norm(rays, axis=-1) / np.linalg.norm(centre)
    outline = np.sqrt(1.0 - (RADIUS / np.linalg.norm(centre)) ** 2)
    return np.degrees(np.arccos(outline) - np.arccos(np.clip(cosine, -1, 1)))


@pytest.mark.parametrize("frame", [0, 1])
def test_a_matte_ball_is_a_flat_disc(ball, frame):
    """Uniform light: albedo * L inside the outline, nothing outside, whatever the pose."""
    viewer, shading, poses = ball
    albedo = [0.6, 0.3, 0.2]
    radiance, coverage = render_frame(viewer, shading, maps(albedo, 0.0), frame, poses[frame], LENS, SIZE)
    inside = silhouette(poses[frame, :3, 3])
    pixel = np.degrees(1.0 / 250.0)
    assert radiance.shape == (80, 96, 3) and coverage.shape == (80, 96)
    assert (coverage[inside > 1.5 * pixel] == 1.0).all()
    assert np.allclose(radiance[inside > 1.5 * pixel], albedo * RADIANCE, rtol=5e-3)
    assert (radiance[inside < -pixel] == 0.0).all() and (coverage[inside < -pixel] == 0.0).all()
    edge = (coverage > 0) & (coverage < 1)
    assert edge.any()
    assert np.allclose(radiance[edge], albedo * RADIANCE, rtol=5e-3), "partly covered pixels are not darkened"


def test_coverage_is_the_disc_area(ball):
    viewer, shading, poses = ball
    coverage = render_frame(viewer, shading, maps([1.0] * 3, 0.0), 0, poses[0], LENS, SIZE, samples=3)[1]
    radius_px = 250.0 * np.tan(np.arcsin(RADIUS / DISTANCE))
    assert coverage.sum() == pytest.approx(np.pi * radius_px**2, rel=0.01)


def test_highlights_add_the_lobe_integral(ball):
    """Uniform light: specular_intensity * directional albedo at the view cosine, in the centre and towards the rim."""
    viewer, shading, poses = ball
    matte = render_frame(viewer, shading, maps([0.4] * 3, 0.0), 0, poses[0], LENS, SIZE)[0]
    glossy = render_frame(viewer, shading, maps([0.4] * 3, 0.8), 0, poses[0], LENS, SIZE)[0]
    added = (glossy - matte)[40]
    distance_px = np.arange(96) + 0.5 - 48.0
    angle = np.arctan(np.abs(distance_px) / 250.0)
    sine = np.minimum(DISTANCE / RADIUS * np.sin(angle), 1.0)
    cosine = np.sqrt(1.0 - sine**2)
    chosen = cosine > 0.35
    expected = 0.8 * directional_albedo(cosine[chosen], ROUGHNESS)[:, None] * RADIANCE
    assert np.allclose(added[chosen], expected, rtol=0.05)
    assert np.allclose(added[47:49], 0.8 * directional_albedo(np.ones(1), ROUGHNESS) * RADIANCE, rtol=0.03)


class FlatShading:
    """Constant E and no S, so that only the maps show."""

    def __init__(self, count):
        self.count = count

    def irradiance(self, frame):
        return np.full((self.count, 3), 2.0, np.float32)

    def reflection(self, frame):
        return np.full((self.count, 3), 0.25, np.float32)


def test_maps_are_read_at_the_pixels_place():
    """A plate that fills 64 x 64 pixels, texture rows from the top: the picture is the texture."""
    plate = grid_plane(5, 100.0)
    viewer = SurfaceViewer.of(plate)
    rng = np.random.default_rng(0)
    albedo, specular = rng.uniform(size=(64, 64, 3)).astype(np.float32), rng.uniform(size=(64, 64)).astype(np.float32)
    lens = np.array([[320.0, 0, 32], [0, 320.0, 32], [0, 0, 1]])
    pose = rigid(FACING, np.array([0.0, 0, 500.0]))
    flat = FlatShading(len(plate.vertices))
    radiance, coverage = render_frame(viewer, flat, SurfaceMaps(albedo, specular), 0, pose, lens, (64, 64), samples=1)
    assert (coverage == 1.0).all()
    assert np.allclose(radiance, 2.0 * albedo + 0.25 * specular[..., None], atol=1e-3)


def test_textures_are_bilinear_and_repeat():
    texture = np.arange(12.0).reshape(3, 4)
    centre = np.array([[(2 + 0.5) / 4, 1.0 - (1 + 0.5) / 3]])
    assert sample_bilinear(texture, centre)[0] == pytest.approx(6.0)
    between = centre + [0.5 / 4, -0.5 / 3]
    assert sample_bilinear(texture, between)[0] == pytest.approx((6 + 7 + 10 + 11) / 4)
    assert np.allclose(sample_bilinear(texture, between + [1.0, -2.0]), sample_bilinear(texture, between))
    top_left = np.array([[0.0, 1.0]])
    assert sample_bilinear(texture, top_left)[0] == pytest.approx((0 + 3 + 8 + 11) / 4)
    colours = np.stack([texture, 2 * texture], axis=-1).astype(np.float32)
    found = sample_bilinear(colours, between)
    assert found.shape == (1, 2) and found.dtype == np.float32 and found[0, 1] == 2 * found[0, 0]


def test_what_lets_light_through_shows_what_lies_behind():
    """Two plates one behind the other, the front one a third there: a third of it, two thirds of the other."""
    near, far = grid_plane(5, 100.0), grid_plane(5, 300.0)
    both = Mesh(np.concatenate([near.vertices, far.vertices - [0.0, 0.0, 50.0]]),
                np.concatenate([near.faces, far.faces + len(near.vertices)]),
                np.concatenate([near.uvs * [0.5, 1.0], far.uvs * [0.5, 1.0] + [0.5, 0.0]]),
                np.concatenate([near.face_uvs, far.face_uvs + len(near.uvs)]))
    albedo, specular = np.full((8, 16, 3), 0.2, np.float32), np.zeros((8, 16), np.float32)
    albedo[:, 8:], alpha = 0.8, np.full((8, 16), 1.0 / 3.0, np.float32)
    alpha[:, 8:] = 1.0
    pose = turned([[0.0, 0.0, 0.0]], [[0.0, 0.0, 320.0]])[0]
    lens = np.array([[320.0, 0, 32], [0, 320.0, 32], [0, 0, 1]])
    viewer, flat = SurfaceViewer.of(both), FlatShading(len(both.vertices))
    radiance, coverage = render_frame(viewer, flat, SurfaceMaps(albedo, specular, alpha), 0, pose, lens, (64, 64))
    middle = np.s_[8:56, 8:56]
    assert np.allclose(radiance[middle], 2.0 * (0.2 / 3.0 + 0.8 * 2.0 / 3.0), rtol=1e-5)
    assert np.allclose(coverage[middle], 1.0, atol=1e-5)
    alone = SurfaceMaps(albedo, specular, np.where(np.arange(16) < 8, 1.0 / 3.0, 0.0)[None].repeat(8, 0).astype("f4"))
    radiance, coverage = render_frame(viewer, flat, alone, 0, pose, lens, (64, 64))
    assert np.allclose(radiance[middle], 2.0 * 0.2, rtol=1e-5), "pixels that are there in part are not darkened"
    assert np.allclose(coverage[middle], 1.0 / 3.0, atol=1e-5)
