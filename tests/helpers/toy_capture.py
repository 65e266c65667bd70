"""A capture whose light, albedo and highlights are known: an egg with a nose that turns before a camera."""

from dataclasses import replace

import numpy as np
from shapes import turned
from toy_head import toy_head

from shared.appearance.light_models import make_light_model
from shared.appearance.light_step import LinearisedFit
from shared.appearance.observations import Capture
from shared.appearance.problem import AppearanceProblem, AppearanceSettings
from shared.geometry.mesh import normalised
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import camera_centres, fibonacci_sphere, world_from_head
from shared.imaging.image_sampling import Samples
from shared.rendering.brdf import hemispherical_albedo
from shared.rendering.envmap import cube_directions
from shared.rendering.lobes import SpecularTransfer, specular_reflection
from shared.rendering.shading import light_along
from shared.rendering.transfer import bounce_nodes, irradiance, mesh_points, node_radiosity, trace_transfer

FRAMES, ROUGHNESS, SPECULAR, NOISE = 14, 0.4, 0.7, 0.002
DIRECTIONS = fibonacci_sphere(256)
MATTE = AppearanceSettings(resolutions=(6,), steps=4, specular=False, noise=(0.003, 0.01))


def true_light(directions):
    """A soft warm lamp at the upper left on a grey sky, white on average over the face."""
    lamp = np.exp(6.0 * (directions @ normalised(np.array([-0.6, 0.5, 0.7])) - 1.0))
    sky = 0.45 + 0.15 * directions[:, 1]
    return np.stack([sky + 2.2 * lamp, sky + 2.0 * lamp, 1.1 * sky + 1.8 * lamp], axis=1)


def true_albedo(positions):
    """Skin of middle tone with patches some centimetres wide."""
    x, y, z = positions.T / 30.0
    pattern = 0.25 * np.sin(2.1 * x + y) + 0.2 * np.cos(1.7 * y - z)
    return np.array([0.50, 0.31, 0.23]) * np.exp(pattern)[:, None]


def swinging(frames=FRAMES, turn=0.6):
    """A head that turns 35 degrees (turn, in radians) to both sides and nods."""
    angle = np.linspace(0, 2 * np.pi, frames)
    vectors = turn * np.stack([0.4 * np.sin(2 * angle), np.sin(angle), 0 * angle], axis=1)
    return turned(vectors)


def even_light(directions):
    """The same from all sides."""
    return np.ones_like(directions)


def hard_light(directions):
    """A small strong lamp at the upper left in a dim room."""
    lamp = np.exp(60.0 * (directions @ normalised(np.array([-0.6, 0.5, 0.7])) - 1.0))
    return 0.15 + 40.0 * lamp[:, None] * np.array([1.0, 0.95, 0.9])


def small_lamp(directions):
    """One some eight degrees wide, there, and nearly nothing else."""
    lamp = np.exp(200.0 * (directions @ normalised(np.array([-0.6, 0.5, 0.7])) - 1.0))
    return 0.03 + 133.0 * lamp[:, None] * np.array([1.0, 0.95, 0.9])


def coloured_light(directions):
    """A room whose left is red and whose right is green, grey in between."""
    side = directions[:, :1]
    return np.exp(0.4 * directions[:, 1:2] + side * np.array([-0.5, 0.4, 0.1]))


def make_truth(
    specular=SPECULAR, clip_at=np.inf, roughness_at=lambda positions: ROUGHNESS, lights=(true_light,), noise=NOISE,
    poses=None, moves="head", true_albedo=true_albedo,
):
    """Capture, true albedo [P, 3] and true irradiance [P, F, 3], put together from the forward modules.

    roughness_at: of points [P, 3], one value or [P]; lights: functions of directions, FRAMES frames in each; poses
    [FRAMES, 4, 4] or None: swinging; true_albedo: of points.
    """
    mesh = toy_head(4).mesh(np.zeros(2), np.zeros(1))
    scene, nodes = RayScene(mesh.vertices, mesh.faces), bounce_nodes(mesh, 80)
    poses = swinging() if poses is None else poses
    poses, light_index = np.tile(poses, (len(lights), 1, 1)), np.repeat(np.arange(len(lights)), FRAMES)
    frames = len(poses)
    front = np.nonzero(mesh.vertices[:, 2] > 15.0)[0]
    points = mesh_points(mesh, front)
    transfer, node_transfer = (trace_transfer(scene, some, nodes, DIRECTIONS) for some in (points, nodes.points))
    turns = world_from_head(poses, moves)
    cubes = np.concatenate([light(cube_directions(16)) for light in lights])
    along = light_along(cubes, DIRECTIONS, turns, light_index)
    node_albedo = true_albedo(nodes.points.positions) + specular * hemispherical_albedo(ROUGHNESS)
    direct = np.einsum("kj,jfc->kfc", node_transfer.direct.astype(np.float64), along)
    radiosity = node_radiosity(node_transfer, node_albedo, direct)
    flat = along.reshape(len(DIRECTIONS), -1), radiosity.reshape(len(direct), -1)
    light = irradiance(transfer, *flat).reshape(len(points), frames, 3)
    towards = normalised(camera_centres(poses)[None] - points.positions[:, None])
    table = SpecularTransfer(points.normals, transfer.visibility(), DIRECTIONS)
    roughness = roughness_at(points.positions)
    lobes = [specular_reflection(table, towards[:, f], roughness, along[:, f]) for f in range(frames)]
    albedo = true_albedo(points.positions)
    colours = albedo[:, None] * light + specular * np.stack(lobes, axis=1)
    colours += noise * np.random.default_rng(0).normal(size=colours.shape)
    cosine = (towards * points.normals[:, None]).sum(2)
    weight = np.where(cosine > 0.2, cosine**2, 0.0).astype(np.float32)
    saturation = (colours > clip_at).astype(np.int8)
    samples = Samples(np.clip(colours, 0, clip_at).astype(np.float32), weight, saturation, towards.astype(np.float32))
    fitted, skin = np.tile(np.arange(FRAMES) % 5 != 2, len(lights)), np.ones(len(points), bool)
    capture = Capture(
        points, samples, transfer, nodes, node_transfer, DIRECTIONS, turns, fitted, skin, light_index
    )
    seen = (weight[:, fitted] > 0).sum(1) >= 4
    index = np.nonzero(seen)[0]
    parts = {"points": points.take(index), "samples": samples.points(index), "transfer": transfer.take(index)}
    return replace(capture, **parts, skin=skin[index]), albedo[index], light[index]


def started(capture, settings=MATTE):
    """The problem of a capture and the state that its fit starts from."""
    problem = AppearanceProblem.of(capture, settings)
    return problem, problem.uniform_start()


def linearised(problem, state, highlights_count=False):
    """The problem at a state, all samples as they are assumed."""
    return LinearisedFit.at(problem, state, problem.transport(state), problem.errors, highlights_count)


def under_true_light(capture, settings=None):
    """The problem and its state with all unknowns but the roughness as they are."""
    settings = settings or AppearanceSettings(resolutions=(16,), noise=(0.003, 0.01), roughness=ROUGHNESS)
    problem, state = started(capture, settings)
    return problem, replace(
        state,
        params=np.log(true_light(cube_directions(16))),
        light_model=make_light_model("cubemap", 16),
        specular=SPECULAR,
        albedo=true_albedo(capture.points.positions),
        node_albedo=true_albedo(capture.nodes.points.positions),
    )


def glossy_forehead(positions):
    """A third less rough above the eyes, a third rougher below, the same on average over all points."""
    return np.where(positions[:, 1] > np.median(positions[:, 1]), 0.8, 1.25) * ROUGHNESS
