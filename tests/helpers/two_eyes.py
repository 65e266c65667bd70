"""Two eyeballs as a mesh, and a lamp in place of a solved light, for tests of what eyes mirror."""

import numpy as np
from shapes import sphere

from shared.geometry.mesh import Mesh
from shared.geometry.surface import Surface

RADIUS_MM = 12.0


class LampShading:
    """A lamp in a direction, as a cone of some radius in radians, and the light that skin sends on."""

    def __init__(self, lamp, vertices, *, radius=0.2, radiance=1.0, skin=0.25):
        self.lamp, self.radius, self.radiance, self.skin = lamp, radius, radiance, skin
        self.stand_in = np.zeros(vertices, int)

    def arriving(self, frame, directions):
        return self.radiance * np.repeat((directions @ self.lamp > np.cos(self.radius))[:, None], 3, axis=1)

    def blocked_light(self, frame):
        return np.full((1, 3), self.skin)


def two_eyes(apart_mm):
    """A surface of two balls, right and left, whose centres [2, 3] are so far apart, and the centres."""
    centres, ball = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]]) * apart_mm, sphere(RADIUS_MM, 5)
    vertices = np.concatenate([ball.vertices + centre for centre in centres])
    faces = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    mesh = Mesh(vertices, faces, np.zeros((1, 2)), np.zeros_like(faces))
    return Surface(mesh, np.zeros(len(faces), np.uint8), ("eyes",)), centres
