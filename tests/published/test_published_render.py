"""The reference renderer: what pixels see, blended silhouettes, shading, and every gradient by finite differences."""

import numpy as np
import pytest
import torch
from shapes import FACING, grid_plane, sphere, turned

from shared.geometry.mesh import vertex_normals
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import rigid, rotation_from_vector
from shared.published.light import PrefilteredLight
from shared.published.raster import Raster, SurfacePoints, blend, torch_vertex_normals
from shared.published.shading import Sampling, Shader, TorchMaterial
from shared.rendering.brdf import directional_albedo
from shared.rendering.envmap import cube_directions
from shared.rendering.transfer import Points, bounce_nodes, irradiance, trace_transfer

pytestmark = pytest.mark.usefixtures("one_thread")

LENS, SIZE = np.array([[120.0, 0, 24], [0, 120.0, 20], [0, 0, 1]]), (48, 40)
POSE = turned([0.1, 0.3, 0.05], (3.0, -5.0, 600.0))
DOUBLE = torch.float64


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def lamp(directions):
    lobe = np.exp(4.0 * (directions @ np.array([0.48, 0.36, 0.8]) - 1.0))
    return np.stack([0.2 + 2.0 * lobe, 0.3 + 1.5 * lobe, 0.4 + lobe], axis=1)


@pytest.fixture(scope="module")
def ball():
    """(mesh, raster, scene, hits) of a ball before the camera; bumpy, so that normals and silhouettes vary."""
    mesh = sphere(1.0, 3)
    x, y, z = mesh.vertices.T
    mesh = mesh.replace(vertices=mesh.vertices * (75.0 + 4.0 * np.sin(5 * x + 3 * y) + 3.0 * np.cos(4 * z))[:, None])
    raster, scene = Raster(mesh, LENS, SIZE, dtype=DOUBLE), RayScene(mesh.vertices, mesh.faces)
    return mesh, raster, scene, raster.hits(scene, POSE)


def seen_points(ball, vertices):
    """SurfacePoints of all pixels that see the ball, for vertices [V, 3] (torch)."""
    mesh, raster, _, hits = ball
    pixels = np.nonzero(hits.face.ravel() >= 0)[0]
    normals = torch_vertex_normals(vertices, torch.from_numpy(mesh.faces.astype(np.int64)))
    return raster.points(vertices, normals, POSE, pixels, hits.face.ravel()[pixels]), pixels


def finite_difference(function, tensor, index, step):
    """Central difference of a scalar function by one entry of a tensor."""
    values = []
    for sign in (1.0, -1.0):
        moved = tensor.detach().clone()
        moved[index] += sign * step
        values.append(float(function(moved)))
    return (values[0] - values[1]) / (2.0 * step)


# ---------------------------------------------------------------------- primary visibility


def test_points_are_where_the_rays_hit(ball):
    mesh, raster, scene, hits = ball
    points, pixels = seen_points(ball, torch.from_numpy(mesh.vertices))
    in_camera = points.position.numpy() @ POSE[:3, :3].T + POSE[:3, 3]
    assert np.allclose(in_camera[:, 2], hits.depth.ravel()[pixels], rtol=1e-4)
    projected = in_camera[:, :2] / in_camera[:, 2:] * 120.0 + [24, 20]
    assert np.allclose(projected, np.stack([pixels % 48 + 0.5, pixels // 48 + 0.5], axis=1), atol=1e-6)
    towards = -POSE[:3, 3] @ POSE[:3, :3] - points.position.numpy()
    assert np.allclose(points.towards.numpy() * np.linalg.norm(towards, axis=1)[:, None], towards)


def test_normals_are_those_of_the_mesh(ball):
    mesh = ball[0]
    found = torch_vertex_normals(torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces.astype(np.int64)))
    assert np.allclose(found.numpy(), vertex_normals(mesh.vertices, mesh.faces), atol=1e-9)


def coverage_of(ball, vertices, hits=None, raster=None):
    """[h w] blended coverage for vertices (torch); pairs as for the hits given, or anew."""
    mesh, own_raster, _, _ = ball
    raster = raster or own_raster
    array = vertices.detach().numpy()
    if hits is None:
        hits = raster.hits(RayScene(array, mesh.faces), POSE)
    pairs = raster.pairs(array, POSE, hits)
    crossing = raster.crossing(vertices, POSE, pairs)
    hard = torch.from_numpy((hits.face.ravel() >= 0).astype(np.float64))[:, None]
    return blend(hard, torch.from_numpy(pairs.near), torch.from_numpy(pairs.far), crossing)[:, 0], pairs


def test_every_border_is_blended(ball):
    """Pairs lie across the outline, and each row and column with a border, where it is steep or flat, has its pair."""
    _, _, _, hits = ball
    coverage, pairs = coverage_of(ball, torch.from_numpy(ball[0].vertices), hits)
    covered = hits.face >= 0
    outer = pairs.take(np.nonzero(~covered.ravel()[pairs.far])[0])
    assert covered.ravel()[outer.near].all()
    borders = (covered[:, 1:] != covered[:, :-1]).sum() + (covered[1:] != covered[:-1]).sum()
    assert 0.5 * borders < len(outer) < 0.8 * borders
    soft = (coverage.numpy().reshape(covered.shape) % 1.0) > 0
    rolls = [np.roll(covered, step, axis) for step in (1, -1) for axis in (0, 1)]
    rim = covered & ~np.logical_and.reduce(rolls)
    assert (soft[rim] | soft[np.roll(rim, 1, 0)]).mean() > 0.4


def test_coverage_is_the_area(ball):
    """Blended coverage adds up to the outline's area more closely than whole pixels do, at any size."""
    mesh = sphere(1.0, 4)
    raster, errors = Raster(mesh, LENS, SIZE, dtype=DOUBLE), []
    for radius in np.linspace(60.0, 70.0, 9):
        vertices = torch.from_numpy(mesh.vertices * radius)
        smooth = coverage_of((mesh, raster, None, None), vertices)[0].sum()
        distance = np.linalg.norm(POSE[:3, 3])
        expected = np.pi * (120.0 * np.tan(np.arcsin(radius / distance))) ** 2
        hard = (raster.hits(RayScene(vertices.numpy(), mesh.faces), POSE).face >= 0).sum()
        errors.append([abs(float(smooth) / expected - 1), abs(hard / expected - 1)])
    smooth, hard = np.array(errors).mean(0)
    assert smooth < 0.015 and smooth < 1.5 * hard


def test_coverage_grows_with_the_ball_as_its_outline_says():
    """Derivative of the covered area by the radius against the closed form, through every silhouette vertex."""
    mesh = sphere(1.0, 4)
    raster, radius = Raster(mesh, LENS, SIZE, dtype=DOUBLE), torch.tensor(66.0, dtype=DOUBLE, requires_grad=True)
    coverage_of((mesh, raster, None, None), radius * torch.from_numpy(mesh.vertices))[0].sum().backward()
    distance = np.linalg.norm(POSE[:3, 3])

    def area(r):
        return np.pi * (120.0 * np.tan(np.arcsin(r / distance))) ** 2

    assert float(radius.grad) == pytest.approx((area(66.5) - area(65.5)), rel=0.03)


def test_silhouette_gradients(ball):
    """Vertices at the outline: weighted sum of the blended coverage by finite differences."""
    mesh, _, _, hits = ball
    weights = torch.rand(SIZE[0] * SIZE[1], generator=generator(), dtype=DOUBLE)
    vertices = torch.from_numpy(mesh.vertices.copy()).requires_grad_()
    covered, pairs = coverage_of(ball, vertices, hits)
    (weights * covered).sum().backward()
    checked = 0
    for vertex in np.unique(pairs.edge)[::7]:
        for axis in range(3):
            expected = finite_difference(
                lambda moved: (weights * coverage_of(ball, moved, hits)[0]).sum(), vertices, (vertex, axis), 1e-5
            )
            assert float(vertices.grad[vertex, axis]) == pytest.approx(expected, rel=1e-3, abs=1e-6)
            checked += abs(expected) > 1e-4
    assert checked > 10


def test_a_surface_before_another_is_an_edge_too():
    """A plate before a wall: pairs along its outline though nothing is background; the plate is the near one."""
    wall, plate = grid_plane(3, 400.0), sphere(20.0, 3)
    vertices = np.concatenate([wall.vertices, plate.vertices + [0, 0, 80.0]])
    mesh = wall.replace(vertices=vertices, faces=np.concatenate([wall.faces, plate.faces + len(wall.vertices)]))
    mesh = mesh.replace(face_uvs=np.zeros_like(mesh.faces))
    raster = Raster(mesh, LENS, SIZE)
    pose = rigid(FACING, np.array([0.0, 0, 600.0]))
    hits = raster.hits(RayScene(vertices, mesh.faces), pose)
    pairs = raster.pairs(vertices, pose, hits)
    on_ball = hits.face.ravel() >= len(wall.faces)
    assert len(pairs) > 15 and on_ball[pairs.near].all() and not on_ball[pairs.far].any()


# ---------------------------------------------------------------------- shading


def uniform_texture(count, albedo=0.4, specular=0.8, roughness=0.4):
    return TorchMaterial(
        torch.full((count, 3), albedo, dtype=DOUBLE),
        torch.full((count,), specular, dtype=DOUBLE),
        torch.full((count,), roughness, dtype=DOUBLE),
    )


def on_sphere(count=40, radius=80.0):
    """Points on a ball seen from the front, and its scene."""
    mesh = sphere(radius, 5)
    normals = mesh.vertices[mesh.vertices[:, 2] > 20][:count] / radius
    points = SurfacePoints(
        *(torch.from_numpy(x.copy()) for x in (normals * radius, normals, normals[:, :2])),
        torch.from_numpy(np.tile([0.0, 0, 1.0], (len(normals), 1))),
    )
    return points, RayScene(mesh.vertices * 0.9995, mesh.faces)


@pytest.mark.parametrize("visibility", [True, False])
def test_white_furnace(visibility):
    """Even light of radiance 2 on a ball: twice the albedo plus twice the lobe's directional albedo; V~ is 1."""
    points, scene = on_sphere()
    shader = Shader(16, Sampling(128, 128, visibility=visibility), 8, dtype=DOUBLE)
    light = torch.full((6 * 16**2, 3), 2.0, dtype=DOUBLE)
    texture = uniform_texture(len(points.position))
    found = shader(light, points, texture, scene, np.eye(3), generator()).numpy()
    expected = 2.0 * (0.4 + 0.8 * directional_albedo(points.normal[:, 2].numpy(), 0.4))
    assert np.allclose(found.mean(1), expected, rtol=0.03)
    assert np.allclose(found.mean(), expected.mean(), rtol=0.005)


def test_diffuse_light_is_the_transfer_solvers():
    """A point under a roof, a lamp beside it: the same irradiance as by precomputed transfer, in a turned world."""
    roof = grid_plane(3, 120.0)
    scene = RayScene(roof.vertices + [0, 0, 40.0], roof.faces)
    normal = np.array([[0.0, 0.6, 0.8], [0.6, 0.0, 0.8]])
    points = Points(np.zeros((2, 3)), normal)
    turn = rotation_from_vector(np.array([0.3, 0.5, -0.2]))
    from shared.geometry.transforms import fibonacci_sphere
    from shared.rendering.shading import light_along

    cube, directions = lamp(cube_directions(16)), fibonacci_sphere(8192)
    transfer = trace_transfer(scene, points, bounce_nodes(roof, 9), directions)
    expected = irradiance(transfer, light_along(cube, directions, turn[None])[:, 0])
    many = 400
    tensors = (np.zeros((2 * many, 3)), np.repeat(normal, many, 0), np.zeros((2 * many, 2)), np.repeat(normal, many, 0))
    seen = SurfacePoints(*map(torch.from_numpy, tensors))
    shader = Shader(16, Sampling(64, 64, specular=False), 8, dtype=DOUBLE)
    matte = uniform_texture(2 * many, albedo=1.0)
    found = shader(torch.from_numpy(cube), seen, matte, scene, turn, generator()).numpy().reshape(2, many, 3)
    assert np.allclose(found.mean(1), expected, rtol=0.01)
    only = [Shader(16, Sampling(*n, specular=False), 8, dtype=DOUBLE) for n in ((64, 1), (1, 64))]
    spread = [s(torch.from_numpy(cube), seen, matte, scene, turn, generator()).std() for s in only]
    assert found.std(1).mean() < 1.2 * min(float(value) for value in spread)


@pytest.mark.parametrize("roughness", [0.05, 0.3, 0.9])
def test_visible_share_is_the_published_one(roughness):
    """1 in the open at every roughness; under a roof binary for a mirror and the open share when rough."""
    points, ball_scene = on_sphere()
    roof = grid_plane(3, 300.0)
    under = RayScene(roof.vertices[:, [2, 1, 0]] + [60.0, 0, 0], roof.faces)
    shader = Shader(8, Sampling(), 8, dtype=DOUBLE)

    def share(normal, towards, scene, count=200):
        repeated = (torch.tensor(x, dtype=DOUBLE).expand(count, 3) for x in (normal, towards, [0.0, 0.0, 0.0]))
        rough = torch.full((count,), roughness, dtype=DOUBLE)
        return shader.visible_share(
            *list(repeated)[:2],
            rough,
            torch.zeros((count, 3), dtype=DOUBLE),
            scene,
            torch.eye(3, dtype=DOUBLE),
            generator(),
        )

    rough = torch.full((len(points.position),), roughness, dtype=DOUBLE)
    turn = torch.eye(3, dtype=DOUBLE)
    open_ = shader.visible_share(points.normal, points.towards, rough, points.position, ball_scene, turn, generator())
    assert float(open_.min()) > 0.98
    s = 0.5**0.5
    to_wall, away = share([0.0, 0.0, 1.0], [-s, 0.0, s], under), share([0.0, 0.0, 1.0], [s, 0.0, s], under)
    if roughness == 0.05:
        assert float(to_wall.max()) == 0.0 and float(away.min()) == 1.0
    elif roughness == 0.9:
        assert 0.2 < float(to_wall.mean()) < float(away.mean()) < 1.0


def test_gradients_of_material_and_light():
    """Albedo, specular intensity, roughness and every texel's light, with traced visibility, by finite differences."""
    points, scene = on_sphere(12)
    shader = Shader(8, Sampling(16, 16, 16), 4, dtype=DOUBLE)
    light = torch.from_numpy(lamp(cube_directions(8)))
    weights = torch.rand((12, 3), generator=generator(3), dtype=DOUBLE)
    texture = uniform_texture(12)
    inputs = {
        "albedo": texture.albedo,
        "specular": texture.specular_intensity,
        "roughness": texture.roughness,
        "light": light,
    }

    def value(**changed):
        at = inputs | changed
        material = TorchMaterial(at["albedo"], at["specular"], at["roughness"])
        turn = rotation_from_vector(np.array([0.1, 0.4, 0.0]))
        found = shader(at["light"], points, material, scene, turn, generator(), importance=light)
        return (weights * found).sum()

    leaves = {name: tensor.clone().requires_grad_() for name, tensor in inputs.items()}
    value(**leaves).backward()
    rng = np.random.default_rng(0)
    for name, leaf in leaves.items():
        gradient = leaf.grad
        assert float(gradient.abs().max()) > 1e-3
        order = gradient.abs().flatten().argsort(descending=True).numpy()
        for flat in [*order[:4], *rng.choice(order, 4)]:
            index = np.unravel_index(flat, gradient.shape)
            expected = finite_difference(lambda moved, name=name: value(**{name: moved}), leaf, index, 1e-5)
            assert float(gradient[index]) == pytest.approx(expected, rel=1e-4, abs=1e-8), name


def test_interior_gradients_of_vertices(ball):
    """Vertices within the outline: normals, positions and texture coordinates slide under fixed pixels."""
    mesh, _, scene, _ = ball
    shader = Shader(8, Sampling(visibility=False), 4, dtype=DOUBLE)
    light = torch.from_numpy(lamp(cube_directions(8)))

    def value(vertices):
        points, pixels = seen_points(ball, vertices)
        albedo = 0.3 + 0.2 * torch.sin(9.0 * points.uv[:, :1] + torch.arange(3, dtype=DOUBLE))
        rough = 0.35 + 0.1 * torch.cos(7.0 * points.uv[:, 1])
        texture = TorchMaterial(albedo, torch.full_like(rough, 0.9), rough)
        colours = shader(light, points, texture, scene, np.eye(3), generator())
        weights = torch.rand((len(pixels), 3), generator=generator(5), dtype=DOUBLE)
        return (weights * colours).sum()

    vertices = torch.from_numpy(mesh.vertices.copy()).requires_grad_()
    value(vertices).backward()
    strongest = vertices.grad.norm(dim=1).argsort(descending=True).numpy()
    for vertex in strongest[:40:5]:
        for axis in range(3):
            expected = finite_difference(value, vertices, (vertex, axis), 1e-5)
            assert float(vertices.grad[vertex, axis]) == pytest.approx(expected, rel=2e-3, abs=1e-5)


def test_gradient_by_the_normal_of_sampled_light():
    """With traced visibility the mean gradient of the irradiance by the normal is that of the integral."""
    cube = torch.from_numpy(lamp(cube_directions(16)))
    many, far = 3000, RayScene(grid_plane(3, 1.0).vertices + [0, 0, 1e5], grid_plane(3, 1.0).faces)
    normal = torch.nn.functional.normalize(torch.tensor([0.2, 0.3, 0.9], dtype=DOUBLE), dim=0)
    free = normal.clone().requires_grad_()
    repeated = free.expand(many, 3)
    zeros = torch.zeros((many, 3), dtype=DOUBLE)
    points = SurfacePoints(zeros, repeated, zeros[:, :2], repeated.detach())
    shader = Shader(16, Sampling(64, 64, specular=False), 8, dtype=DOUBLE)
    shader(cube, points, uniform_texture(many, albedo=1.0), far, np.eye(3), generator()).mean(0).sum().backward()
    exact = PrefilteredLight(16, 8, dtype=DOUBLE)
    smooth = normal.clone().requires_grad_()
    texels = torch.from_numpy(cube_directions(16))
    from shared.rendering.envmap import cube_solid_angles

    weight = torch.from_numpy(cube_solid_angles(16))[:, None] * cube
    ((texels @ smooth).clamp_min(0.0)[:, None] * weight / np.pi).sum().backward()
    assert len(exact.edges) == 2
    assert torch.allclose(free.grad, smooth.grad, rtol=0.03, atol=0.03 * float(smooth.grad.abs().max()))
