"""What eyes mirror: a tear film over cornea and white, so smooth that it shows the light as a picture of itself.

Lobe sums at the vertices of a mesh are made for skin, whose lobes are wider than its faces. An eye's catchlight is
smaller than a face, and stands where the cornea's own curvature puts it. So each ray, or texel, that meets an eyeball
looks up the light along its mirrored direction; where the head stands in the way, it sees the light that skin sends on.
"""

from __future__ import annotations

import numpy as np

from shared.geometry.eyeballs import IRIS_MM, TEAR_FILM_IOR, gaze_direction
from shared.geometry.mesh import interpolate, normalised
from shared.geometry.raycast import RAY_START_MM
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.turning_eyes import TurningEyes
from shared.rendering.brdf import F0
from shared.rendering.shading import VertexShading

EYE_INTENSITY = ((TEAR_FILM_IOR - 1.0) / (TEAR_FILM_IOR + 1.0)) ** 2 / F0
"""Specular intensity of a surface of that index of refraction: 0.63."""
CORNEA_MM, LIMBUS_MM = 7.8, 1.0
"""Radius of the cornea, and over how much of its rim its curvature goes over into the eyeball's."""


class EyeShine:
    """Mirrored light on the eyeballs of a mesh, in the frames of a shading."""

    def __init__(self, viewer: SurfaceViewer, shading: VertexShading, eyes: TurningEyes):
        self.viewer, self.shading, self.eyes = viewer, shading, eyes

    def reflection(
        self, frame: int, gaze: np.ndarray, camera: np.ndarray, face: np.ndarray, bary: np.ndarray
    ) -> np.ndarray:
        """S [n, 3] float32 at specular_intensity 1 of places on the eyeballs, on faces face [n] int with corner weights
        bary [n, 3].

        gaze [2, 2] radians, NaN: straight ahead; camera [3]: its centre in head space, mm.
        """
        places, normals, mirrored, cosine = self._mirrored(gaze, camera, face, bary)
        light = self.shading.arriving(frame, mirrored)
        covered = np.nonzero(self.viewer.scene.occluded(places + RAY_START_MM * normals, mirrored))[0]
        around = self.shading.blocked_light(frame)[self.shading.stand_in[self.viewer.mesh.faces[face[covered]]]]
        light[covered] = (around * bary[covered, :, None]).sum(1)
        return ((F0 + (1.0 - F0) * (1.0 - cosine) ** 5) * light).astype(np.float32)

    def mirrored(self, gaze: np.ndarray, camera: np.ndarray, face: np.ndarray, bary: np.ndarray) -> np.ndarray:
        """[n, 3] unit: where the light comes from, in head space, that places on faces face [n] int with corner weights
        bary [n, 3] send to the camera [3], mm; gaze [2, 2] radians as in reflection."""
        return self._mirrored(gaze, camera, face, bary)[2]

    def _mirrored(
        self, gaze: np.ndarray, camera: np.ndarray, face: np.ndarray, bary: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Places, normals and mirrored directions, all [n, 3], and the cosine [n, 1] under which the camera sees
        them."""
        mesh, side = self.viewer.mesh, self.eyes.side[face]
        places = interpolate(mesh.vertices, mesh.faces, face, bary)
        axes = gaze_direction(np.where(np.isfinite(gaze), gaze, 0.0))[side]
        normals = cornea_normals(places - np.stack([ball.centre for ball in self.eyes.balls])[side], axes)
        towards = normalised(camera - places)
        cosine = np.maximum((normals * towards).sum(1, keepdims=True), 0.0)
        return places, normals, normalised(2.0 * cosine * normals - towards), cosine


def cornea_normals(offsets: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """[n, 3] unit normals of an eye at places by their offsets [n, 3] mm from its centre, whose axes [n, 3] are unit.

    Within the iris' rim those of the cornea, a ball of its own whose centre is on the axis; beyond it the eyeball's.
    """
    along = (offsets * axes).sum(1, keepdims=True)
    across = offsets - along * axes
    distance = np.linalg.norm(across, axis=1, keepdims=True)
    bulge = np.clip((IRIS_MM - distance) / LIMBUS_MM, 0.0, 1.0) * (along > 0.0)
    sine = np.minimum(distance / CORNEA_MM, 1.0)
    cornea = np.sqrt(1.0 - sine**2) * axes + across / CORNEA_MM
    return normalised(bulge * cornea + (1.0 - bulge) * normalised(offsets))
