"""An egg under a soft lamp: its light, albedo, poses and shading, for the tests of shape and of fine normals."""

import numpy as np

from shared.geometry.mesh import normalised
from shared.geometry.transforms import rigid, rotation_from_vector
from shared.imaging.image_sampling import SurfaceViewer
from shared.rendering.precomputed_transfer import Sizes, precompute_transfer
from shared.rendering.shading import Material, VertexShading
from shared.rendering.transfer import mesh_points

FRAMES, SIZE, ROUGHNESS, SPECULAR = 20, 240, 0.4, 0.7
LENS = np.array([[900.0, 0, SIZE / 2], [0, 900.0, SIZE / 2], [0, 0, 1]])
SIZES = Sizes(directions=384, nodes=100)


def true_light(directions):
    lamp = np.exp(5.0 * (directions @ normalised(np.array([-0.6, 0.5, 0.7])) - 1.0))
    sky = 0.35 + 0.2 * directions[:, 1]
    return np.stack([sky + 2.0 * lamp, sky + 1.8 * lamp, 1.1 * sky + 1.6 * lamp], axis=1)


def true_albedo(positions):
    x, y, z = positions.T / 9.0
    pattern = 0.2 * np.sin(2.1 * x + y) + 0.2 * np.cos(1.7 * y - z) + 0.1 * np.sin(3.0 * z + 2.0 * x)
    return np.array([0.45, 0.31, 0.23]) * np.exp(pattern)[:, None]


def swinging(frames=FRAMES):
    angle = np.linspace(0, 2 * np.pi, frames)
    vectors = np.stack([0.2 * np.sin(2 * angle), 0.5 * np.sin(angle), 0 * angle], axis=1)
    return rigid(np.diag([1.0, -1, -1]) @ rotation_from_vector(vectors), np.tile([0, 0, 900.0], (frames, 1)))


def shade(mesh, poses, light):
    """Vertex shading, its precomputed and material under a light."""
    viewer = SurfaceViewer.of(mesh)
    precomputed = precompute_transfer(viewer, SIZES)
    points = mesh_points(mesh)
    material = Material(true_albedo(precomputed.nodes.points.positions), SPECULAR, ROUGHNESS)
    index = np.arange(len(mesh.vertices))
    transfer = precomputed.trace(points)
    traced = points, transfer, precomputed.node_transfer
    shading = VertexShading(index, mesh.vertices, *traced, material, light, precomputed.directions, poses, "head")
    return shading, precomputed, material
