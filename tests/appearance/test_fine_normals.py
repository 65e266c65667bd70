"""Fine normals: the algebra against direct least squares, tangents on a sphere, bumps finer than an egg's mesh."""

import numpy as np
import pytest
from shapes import sphere
from toy_head import toy_head
from toy_shape import LENS, SIZE, SPECULAR, shade, swinging, true_albedo, true_light

from shared.appearance.fine_normals import (
    LinearSamples,
    NormalPass,
    ReliefEquations,
    ReliefSums,
    most_likely_turns,
    normal_image,
)
from shared.appearance.texture import TexelMaterial
from shared.geometry.mesh import interpolate, uv_tangents, vertex_normals
from shared.geometry.raycast import RayScene, camera_hits
from shared.imaging.image_sampling import SurfaceViewer, prepare_picture
from shared.imaging.texels import TexelSurface
from shared.imaging.views import Views
from shared.rendering.envmap import cube_directions

FRAMES, WAVE_MM, HEIGHT_MM = 16, 18.0, 0.4


def test_turn_is_least_squares_with_the_albedo_eliminated():
    rng = np.random.default_rng(0)
    frames = [
        (*(rng.normal(size=shape).astype(np.float32) for shape in ((5, 3), (5, 3, 2))),
         0.05 * rng.normal(size=(5, 3)).astype(np.float32), rng.uniform(0.2, 1.0, (5, 3)).astype(np.float32))
        for _ in range(6)
    ]
    sums = ReliefSums(5)
    for e, d, r, w in frames:
        sums.add(LinearSamples(np.arange(5), e, r, np.ones_like(e), d, w), r)
    found = most_likely_turns(sums.equations(), 1e6)
    for t in range(5):
        design, right = np.zeros((6, 3, 5)), np.zeros((6, 3))
        for f, (e, d, r, w) in enumerate(frames):
            root = np.sqrt(w[t])
            design[f, [0, 1, 2], [2, 3, 4]] = root * e[t]
            design[f, :, :2] = root[:, None] * d[t]
            right[f] = -root * r[t]
        expected = np.linalg.lstsq(design.reshape(18, 5), right.ravel(), rcond=None)[0][:2]
        np.testing.assert_allclose(found[t], expected, atol=1e-4)


def test_confirmed_share_is_where_the_cost_is_lowest():
    """Of many patches that agree, one standard deviation is next to nothing."""
    count = 40_000
    equations = ReliefEquations(np.tile([[2.0, 0.5, 3.0]], (count, 1)), np.tile([[-0.3, 0.4]], (count, 1)))
    turn, patch = np.tile([[0.3, -0.2]], (count, 1)), np.arange(count)
    matrix = np.array([[2.0, 0.5], [0.5, 3.0]])
    shares = np.linspace(0.0, 1.0, 1001)
    costs = [0.5 * (s * turn[0]) @ matrix @ (s * turn[0]) + s * equations.gradient[0] @ turn[0] for s in shares]
    share, gain = equations.confirmed(turn, patch)
    assert share == pytest.approx(shares[int(np.argmin(costs))], rel=0.01)
    assert gain / count == pytest.approx(-min(costs), rel=0.02)
    assert equations.confirmed(-turn, patch) == (0.0, 0.0)
    # The same evidence from one patch may be chance.
    assert equations.confirmed(turn, np.zeros(count, int)) == (0.0, 0.0)


def test_noise_confirms_no_relief_that_hangs_on_it():
    """Of gradients that are noise, relief is confirmed in a sixth of the draws, and little of it; without the deviation
    taken off it would be in half of them."""
    rng = np.random.default_rng(3)
    hessian, patch = np.tile([[1.0, 0.0, 1.0]], (500, 1)), np.arange(500)
    shares = np.array([ReliefEquations(hessian, 0.05 * rng.normal(size=(500, 2))).confirmed(
        0.05 * rng.normal(size=(500, 2)), patch)[0] for _ in range(400)])
    assert 0.08 < (shares > 0).mean() < 0.25 and shares.max() < 0.15

def test_tangents_follow_the_texture_on_a_sphere():
    ball = sphere(50.0, 4)
    face = np.arange(0, len(ball.faces), 7)
    bary = np.full((len(face), 3), 1.0 / 3.0)
    corners, uv = ball.vertices[ball.faces[face]], ball.uvs[ball.face_uvs[face]]
    place = corners.mean(1)
    normals = place / np.linalg.norm(place, axis=1, keepdims=True)
    tangents = uv_tangents(ball, normals, face, bary)
    np.testing.assert_allclose(np.einsum("nkx,nx->nk", tangents, normals), 0.0, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(tangents, axis=2), 1.0, atol=1e-5)
    # Steps on the surface and in the texture: the linear map between them, face by face.
    steps, in_uv = corners[:, 1:] - corners[:, :1], uv[:, 1:] - uv[:, :1]
    along = np.einsum("nij,njx->nix", np.linalg.inv(in_uv), steps)
    flat = along / np.linalg.norm(along, axis=2, keepdims=True)
    away_from_poles = np.abs(normals[:, 1]) < 0.8
    assert ((flat * tangents).sum(2)[away_from_poles] > 0.95).mean() > 0.95


def rendered(bumpy: bool):
    """Clip of an egg with waves that a coarse mesh does not have, that mesh, and its light."""
    fine = toy_head(6).mesh(np.zeros(2), np.zeros(1))
    waves = HEIGHT_MM * np.sin(2 * np.pi / WAVE_MM * fine.vertices[:, 0]) * bumpy
    truth = fine.replace(vertices=fine.vertices + waves[:, None] * vertex_normals(fine.vertices, fine.faces))
    poses, light = swinging(FRAMES), true_light(cube_directions(16))
    shading, _, _ = shade(truth, poses, light)
    albedo, scene = true_albedo(truth.vertices), RayScene(truth.vertices, truth.faces)
    pictures = []
    for f, pose in enumerate(poses):
        radiance = albedo * shading.irradiance(f) + SPECULAR * shading.reflection(f)
        face, bary, _ = camera_hits(scene, pose, LENS, SIZE, SIZE)
        image = np.zeros((SIZE, SIZE, 3), np.float32)
        image[face >= 0] = interpolate(radiance, truth.faces, face[face >= 0], bary[face >= 0])
        codes = np.clip(np.round(image * 32767), 0, 65535).astype(np.uint16)
        mask = np.where(face >= 0, 255, 0).astype(np.uint8)
        pictures.append(prepare_picture(codes, codes.astype(np.float32) / 32767, mask))
    return truth, poses, light, pictures


@pytest.mark.parametrize("bumpy", [True, False])
def test_bumps_finer_than_the_mesh_are_found_and_none_where_there_are_none(bumpy):
    truth, poses, light, pictures = rendered(bumpy)
    mesh = toy_head(4).mesh(np.zeros(2), np.zeros(1))
    shading, _, _ = shade(mesh, poses, light)
    surface = TexelSurface(mesh, 256)
    places = surface.interpolate(mesh.vertices)
    material = TexelMaterial(
        true_albedo(places).astype(np.float32),
        np.full(len(surface), SPECULAR, np.float32),
        np.full(len(surface), 400.0),
    )
    fitted = np.arange(FRAMES) % 4 != 2
    views = Views.in_one_light(poses, LENS, (SIZE, SIZE), "head", pictures.__getitem__, None, fitted)
    viewer = SurfaceViewer.of(mesh)
    turn, record = NormalPass(surface, viewer, shading, views, material).run(1.0)
    front = places[:, 2] > 60.0
    if not bumpy:
        assert np.degrees(np.linalg.norm(turn[front], axis=1).mean()) < 1.0
        return
    tangents = uv_tangents(mesh, vertex_normals(mesh.vertices, mesh.faces)[mesh.faces[surface.face, 0]], surface.face,
                           surface.bary)
    slope = 2 * np.pi / WAVE_MM * HEIGHT_MM * np.cos(2 * np.pi / WAVE_MM * places[:, 0])
    expected = -slope[:, None] * tangents[:, :, 0]
    assert np.corrcoef(turn[front].ravel(), expected[front].ravel())[0, 1] > 0.7
    assert record["confirmed_share"] > 0.5
    image = normal_image(surface, turn)
    assert image.shape == (256, 256, 3) and image.min() >= 0.0 and image.max() <= 1.0
    assert (image.reshape(-1, 3)[surface.pixel, 2] > 0.5).all()
