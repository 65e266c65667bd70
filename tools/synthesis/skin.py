"""Procedural skin: reflectance textures for the head model from a seed.

Tone follows two pigments, melanin and haemoglobin, whose amounts vary over the face and absorb each colour channel
differently (after [Tsumura2003]). What melanin absorbs is fitted to cheeks and foreheads that were measured
(MEASURED_SKINS, rms 2 % over all tones and channels); from person to person skin is as red and as yellow as measured
people of one lightness are. How pigments vary over a face is chosen by eye. Patterns live in the head's 3D space, so UV
seams do not show.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from shared.capture.landmarks import BROW_LEFT, BROW_RIGHT
from shared.geometry.mesh import interpolate, normalised, rasterize_uv
from shared.imaging.material_labels import BROW, CLOTH, EYE, HAIR, LIPS, SKIN, UNKNOWN
from shared.imaging.value_noise import value_noise
from tools.synthesis.head import Head
from tools.synthesis.surface import Materials

BARE_SKIN = np.array([0.716, 0.698, 0.599])
ABOVE_PIGMENTS = 0.019
"""Linear reflectance that no pigment takes away: the darkest skins are nearly grey."""
MELANIN_ABSORPTION = np.array([1.721, 2.445, 3.847])
HAEMOGLOBIN_ABSORPTION = np.array([0.13, 0.78, 0.52])
HAEMOGLOBIN, HAEMOGLOBIN_SPREAD = 0.55, 0.12
"""Of a face, and its standard deviation between people: 0.08 in log R/G, that of measured faces of one lightness."""
YELLOW_SPREAD = 0.1
"""Standard deviation between people of what further pigments absorb in blue, from measured b* of one lightness."""
MASK_SEGMENTS = ("forehead", "lids", "nose", "cheek_left", "cheek_right", "upper_lip_skin", "lips", "chin")
COLLAR_Y_MM, COLLAR_SLOPE = -163.0, -0.5
CLOTH_ALBEDO = (0.07, 0.085, 0.11)
IRIS_RADIUS_MM = 6.0
PUPIL_RADIUS_MM = 2.2
LABEL_MM = 2.0
"""Standard deviation over which hair counts as covering the skin between its strands."""
# Amounts added per region: melanin, haemoglobin, specular intensity, roughness.
REGIONS = {
    "lips": (0.04, 0.75, 0.22, -0.11), "lids": (0.04, 0.16, 0.05, -0.02), "ears": (0.0, 0.32, 0.0, 0.02),
    "nose": (0.0, 0.14, 0.20, -0.07), "forehead": (0.008, 0.0, 0.10, -0.04), "chin": (0.0, 0.06, 0.04, 0.0),
    "scalp": (0.0, 0.0, -0.12, 0.05), "neck": (0.02, 0.03, -0.08, 0.03), "inner_mouth": (0.2, 1.3, 0.0, -0.1),
    "eye_sockets": (0.12, 0.8, 0.0, 0.0),
}
BLUSH = {50: 20.0, 280: 20.0, 4: 11.0}
"""Landmarks on which the skin is redder, with the radius in mm: both cheeks and the tip of the nose."""


@dataclass(frozen=True)
class Complexion:
    """tone: amount of melanin, 0.15 as the lightest measured faces to 1.6 as the darkest; freckles, stubble, hair: 0 to
    1; hair and iris colours: linear albedo."""

    tone: float = 0.35
    freckles: float = 0.5
    stubble: float = 0.3
    hair: float = 0.9
    hair_colour: tuple[float, float, float] = (0.055, 0.036, 0.025)
    iris_colour: tuple[float, float, float] = (0.075, 0.10, 0.12)


def skin_of(melanin: np.ndarray | float, haemoglobin: np.ndarray | float = HAEMOGLOBIN) -> np.ndarray:
    """Linear albedo [..., 3] of skin with so much melanin and haemoglobin [...]."""
    absorbed = np.multiply.outer(melanin, MELANIN_ABSORPTION) + np.multiply.outer(haemoglobin, HAEMOGLOBIN_ABSORPTION)
    return ABOVE_PIGMENTS + (BARE_SKIN - ABOVE_PIGMENTS) * np.exp(-absorbed)


class SkinPainter:
    """Paints textures of size x size for one head.

    place [size, size, 3]: the surface's points, mm; landmarks [468, 3], mm.
    """

    def __init__(self, head: Head, size: int, seed: int):
        self.size = size
        self._rng = np.random.default_rng([seed, 5])
        self._ruddy, self._yellow = np.random.default_rng([seed, 9]).normal(size=2)
        self._head, mesh = head, head.mesh
        face, bary = rasterize_uv(mesh, size)
        empty = face < 0
        self._fill = tuple(distance_transform_edt(empty, return_distances=False, return_indices=True))
        face, bary = face[self._fill], bary[self._fill]
        self._segment = head.face_segment[face]
        self.place = interpolate(mesh.vertices, mesh.faces, face.ravel(), bary.reshape(-1, 3)).reshape(size, size, 3)
        self.landmarks = head.landmarks()

    def inside(self, *names: str) -> np.ndarray:
        """[size, size] bool: the named segments."""
        return np.isin(self._segment, [self._head.segment_names.index(name) for name in names])

    def region(self, *names: str, softness_mm: float = 2.5) -> np.ndarray:
        """[size, size] in [0, 1]: the named segments with soft borders."""
        inside = self.inside(*names).astype(np.float32)
        return cv2.GaussianBlur(inside, (0, 0), max(softness_mm * self._texels_per_mm(), 0.5))

    def noise(self, wavelength_mm: float) -> np.ndarray:
        """[size, size] smooth random pattern over the surface, mean 0, standard deviation about 1."""
        return value_noise(self.place, wavelength_mm, self._rng).astype(np.float32)

    def paint(self, complexion: Complexion, labelled: bool = False) -> Materials:
        """All textures; labelled: with labels."""
        melanin, haemoglobin, specular, roughness = self._amounts(complexion)
        albedo = skin_of(melanin, haemoglobin)
        albedo[..., 2] *= np.exp(-YELLOW_SPREAD * self._yellow)
        covered, brows = self._hair(complexion)
        hair = np.clip(np.maximum(covered, brows), 0, 1)
        albedo = albedo * (1 - hair[..., None]) + np.array(complexion.hair_colour) * hair[..., None]
        cloth = self._cloth()
        weave = np.array(CLOTH_ALBEDO) * (1 + 0.12 * self.noise(1.5))[..., None]
        albedo += cloth[..., None] * (weave - albedo)
        specular -= 0.25 * hair + 0.5 * cloth
        roughness += 0.08 * hair + 0.2 * cloth
        albedo, specular, roughness = self._eyes(albedo, specular, roughness, complexion)
        mask = self.inside(*MASK_SEGMENTS)
        return Materials(np.clip(albedo, 0.01, 0.9).astype(np.float32), np.clip(specular, 0.1, 1.2).astype(np.float32),
                         np.clip(roughness, 0.22, 0.7).astype(np.float32), mask.astype(np.float32),
                         self._labels(covered, brows, cloth) if labelled else None)

    def _labels(self, covered: np.ndarray, brows: np.ndarray, cloth: np.ndarray) -> np.ndarray:
        """[size, size] uint8 of material_labels.LABELS; hair where it covers half of the surface within LABEL_MM, brows
        where their strokes are as dense as that of a fifth."""
        def around(share: np.ndarray) -> np.ndarray:
            return cv2.GaussianBlur(share.astype(np.float32), (0, 0), max(LABEL_MM * self._texels_per_mm(), 0.5))

        label = np.full((self.size, self.size), SKIN, np.uint8)
        label[around(np.clip(covered, 0, 1)) > 0.5] = HAIR
        label[around(brows) > 0.2] = BROW
        label[self.inside("lips")] = LIPS
        label[self.inside("inner_mouth", "eye_sockets")] = UNKNOWN
        label[cloth > 0.5] = CLOTH
        label[self.inside("eyes")] = EYE
        return label

    def _amounts(self, complexion: Complexion) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Melanin, haemoglobin, specular intensity and roughness of bare skin, each [size, size]."""
        tone = complexion.tone
        melanin = tone * (1 + 0.04 * self.noise(30) + 0.024 * self.noise(7) + 0.02 * self.noise(1.6))
        melanin += complexion.freckles * self._freckles() + self._moles()
        haemoglobin = HAEMOGLOBIN + HAEMOGLOBIN_SPREAD * self._ruddy
        haemoglobin = haemoglobin + 0.07 * self.noise(16) + 0.06 * self.noise(5) + 0.05 * self.noise(2)
        specular = 0.72 + 0.06 * self.noise(14) + 0.05 * self.noise(2.5)
        roughness = 0.45 + 0.015 * self.noise(20) + 0.015 * self.noise(3)
        for landmark, radius in BLUSH.items():
            distance = np.linalg.norm(self.place - self.landmarks[landmark], axis=-1)
            haemoglobin += 0.32 * np.exp(-0.5 * (distance / radius) ** 2)
        for name, (more_melanin, more_haemoglobin, more_specular, more_roughness) in REGIONS.items():
            region = self.region(name, softness_mm=0.8 if name == "lips" else 4.0)
            melanin = melanin + more_melanin * region
            haemoglobin = haemoglobin + more_haemoglobin * region
            specular = specular + more_specular * region
            roughness = roughness + more_roughness * region
        return melanin, haemoglobin, specular, roughness

    def _freckles(self) -> np.ndarray:
        """Small dark spots where a coarse pattern allows them, mostly on nose and cheeks."""
        where = self.region("nose", "cheek_left", "cheek_right", "forehead", softness_mm=6) * 0.8 + 0.2
        spots = np.clip(self.noise(2.4) - 1.1, 0, 1) * np.clip(0.6 + 0.5 * self.noise(25), 0, 1)
        return 0.22 * spots * where

    def _moles(self) -> np.ndarray:
        """A handful of single dark spots on cheeks, chin, forehead and neck."""
        inside = self.inside("cheek_left", "cheek_right", "chin", "forehead", "neck")
        places = self.place[inside]
        moles = np.zeros((self.size, self.size))
        for index in self._rng.integers(len(places), size=7):
            distance = np.linalg.norm(self.place - places[index], axis=-1)
            moles += self._rng.uniform(0.16, 0.44) / (1 + (distance / self._rng.uniform(0.6, 1.3)) ** 6)
        return moles

    def _hair(self, complexion: Complexion) -> tuple[np.ndarray, np.ndarray]:
        """[size, size] shares of the surface that hair covers: cropped hair or stubble, and brows."""
        grain = np.clip(0.93 + 0.12 * self.noise(0.9) + 0.06 * self.noise(5), 0, 1)
        line = np.clip((self.region("scalp", softness_mm=7) - 0.5 + 0.09 * self.noise(2.5)) / 0.35, 0, 1)
        beard = self.region("chin", "jaw", "upper_lip_skin", softness_mm=8) * (1 - self.region("lips", softness_mm=2))
        beard *= np.clip(0.6 + 0.3 * self.noise(12), 0, 1) * np.clip(0.5 + 0.6 * self.noise(1.3), 0, 1)
        cover = complexion.hair * line * grain
        return np.maximum(cover, 0.75 * complexion.stubble * beard), self._brows()

    def _cloth(self) -> np.ndarray:
        """[size, size] share of the surface that the shirt covers: all below a plane that rises to the back."""
        height = self.place[..., 1] - (COLLAR_Y_MM + COLLAR_SLOPE * self.place[..., 2])
        return np.clip(0.5 - height / 4, 0, 1)

    def _brows(self) -> np.ndarray:
        """[size, size] hairs drawn as strokes from the lower outline of each brow, slanting outwards."""
        scale = 4
        canvas = np.zeros((self.size * scale, self.size * scale), np.uint8)
        for brow in (BROW_RIGHT, BROW_LEFT):
            upper, lower = self._landmarks_uv(brow[:5]), self._landmarks_uv(brow[:4:-1])
            for along in self._rng.random(420):
                start, end = _along(lower, along), _along(upper, along)
                onwards = _along(upper, max(along - 0.16, 0.0)) - _along(upper, max(along - 0.16, 0.0) + 0.1)
                root = start + (end - start) * self._rng.uniform(-0.05, 0.75)
                slant = np.clip(0.25 + 1.1 * (1 - along), 0.2, 1.2)
                tip = root + (end - start) * 0.35 + onwards * slant * self._rng.uniform(0.6, 1.4)
                line = np.stack([root, tip]) * [self.size, -self.size] + [0, self.size]
                width = max(1, round(0.32 * self._texels_per_mm() * scale))
                cv2.line(canvas, *np.int32(np.round(line * scale)), 255, width, cv2.LINE_8)
        strokes = cv2.resize(canvas, (self.size, self.size), interpolation=cv2.INTER_AREA) / np.float32(255)
        return 0.9 * strokes

    def _eyes(self, albedo: np.ndarray, specular: np.ndarray, roughness: np.ndarray,
              complexion: Complexion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """White of the eye, iris and pupil on the eyeballs, looking straight ahead."""
        eye = self.inside("eyes")
        grain = self.noise(0.8)
        for side in (-1, 1):
            ball = eye & (np.sign(self.place[..., 0]) == side)
            places = self.place[ball]
            centre = 0.5 * (places.min(0) + places.max(0))
            outward = normalised(places - centre)
            radius = np.linalg.norm(places - centre, axis=1).mean() * np.hypot(outward[:, 0], outward[:, 1])
            front = outward[:, 2] > 0
            iris = front * np.clip((IRIS_RADIUS_MM - radius) / 0.6 + 0.5, 0, 1)
            pupil = front * np.clip((PUPIL_RADIUS_MM - radius) / 0.4 + 0.5, 0, 1)
            rim = np.clip(1.15 - 0.5 * (radius / IRIS_RADIUS_MM) ** 4 + 0.25 * grain[ball], 0.2, 2)
            white = np.array([0.62, 0.55, 0.51]) * (1 + 0.03 * grain[ball])[:, None]
            colour = white + iris[:, None] * (np.array(complexion.iris_colour) * rim[:, None] - white)
            albedo[ball] = colour * (1 - pupil)[:, None] + 0.012 * pupil[:, None]
        specular[eye], roughness[eye] = 1.0, 0.24
        return albedo, specular, roughness

    def _landmarks_uv(self, indices: tuple[int, ...]) -> np.ndarray:
        """[N, 2] uv of landmarks."""
        index = list(indices)
        mesh = self._head.mesh
        return interpolate(mesh.uvs, mesh.face_uvs, self._head.landmark_face[index], self._head.landmark_bary[index])

    def _texels_per_mm(self) -> float:
        """Mean resolution of the texture over the face, from the distance between the cheeks' landmarks."""
        uv = self._landmarks_uv((50, 280))
        return float(np.linalg.norm(uv[0] - uv[1]) * self.size
                     / np.linalg.norm(self.landmarks[50] - self.landmarks[280]))


def _along(points: np.ndarray, part: float) -> np.ndarray:
    """Point at a fraction of a polyline's length in vertices: points [N, 2], part in [0, 1]."""
    position = np.clip(part, 0, 1) * (len(points) - 1)
    index = min(int(position), len(points) - 2)
    return points[index] + (points[index + 1] - points[index]) * (position - index)
