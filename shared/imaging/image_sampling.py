"""From frames to samples at surface points: what the camera sees of each point, and what weight it gets.

One frame at a time goes through, so memory does not grow with the clip. A sample is weighted by the square of its view
cosine and by its distance to the mask's border; points close to an occlusion edge count as hidden, since a small pose
or shape error would read another surface there. Clipped and crushed channels are kept and marked: they say "at least"
and "at most" (censored data), which still bounds the model.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy.sparse as sparse

from shared.compute.compiled import compiled
from shared.geometry.mesh import Mesh, face_normals, half_edges, vertex_normals
from shared.geometry.raycast import RAY_START_MM, RayScene
from shared.imaging.color import CLIPPED_CODE, CRUSHED_CODE

MINIMUM_VIEW_COSINE, MAXIMUM_LEAST_COSINE = 0.2, 0.5
BALL_MM = 80.0
"""A head is as round as a ball of this radius where it curves away from the camera."""
BORDER_PX = 3.0
"""Within the mask a pixel counts the more the farther it is from the border, over this distance."""
_REMAP_COLUMNS = 1024


@dataclass(frozen=True)
class Picture:
    """A frame ready for sampling. levels: linear RGB [H, W, 3] and halved copies of it; saturation: of the first, int8
    [H, W, 3], +1 where the channel is clipped, -1 where crushed; inside [H, W]: 0 at the mask's border to 1 within."""

    levels: tuple[np.ndarray, ...]
    saturation: np.ndarray
    inside: np.ndarray

    def dimmed(self, gain: np.ndarray) -> Picture:
        """The same over a gain [3] of its channels."""
        by = (1.0 / gain).astype(np.float32)
        return replace(self, levels=tuple(level * by for level in self.levels))


@dataclass(frozen=True)
class View:
    """A camera's view of V points: pixels [V, 2], depth [V] mm, cosine [V] between normal and view direction,
    towards_camera [V, 3] unit, weight [V] (0: not seen)."""

    pixels: np.ndarray
    depth: np.ndarray
    cosine: np.ndarray
    towards_camera: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class Samples:
    """Colours [P, F, 3] of P points in F frames, weight [P, F] (0: not seen), saturation int8 [P, F, 3] (+1: the truth
    is at least the colour, -1: at most), towards_camera [P, F, 3] unit vectors in head space."""

    colours: np.ndarray
    weight: np.ndarray
    saturation: np.ndarray
    towards_camera: np.ndarray

    def frames(self, index: np.ndarray) -> Samples:
        """The samples of some frames, index [n] int or bool."""
        return Samples(
            self.colours[:, index], self.weight[:, index], self.saturation[:, index], self.towards_camera[:, index]
        )

    def points(self, index: np.ndarray) -> Samples:
        """The samples of some points, index [n] int or bool."""
        return Samples(self.colours[index], self.weight[index], self.saturation[index], self.towards_camera[index])


class SurfaceViewer:
    """A mesh as cameras see it: vertex visibility by rays, eroded by a margin on the surface. Pass after pass looks
    through the same cameras, so what one sees is kept, a bit per vertex.

    layout [V, 3]: where its vertices lie when some of them are chosen to stand for the surface. Of a refined mesh these
    are the places before: its own differ by what the light was solved to, and one that crosses a cell's edge would
    draw all the others anew.
    """

    def __init__(self, mesh: Mesh, scene: RayScene, margin_mm: float = 2.0, layout: np.ndarray | None = None):
        self.mesh, self.scene = mesh, scene
        self.layout = mesh.vertices if layout is None else layout
        self.error_mm, self.least_cosine = 0.0, MINIMUM_VIEW_COSINE
        self.normals = vertex_normals(mesh.vertices, mesh.faces)
        self._vertices, self._normals = mesh.vertices, self.normals
        self._shown: dict[tuple, np.ndarray] = {}
        edges = half_edges(mesh.faces)
        length = np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=1)
        self.rings = max(1, round(margin_mm / float(np.median(length))))
        shape = (len(mesh.vertices),) * 2
        adjacency = sparse.coo_matrix((np.ones(len(edges), np.float32), edges.T), shape=shape).tocsr()
        self._adjacency = adjacency + adjacency.T

    @classmethod
    def of(cls, mesh: Mesh, layout: np.ndarray | None = None) -> SurfaceViewer:
        """With a scene of the mesh alone."""
        return cls(mesh, RayScene(mesh.vertices, mesh.faces), layout=layout)

    def within_rim(self, error_mm: float) -> SurfaceViewer:
        """The same for a surface that may be off by error_mm: it leaves out what is so close to the rim that the
        picture may show there what lies behind. At cosine c a ball of radius R lies R c^2 / 2 within its rim."""
        viewer = copy(self)
        viewer.error_mm, viewer._shown = error_mm, {}
        rim = np.sqrt(4.0 * error_mm / BALL_MM)
        viewer.least_cosine = float(np.clip(rim, MINIMUM_VIEW_COSINE, MAXIMUM_LEAST_COSINE))
        return viewer

    def limited_to(self, index: np.ndarray) -> tuple[SurfaceViewer, np.ndarray]:
        """The same, whose views only have the vertices index [P] and those within the margin of them, and which rows of
        a view the vertices index are."""
        wanted = np.zeros(len(self._vertices), bool)
        wanted[index] = True
        chosen = np.nonzero(self.grown(wanted))[0]
        viewer = copy(self)
        viewer._vertices, viewer._normals, viewer._shown = self._vertices[chosen], self._normals[chosen], {}
        viewer._adjacency = self._adjacency[chosen][:, chosen]
        return viewer, np.searchsorted(chosen, index)

    def view(self, camera_from_head: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]) -> View:
        """All vertices, or those that it is limited to, in one camera. size: (width, height) of the picture, pixels."""
        vertices, normals, count = self._vertices, self._normals, len(self._vertices)
        turn, shift = camera_from_head[:3, :3].astype(np.float64), camera_from_head[:3, 3].astype(np.float64)
        pixels, towards = np.empty((count, 2)), np.empty((count, 3))
        depth, cosine, seen = np.empty(count), np.empty(count), np.empty(count, bool)
        within = np.array([*size, self.least_cosine], np.float64)
        lens = np.asarray(intrinsics, np.float64)
        _look(vertices, normals, turn, shift, -shift @ turn, lens, within, pixels, depth, towards, cosine, seen)
        camera = camera_from_head.tobytes(), intrinsics.tobytes(), tuple(size)
        if camera not in self._shown:
            index = np.nonzero(seen)[0]
            origins = vertices[index] + RAY_START_MM * normals[index]
            covered = np.zeros(count, bool)
            covered[index[self.scene.occluded(origins, towards[index])]] = True
            self._shown[camera] = np.packbits(seen & ~self.grown(covered))
        shown = np.unpackbits(self._shown[camera], count=count).astype(bool)
        weight = np.where(shown, cosine**2, 0.0)
        return View(pixels, depth, cosine, towards, weight.astype(np.float32))

    def grown(self, chosen: np.ndarray) -> np.ndarray:
        """[V] bool: the chosen vertices [V] and their neighbours over the margin."""
        grown = chosen.astype(np.float32)
        for _ in range(self.rings):
            grown = np.minimum(grown + self._adjacency @ grown, 1.0)
        return grown > 0


@compiled
def _look(vertices, normals, turn, shift, centre, lens, within, pixels, depth, towards, cosine, seen):
    """What View says of the vertices [V, 3], and which face the camera within its picture; within: width, height and
    least cosine."""
    width, height, least = within
    for v in range(len(vertices)):
        x, y, z = vertices[v]
        across = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z + shift[0]
        down = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z + shift[1]
        away = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z + shift[2]
        px, py = across / away * lens[0, 0] + lens[0, 2], down / away * lens[1, 1] + lens[1, 2]
        tx, ty, tz = centre[0] - x, centre[1] - y, centre[2] - z
        nearness = 1.0 / np.sqrt(tx * tx + ty * ty + tz * tz)
        towards[v, 0], towards[v, 1], towards[v, 2] = tx * nearness, ty * nearness, tz * nearness
        facing = towards[v, 0] * normals[v, 0] + towards[v, 1] * normals[v, 1] + towards[v, 2] * normals[v, 2]
        pixels[v, 0], pixels[v, 1], depth[v], cosine[v] = px, py, away, facing
        seen[v] = (1.0 < px < width - 1.0) and (1.0 < py < height - 1.0) and away > 0.0 and facing > least


def prepare_picture(codes: np.ndarray, linear: np.ndarray, mask: np.ndarray) -> Picture:
    """codes [H, W, 3] uint8 or uint16, linear [H, W, 3] float32, mask [H, W] (0: background) -> Picture."""
    maximum = np.iinfo(codes.dtype).max
    saturation = (codes >= CLIPPED_CODE * maximum).astype(np.int8) - (codes <= CRUSHED_CODE * maximum).astype(np.int8)
    distance = cv2.distanceTransform((mask > 0).astype(np.uint8), cv2.DIST_L2, 3)
    inside = np.clip((distance - 1.0) / BORDER_PX, 0.0, 1.0)
    levels = [np.ascontiguousarray(linear, np.float32)]
    while min(levels[-1].shape[:2]) >= 64:
        height, width = levels[-1].shape[:2]
        levels.append(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA))
    return Picture(tuple(levels), saturation, inside.astype(np.float32))


def remap(image: np.ndarray, pixels: np.ndarray, interpolation: int = cv2.INTER_LINEAR) -> np.ndarray:
    """image [H, W, ...] at pixels [N, 2] (first centre at 0.5) -> [N, ...]; the border is repeated."""
    count = len(pixels)
    rows = -(-count // _REMAP_COLUMNS)
    grid = np.zeros((rows * _REMAP_COLUMNS, 2), np.float32)
    grid[:count] = pixels - 0.5
    grid = grid.reshape(rows, _REMAP_COLUMNS, 2)
    found = cv2.remap(image, grid[..., 0].copy(), grid[..., 1].copy(), interpolation, borderMode=cv2.BORDER_REPLICATE)
    return found.reshape((rows * _REMAP_COLUMNS,) + image.shape[2:])[:count]


def sample_colours(picture: Picture, pixels: np.ndarray, footprint: np.ndarray | None = None) -> np.ndarray:
    """[N, 2] pixels -> [N, 3] linear RGB. footprint [N]: width in pixels that a sample stands for.

    Footprints up to one pixel are interpolated bicubically; wider ones blend the two nearest levels of the pyramid
    (trilinear), so that a coarse map is filtered instead of aliased.
    """
    colours = np.maximum(remap(picture.levels[0], pixels, cv2.INTER_CUBIC), 0.0)
    if footprint is None or float(footprint.max(initial=0.0)) <= 1.0:
        return colours
    level = np.log2(np.maximum(footprint, 1.0)).astype(np.float32)
    full = np.array(picture.levels[0].shape[1::-1], np.float32)
    for k, image in enumerate(picture.levels[1:]):
        wide = np.nonzero(level > k)[0]
        if len(wide) == 0:
            break
        size = np.array(image.shape[1::-1], np.float32)
        coarse = remap(image, pixels[wide] * (size / full), cv2.INTER_LINEAR)
        blend = np.minimum(level[wide] - k, 1.0)[:, None]
        colours[wide] += blend * (coarse - colours[wide])
    return colours


def is_inactive(saturation, error):
    """Where a clipped or crushed sample, which only knows a bound, says nothing against the model.

    saturation as in Samples; error: model minus sample. Arrays or tensors of one shape -> bool of that shape.
    """
    return ((saturation > 0) & (error >= 0)) | ((saturation < 0) & (error <= 0))


def sample_saturation(saturation: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """A picture's saturation bounds [H, W, 3] at pixels [N, 2] -> int8 [N, 3]: +1 where a pixel that the sample reads
    is clipped, -1 where most are crushed. Bounds as float32 need not be converted."""
    found = remap(saturation.astype(np.float32, copy=False), pixels, cv2.INTER_LINEAR)
    return (found > 0.1).astype(np.int8) - (found < -0.5).astype(np.int8)


def sample_inside(picture: Picture, pixels: np.ndarray) -> np.ndarray:
    """[N, 2] -> [N] float32 weight by distance from the mask's border, 0 outside."""
    return remap(picture.inside, pixels, cv2.INTER_LINEAR)


def sample_points_in_frames(
    viewer: SurfaceViewer, index: np.ndarray, pictures, camera_from_head: np.ndarray, intrinsics: np.ndarray
) -> Samples:
    """Samples of the vertices index [P] in F frames.

    pictures: iterable of F Picture, read once in order; camera_from_head [F, 4, 4]; intrinsics [3, 3] of the pictures,
    or [F, 3, 3] of each.
    """
    shape = (len(index), len(camera_from_head))
    intrinsics = np.broadcast_to(intrinsics, (len(camera_from_head), 3, 3))
    colours, saturation = np.zeros(shape + (3,), np.float32), np.zeros(shape + (3,), np.int8)
    weight, towards = np.zeros(shape, np.float32), np.zeros(shape + (3,), np.float32)
    viewer, index = viewer.limited_to(index)
    for f, picture in enumerate(pictures):
        view = viewer.view(camera_from_head[f], intrinsics[f], picture.inside.shape[::-1])
        towards[:, f] = view.towards_camera[index]
        seen = np.nonzero(view.weight[index] > 0)[0]
        pixels = view.pixels[index[seen]]
        colours[seen, f] = sample_colours(picture, pixels)
        saturation[seen, f] = sample_saturation(picture.saturation, pixels)
        weight[seen, f] = view.weight[index[seen]] * sample_inside(picture, pixels)
    return Samples(colours, weight, saturation, towards)


def texel_size(mesh: Mesh, size: int) -> np.ndarray:
    """[F] edge of a texel of a size x size map on each face, mm: sqrt(area on the surface / area in texels)."""
    a, b, c = (mesh.uvs[mesh.face_uvs[:, k]] * size for k in range(3))
    texels = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    area = 0.5 * np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1)
    return np.sqrt(area / np.maximum(texels, 1e-9))
