"""The head's outline met: the mesh moved so that its occluding contour lies where the frames show that the head ends.

Before the shape is solved the unknown is a displacement of the vertices of the mesh before its last subdivision, smooth
as large steps are, so that ears and skull, which no track and little shading reaches, move as a whole. In the shape's
own steps the face's edges are one more statement on the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse

from shared.compute.run_context import SILENT, RunContext
from shared.compute.sparse_solve import factorised
from shared.geometry.mesh import Mesh, loop_subdivision, vertex_normals
from shared.imaging.views import Views
from shared.shape.occluding_contour import ContourSettings, OccludingContour, Outlined, Outlines, occluding_contour
from shared.shape.step import large_step_metric

FARTHEST_SIGMAS = 8.0
MOST_WORSE = 1
"""Steps in a row after which held-out frames may fit worse: a new part of the outline may have come near an edge."""
LEAST_MET = 2.0 / 3.0
"""Share of the outline that has to have a border within reach. Where hair or a hat makes the border, a part of it comes
near by chance, and the head would grow out to meet it. Long hair leaves 0.16 and 0.59, bare and cropped heads over 0.7.
"""


def fit_outline(
    mesh: Mesh,
    outlined: Outlined,
    views: Views,
    settings: ContourSettings,
    context: RunContext = SILENT,
) -> tuple[Mesh, dict]:
    """The mesh moved so that its outline meets the face's edges in the views' pictures and the borders of their masks,
    as long as that helps held-out frames, and a record of the mean distances in px.

    mesh: one that was subdivided. Where too little of the outline has a border near, only edges count.
    """
    spread, parents = _before_subdivision(mesh)
    prior = large_step_metric(parents, spread.shape[1], settings.smoothness, settings.sigma_mm)
    prior = prior + sparse.diags(outlined.vertices_known_mm(mesh)[: spread.shape[1]] ** -2.0)
    start, moved, note = mesh.vertices, np.zeros((spread.shape[1], 3)), context.note
    outlines = Outlines.of(views)
    contour = occluding_contour(mesh, outlined, views, outlines, settings)
    bordered = contour.met >= LEAST_MET
    if not bordered:
        note(f"outline: {contour.met:.0%} of it lies near the masks' borders: they are not the head's")
        contour = occluding_contour(mesh, outlined, views, outlines, settings, bordered)
    if not len(contour.frame):
        return mesh, {"met": contour.met}
    first = best = _mean_distance(contour, views.fitted, settings)
    worse = 0
    for _ in range(settings.rounds):
        moved = moved + _step(spread, prior, moved, contour, views.fitted, settings)
        trial = mesh.replace(vertices=start + spread @ moved)
        contour = occluding_contour(trial, outlined, views, outlines, settings, bordered)
        now = _mean_distance(contour, views.fitted, settings)
        note(
            f"outline: {best[0]:.2f} -> {now[0]:.2f} px fitted, {best[1]:.2f} -> {now[1]:.2f} px held out, "
            f"{contour.on_edge.sum()} of {len(contour.frame)} points on edges in the picture"
        )
        if now[1] < best[1]:
            mesh, best, worse = trial, now, 0
        elif (worse := worse + 1) > MOST_WORSE:
            break
    pairs = zip(("fitted_px", "held_out_px"), first, best, strict=True)
    return mesh, {"met": contour.met} | {name: {"before": before, "after": after} for name, before, after in pairs}


@dataclass(frozen=True, eq=False)
class FaceOutline:
    """The face's edges in the views' pictures as a statement on its surface; outlined: of the mesh before it is
    subdivided."""

    outlined: Outlined
    views: Views
    outlines: Outlines
    settings: ContourSettings

    def terms(self, mesh: Mesh) -> tuple[sparse.csr_matrix, np.ndarray]:
        """Hessian [V, V] and gradient [V] of the squared distances by offsets of the vertices along their normals."""
        outlined = self.outlined.subdivided(len(mesh.faces))
        contour = occluding_contour(mesh, outlined, self.views, self.outlines, self.settings, bordered=False)
        used = self.views.fitted[contour.frame]
        normals = vertex_normals(mesh.vertices, mesh.faces)
        lift = np.einsum("nx,nex->ne", contour.slope[used], normals[contour.edge[used]])
        rows = contour.ends(used, lift, len(mesh.vertices))
        weighted = rows.T @ sparse.diags(contour.weight(self.settings)[used])
        return (weighted @ rows).tocsr(), weighted @ contour.distance[used]


def _before_subdivision(mesh: Mesh) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Loop's matrix [V, C] from the vertices before the last subdivision, which come first, and their faces [F / 4, 3];
    a mesh that none made stands for itself."""
    if len(mesh.faces) % 4 == 0:
        children = mesh.faces.reshape(-1, 4, 3)
        parents = np.stack([children[:, k, k] for k in range(3)], axis=1)
        spread, faces = loop_subdivision(parents, int(parents.max()) + 1)
        if np.array_equal(faces, mesh.faces):
            return spread, parents
    return sparse.identity(len(mesh.vertices), format="csr"), mesh.faces


def _step(spread, prior, moved, contour: OccludingContour, fitted: np.ndarray, settings: ContourSettings) -> np.ndarray:
    """Change [C, 3] of the displacement moved [C, 3] of the vertices before the subdivision."""
    used = fitted[contour.frame]
    at = contour.ends(used, np.ones((int(used.sum()), 2)), spread.shape[0]) @ spread
    rows = sparse.hstack([sparse.diags(contour.slope[used, k]) @ at for k in range(3)]).tocsr()
    weighted = rows.T @ sparse.diags(contour.weight(settings)[used])
    matrix = weighted @ rows + sparse.block_diag([prior] * 3)
    gradient = weighted @ contour.distance[used] + (prior @ moved).T.ravel()
    return factorised(matrix).solve(-gradient).reshape(3, -1).T


def _mean_distance(contour: OccludingContour, fitted: np.ndarray, settings: ContourSettings) -> tuple[float, float]:
    """Robust mean distance from border or edge in fitted and in held-out frames, px; 0 where none is near."""
    bounded = np.minimum(np.abs(contour.distance), FARTHEST_SIGMAS * contour.sigma_px(settings))
    values = (bounded[chosen[contour.frame]] for chosen in (fitted, ~fitted))
    return tuple(float(value.mean()) if len(value) else 0.0 for value in values)
