"""What living eyes look like: white with veins, iris and pupil turned by the gaze, under a wet cornea.

The paint lies in the eyeball's own space: it turns under the lids. The cornea is a cap of a smaller sphere before the
iris, of which only the mirror reflection is drawn: rays meet the eyeball itself, and the iris is seen unrefracted on
it. So shape, shadows and irradiance are the same whatever the gaze.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shared.compute.smooth_step import smooth_step
from shared.geometry.eyeballs import gaze_rotation
from shared.geometry.mesh import normalised
from shared.imaging.texture import sample_bilinear
from shared.imaging.value_noise import value_noise
from shared.rendering import brdf
from tools.synthesis.eyes import LivingEyes
from tools.synthesis.surface import Materials

IRIS_RADIUS_MM = 5.85
"""Half of the visible iris' width in adults."""
CORNEA_RADIUS_MM, CORNEA_INDEX = 7.8, 1.376
CORNEA_ROUGHNESS, WHITE_ROUGHNESS = 0.05, 0.09
WET_SPECULAR = ((CORNEA_INDEX - 1.0) / (CORNEA_INDEX + 1.0)) ** 2 / brdf.F0
"""Specular intensity by which the reflectance model has the Fresnel reflectance of that index seen head-on."""
LIMBUS_MM = 0.4
"""Over which the cornea goes over into the white."""
PUPIL_MM = (1.6, 2.3)
PUPIL_ALBEDO = 0.012
IRIS_COLOURS = ((0.085, 0.12, 0.155), (0.115, 0.125, 0.12), (0.09, 0.10, 0.05), (0.12, 0.07, 0.03),
                (0.06, 0.033, 0.016))
"""Blue, grey, green, hazel and brown: linear albedo."""
DARK_TONE = 0.7
"""From this much melanin on, eyes are brown."""
WHITE = np.array([0.62, 0.55, 0.51])
CORNER = np.array([0.56, 0.38, 0.34])
VEIN = np.array([0.25, 0.9, 0.95])
"""What a vein takes away of each channel at full strength."""
WIDEST, ROWS, COLUMNS = 1.9, 512, 1024
"""The paint: angle from the axis of its last row, texels along and around it."""


@dataclass(frozen=True, eq=False)
class EyePaint:
    """eyes: where they are; albedo [ROWS, COLUMNS, 3] by the angle from the eye's axis and around it."""

    eyes: LivingEyes
    albedo: np.ndarray

    def colour(self, local: np.ndarray) -> np.ndarray:
        """Unit directions [N, 3] from the eyeball's centre in its own space, +z its axis -> albedo [N, 3]."""
        polar = np.arccos(np.clip(local[:, 2], -1.0, 1.0))
        rows = np.clip(polar / WIDEST, 0.5 / ROWS, 1.0 - 0.5 / ROWS)
        around = np.arctan2(local[:, 1], local[:, 0]) / (2 * np.pi)
        return sample_bilinear(self.albedo, np.stack([around, 1.0 - rows], 1))

    def on_texture(self, materials: Materials, place: np.ndarray, inside: np.ndarray) -> Materials:
        """The head's textures with eyes that look straight ahead; place [H, W, 3] mm of each texel, inside [H, W] bool:
        the eyeballs."""
        values = {name: np.array(getattr(materials, name)) for name in ("albedo", "specular", "roughness")}
        side = (place[inside][:, 0] > 0).astype(int)
        outward = normalised(place[inside] - self.eyes.centres[side])
        values["albedo"][inside] = self.colour(outward)
        values["specular"][inside] = WET_SPECULAR
        values["roughness"][inside] = self._roughness(outward)
        return replace(materials, **values)

    def look(self, position: np.ndarray, directions: np.ndarray, side: np.ndarray,
             gaze: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Points [N, 3] mm on the eyeballs `side` [N], seen along unit directions [N, 3], with gaze [2, 2] -> albedo
        [N, 3], roughness [N], and where and on which normals [N, 3] their wet surface mirrors."""
        turn = gaze_rotation(gaze)[side]
        outward = normalised(position - self.eyes.centres[side])
        local, ray = np.einsum("nji,nj->ni", turn, outward), np.einsum("nji,nj->ni", turn, directions)
        place, normal = self._wet_surface(local * self.eyes.radius, local, ray)
        back = np.einsum("nij,nj->ni", turn, place) + self.eyes.centres[side]
        return self.colour(local), self._roughness(local), back, np.einsum("nij,nj->ni", turn, normal)

    def _roughness(self, local: np.ndarray) -> np.ndarray:
        cornea = self._cornea_share(local * self.eyes.radius)
        return WHITE_ROUGHNESS + cornea * (CORNEA_ROUGHNESS - WHITE_ROUGHNESS)

    @staticmethod
    def _cornea_share(place: np.ndarray) -> np.ndarray:
        """[N] of points [N, 3] mm in the eyeball's space: 1 within the iris' rim, 0 outside and behind."""
        share = smooth_step((IRIS_RADIUS_MM - np.hypot(place[:, 0], place[:, 1])) / LIMBUS_MM + 0.5)
        return np.where(place[:, 2] > 0, share, 0.0)

    def _wet_surface(self, place: np.ndarray, outward: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where rays [N, 3] that arrive at points [N, 3] mm of the eyeball pass its wet surface, and normals there."""
        apart = np.sqrt(self.eyes.radius**2 - IRIS_RADIUS_MM**2) - np.sqrt(CORNEA_RADIUS_MM**2 - IRIS_RADIUS_MM**2)
        arm = place - [0.0, 0.0, apart]
        along = (arm * ray).sum(1)
        square = along**2 - (arm**2).sum(1) + CORNEA_RADIUS_MM**2
        back = along + np.sqrt(np.maximum(square, 0.0))
        cap = arm - back[:, None] * ray
        share = np.where((square > 0) & (back >= 0), self._cornea_share(cap + [0.0, 0.0, apart]), 0.0)[:, None]
        normal = normalised((1.0 - share) * outward + share * cap / CORNEA_RADIUS_MM)
        return np.where(share > 0, cap + [0.0, 0.0, apart], place), normal


def paint_eyes(eyes: LivingEyes, tone: float, seed: int) -> EyePaint:
    """Eyes of a seed; tone: the skin's melanin, above DARK_TONE their colour is brown."""
    rng = np.random.default_rng([seed, 11])
    colour = np.array(IRIS_COLOURS[rng.integers(len(IRIS_COLOURS))] if tone < DARK_TONE else IRIS_COLOURS[-1])
    pupil = rng.uniform(*PUPIL_MM)
    rows, columns = (np.arange(ROWS) + 0.5) / ROWS, (np.arange(COLUMNS) + 0.5) / COLUMNS
    polar, around = np.meshgrid(WIDEST * rows, 2 * np.pi * columns, indexing="ij")
    ring = np.sin(polar)
    place = eyes.radius * np.stack([ring * np.cos(around), ring * np.sin(around), np.cos(polar)], -1)
    off_axis = np.where(polar < 0.5 * np.pi, eyes.radius * ring, np.inf)
    iris = np.clip((IRIS_RADIUS_MM - off_axis) / 0.5 + 0.5, 0.0, 1.0)[..., None]
    hole = np.clip((pupil - off_axis) / 0.2 + 0.5, 0.0, 1.0)[..., None]
    albedo = _white(place, off_axis, rng)
    albedo += iris * (_iris(off_axis, around, pupil, colour, rng) - albedo)
    albedo += hole * (PUPIL_ALBEDO - albedo)
    return EyePaint(eyes, np.clip(albedo, 0.005, 0.9).astype(np.float32))


def _white(place: np.ndarray, off_axis: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """[H, W, 3] albedo of the white: redder towards the corners, where veins run to."""
    beyond = np.where(np.isfinite(off_axis), off_axis, 20.0)
    sideways = np.abs(place[..., 0]) / np.maximum(np.hypot(place[..., 0], place[..., 1]), 1e-6)
    corner = np.clip((beyond - 8.0) / 6.0, 0.0, 1.0) * sideways**2
    white = WHITE * (1.0 + 0.02 * value_noise(place, 1.5, rng))[..., None]
    white = white + 0.6 * corner[..., None] * (CORNER - WHITE)
    warp = np.stack([value_noise(place, 2.5, rng) for _ in range(3)], -1)
    veins = np.zeros(place.shape[:-1])
    for wavelength, width, strength in ((5.0, 0.09, 1.0), (2.6, 0.07, 0.6)):
        veins += strength * np.exp(-(value_noise(place + 0.35 * warp, wavelength, rng) / width) ** 2)
    where = np.clip((beyond - 6.5) / 5.0, 0.0, 1.0) * np.clip(0.4 + 0.6 * value_noise(place, 7.0, rng), 0.0, 1.2)
    return white * (1.0 - 0.45 * np.clip(veins * where, 0.0, 1.0)[..., None] * VEIN)


def _iris(off_axis: np.ndarray, around: np.ndarray, pupil: float, colour: np.ndarray,
          rng: np.random.Generator) -> np.ndarray:
    """[H, W, 3] albedo of the iris: radial fibres, a lighter and warmer ring about the pupil, a dark rim."""
    across = np.minimum(off_axis, IRIS_RADIUS_MM + 1.0)
    spread = np.stack([3.0 * np.cos(around), 3.0 * np.sin(around), 0.3 * across], -1)
    fibres = sum(amount * value_noise(spread, wavelength, rng)
                 for wavelength, amount in ((1.6, 0.22), (0.8, 0.22), (0.45, 0.16)))
    inner = np.exp(-((across - pupil - 0.7) / 0.7) ** 2)
    rim = smooth_step((across - 4.7) / 0.9)
    level = np.clip(1.0 + fibres, 0.3, 2.0) * (1.0 + 0.45 * inner) * (1.0 - 0.75 * rim)
    warm = colour + inner[..., None] * 0.4 * (np.array(IRIS_COLOURS[3]) - colour)
    return level[..., None] * warm
