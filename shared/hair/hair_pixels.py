"""Which pixels of a frame show hair, skin or cloth, beyond the head's mesh, too.

Inside the mesh's outline its materials say what a pixel is most likely to show, but for ears and neck, which hair may
hang before. Beside it a person above the chin is hair, and below the chin may be cloth as well; there colours decide:
histograms of this clip's hair (what grows on the scalp, and what lies beside the head), of its skin, and of what is
neither below the chin, which is fitted to it (expectation maximisation, [Dempster1977]). Likelihoods are smoothed along
the picture's edges by a guided filter [He2013].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from shared.geometry.mesh import normalised
from shared.geometry.raycast import camera_hits, pixel_directions
from shared.geometry.surface import Surface
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.material_labels import CLOTH, CLOTH_BELOW_MM, HAIR, LABELS, SKIN, UNKNOWN
from shared.imaging.views import Views

KINDS = HAIR_PIXEL, SKIN_PIXEL, CLOTH_PIXEL = 0, 1, 2
BINS, BLUR = 32, 1.0
"""Of the histograms along each channel of the square root of radiance, and how far colours spread, bins."""
UNSEEN, ANY_CLOTH = 2e-6, 0.1
"""Density that no colour falls below, and share of cloth that may have any colour."""
SURE, MARGIN_PX = 0.8, 4
"""Probability from which on a vertex's material is learnt from, and how far within the mesh's outline."""
ABOVE, BELOW, BETWEEN = (0.98, 0.02, 0.0), (0.43, 0.12, 0.45), (0.05, 0.5, 0.45)
"""Hair, skin and cloth beside the head: above the chin, where cloth is as likely as it gets, and there below the neck.
"""
NARROWER = 0.7, 1.1
"""Share of the neck's half width up to which a pixel is below it, and from which on it is not."""
BEFORE = (0.45, 0.45, 0.1)
"""The same before ears and neck, as far as their own materials are not believed."""
BARE, GROWN = (0.08, 0.8, 0.12), (0.8, 0.18, 0.02)
"""The same of what the materials leave open, and where that is scalp."""
BEARD, BESIDE_CHIN = (0.1, 0.3), ("jaw", "cheek_left", "cheek_right")
"""Share of hair on the chin up to which there is no beard, and from which on there is one; what it grows on, too."""
BELIEVED = 0.3
THROAT = 0.1
"""How far the materials are believed that the throat is hair: in the chin's shade skin looks like it."""
FRONT_OF_NECK = 0.3, 0.6
"""Cosine of the azimuth about the neck, 1 straight ahead, up to which hair may well hang before it, and from which on
it doesn't."""
ROUNDS, LEARNT_FRAMES, EVERY = 20, 12, 3
LEAST_LOG = -6.0
EDGE_PX, EDGE_CONTRAST = 5, 1e-4
"""Radius of the guided filter, and variance of the square root of radiance from which on it keeps an edge."""


@dataclass(frozen=True, eq=False)
class SeenPixels:
    """A frame before it is told apart: root [H, W, 3] of its radiance; person, mesh [H, W] bool; of the mesh there the
    share of each kind [H, W, 3], and whether hair may hang before it [H, W]; low [H, W]: how likely cloth is, 0 to 1,
    by the height below the chin; middle [H, W]: how far a pixel is in the neck's width, 0 to 1; hair, skin [H, W]: how
    sure that is of the mesh there; beard [H, W]: how much of the hair there grows on the face."""

    root: np.ndarray
    person: np.ndarray
    mesh: np.ndarray
    kinds: np.ndarray
    open: np.ndarray
    low: np.ndarray
    middle: np.ndarray
    hair: np.ndarray
    skin: np.ndarray
    beard: np.ndarray


class HairPixels:
    """Tells the pixels of a clip's frames apart. surface: with segments; viewer: of its mesh; materials [V,
    len(LABELS)]: of its vertices; centre [3] mm: within the head, as deep as pixels beside it are taken to be."""

    def __init__(self, viewer: SurfaceViewer, surface: Surface, materials: np.ndarray, views: Views,
                 centre: np.ndarray):
        self.viewer, self.views, self.centre = viewer, views, centre
        chin = viewer.mesh.faces[surface.faces_of(("chin",))]
        self.chin_mm = float(viewer.mesh.vertices[chin, 1].min())
        self.neck_mm = float(np.abs(viewer.mesh.vertices[surface.vertices_of(("neck",)), 0]).max())
        self._vertices = _shown_by_vertices(viewer, surface, materials, centre)
        self.colours = np.full((len(KINDS), *(BINS,) * 3), 1.0 / BINS**3)

    def learn(self, frames: Sequence[int]) -> None:
        """The clip's colours of each kind, by some of the frames."""
        counts = np.zeros((len(KINDS), *(BINS,) * 3))
        for f in frames[:: max(1, len(frames) // LEARNT_FRAMES)]:
            seen = self._seen(f)
            inside = _eroded(seen.mesh) & seen.person
            beside = seen.person & ~_dilated(seen.mesh)
            shows = ((inside & (seen.hair > SURE)) | (beside & (seen.low == 0.0)), inside & (seen.skin > SURE),
                     beside & (seen.low > 0.99))
            for kind, where in enumerate(shows):
                counts[kind] += _histogram(seen.root[where][::EVERY])
        hair, skin = _density(counts[HAIR_PIXEL]), _density(counts[SKIN_PIXEL])
        cloth, share = np.full_like(hair, 1.0 / hair.size), np.array([0.3, 0.2, 0.5])
        for _ in range(ROUNDS):
            wide = (1.0 - ANY_CLOTH) * cloth + ANY_CLOTH / hair.size
            parts = np.stack([weight * part for weight, part in zip(share, (hair, skin, wide), strict=True)])
            belongs = counts[CLOTH_PIXEL] * parts / np.maximum(parts.sum(0), 1e-300)
            cloth, share = _density(belongs[CLOTH_PIXEL]), belongs.sum((1, 2, 3)) + 1.0
            share /= share.sum()
        self.colours = np.stack([hair, skin, cloth])

    def probabilities(self, f: int) -> tuple[np.ndarray, np.ndarray]:
        """[H, W, 3] float32: probability of hair, skin and cloth in frame f, 0 of all beside the person; and [H, W]
        bool: where the mesh is."""
        seen = self._seen(f)
        bins = np.minimum((seen.root * BINS).astype(int), BINS - 1)
        likelihood = np.moveaxis(self.colours[:, bins[..., 0], bins[..., 1], bins[..., 2]], 0, -1) + UNSEEN
        above, below, between, before = (np.array(shares, np.float32) for shares in (ABOVE, BELOW, BETWEEN, BEFORE))
        below = below + seen.middle[..., None] * (between - below)
        prior = above + seen.low[..., None] * (below - above)
        believed = (BELIEVED + (1.0 - BELIEVED) * (1.0 - seen.open))[..., None]
        own = believed * seen.kinds + (1.0 - believed) * before
        prior = np.where(seen.mesh[..., None], 0.9 * own + 0.1 / len(KINDS), prior)
        told = np.log(np.maximum(prior * likelihood, 1e-30))
        told = np.maximum(told - told.max(-1, keepdims=True), LEAST_LOG).astype(np.float32)
        guide = seen.root.mean(-1)
        smooth = [cv2.ximgproc.guidedFilter(guide, np.ascontiguousarray(told[..., k]), EDGE_PX, EDGE_CONTRAST)
                  for k in KINDS]
        raised = np.exp(np.stack(smooth, -1))
        found = raised / raised.sum(-1, keepdims=True) * seen.person[..., None]
        grown = seen.beard * found[..., HAIR_PIXEL]  # as the head's own surface has it
        found[..., HAIR_PIXEL] -= grown
        found[..., SKIN_PIXEL] += grown
        return found, seen.mesh

    def _seen(self, f: int) -> SeenPixels:
        views, mesh = self.views, self.viewer.mesh
        pose, lens = views.camera_from_head[f], views.intrinsics[f]
        root = np.sqrt(np.clip(views.picture(f).levels[0], 0.0, 1.0))
        height, width = root.shape[:2]
        face, bary, _ = camera_hits(self.viewer.scene, pose, lens, width, height)
        hit = face >= 0
        values = np.zeros((height, width, self._vertices.shape[1]), np.float32)
        values[hit] = np.einsum("nk,nkc->nc", bary[hit], self._vertices[mesh.faces[face[hit]]])
        depth = float((pose[:3, :3] @ self.centre + pose[:3, 3])[2])
        place = depth * pixel_directions(lens, width, height) - pose[:3, 3]
        up, across = place @ pose[:3, 1], np.abs(place @ pose[:3, 0])
        inner, outer = NARROWER
        middle = np.clip((outer - across / self.neck_mm) / (outer - inner), 0.0, 1.0).astype(np.float32)
        start, end = CLOTH_BELOW_MM
        low = np.clip((self.chin_mm - up - start) / (end - start), 0.0, 1.0).astype(np.float32)
        person = _largest_part(views.mask(f) > 0)
        kinds, (before, hair, skin, beard) = values[..., :3], np.moveaxis(values[..., 3:], -1, 0)
        return SeenPixels(root, person, hit, kinds, before, low, middle, hair, skin, beard)


def _shown_by_vertices(viewer: SurfaceViewer, surface: Surface, materials: np.ndarray, centre: np.ndarray
                       ) -> np.ndarray:
    """[V, 7] float32 of the mesh's vertices: share of each kind, what is not known filled in by the topology and the
    throat's shade not taken for hair; whether hair may hang before it; how sure hair is, and skin; and how much of the
    hair there is beard: all of it on chin and lip, and, of a chin with a beard, on jaw, cheeks and throat."""
    known = np.maximum(1.0 - materials[:, [UNKNOWN]], 1e-3)
    other = [label for label in range(len(LABELS)) if label not in (UNKNOWN, HAIR, CLOTH)]
    told = np.stack([materials[:, HAIR], materials[:, other].sum(1), materials[:, CLOTH]], 1) / known
    ears, neck, scalp = (surface.vertices_of((name,)) for name in ("ears", "neck", "scalp"))
    back, front = FRONT_OF_NECK
    around = normalised((viewer.mesh.vertices - centre) * [1.0, 0.0, 1.0])
    aside = np.clip((front - around[:, 2]) / (front - back), 0.0, 1.0)
    kinds = known * told + (1.0 - known) * np.where(scalp[:, None], GROWN, BARE)
    shaded = (1.0 - THROAT) * np.where(neck, 1.0 - aside, 0.0) * kinds[:, HAIR_PIXEL]
    kinds[:, HAIR_PIXEL] -= shaded
    kinds[:, SKIN_PIXEL] += shaded
    before = np.where(ears, 1.0, aside * neck)
    hair = np.where(known[:, 0] > 0.5, told[:, HAIR_PIXEL], 0.0)
    chin, lip, beside = (surface.vertices_of(names) for names in (("chin",), ("upper_lip_skin", "lips"), BESIDE_CHIN))
    least, most = BEARD
    of_chin = float((known[chin, 0] * told[chin, HAIR_PIXEL]).sum() / max(known[chin].sum(), 1e-6))
    bearded = np.clip((of_chin - least) / (most - least), 0.0, 1.0)
    beard = np.where(chin | lip, 1.0, bearded * np.maximum(beside, neck * (1.0 - aside)))
    return np.column_stack([kinds, before, hair, materials[:, SKIN] / known[:, 0], beard]).astype(np.float32)


def _histogram(colours: np.ndarray) -> np.ndarray:
    """[N, 3] in 0 .. 1 -> counts [BINS, BINS, BINS]."""
    bins = np.minimum((colours * BINS).astype(int), BINS - 1)
    return np.bincount(bins @ [BINS**2, BINS, 1], minlength=BINS**3).reshape((BINS,) * 3).astype(float)


def _density(counts: np.ndarray) -> np.ndarray:
    """Counts [BINS, BINS, BINS] -> blurred, of sum 1."""
    blurred = gaussian_filter(counts, BLUR) + 1e-9
    return blurred / blurred.sum()


def _largest_part(mask: np.ndarray) -> np.ndarray:
    """[H, W] bool: the largest connected part of a mask [H, W]; people in the background fall away."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    return mask if len(stats) < 2 else labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))


def _eroded(mask: np.ndarray) -> np.ndarray:
    return cv2.erode(mask.astype(np.uint8), np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)).astype(bool)


def _dilated(mask: np.ndarray) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)).astype(bool)
