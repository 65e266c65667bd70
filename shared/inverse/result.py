"""What inverse rendering of a clip returns, by whichever solver."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shared.appearance.fit import Solution
from shared.appearance.texture import TexelMaterial
from shared.geometry.mesh import Mesh
from shared.hair.joined import HairSurface
from shared.imaging.image_sampling import SurfaceViewer
from shared.imaging.turning_eyes import TurningEyes
from shared.imaging.views import Views
from shared.rendering.shading import VertexShading


@dataclass(frozen=True, eq=False)
class SolvedTexels:
    """The texels' material, maps by name, the head's mesh, what its vertices show [V, len(LABELS)], the viewer and the
    shading of what is seen in the frames: the head and, where it stands off, hair after it; eyes of that, None: they do
    not turn; hair, None: it has no surface of its own."""

    material: TexelMaterial
    maps: dict[str, np.ndarray]
    mesh: Mesh
    materials: np.ndarray
    viewer: SurfaceViewer
    shading: VertexShading
    eyes: TurningEyes | None = None
    hair: HairSurface | None = None


@dataclass(frozen=True, eq=False)
class InverseResult:
    """solution of the appearance fit, the texels solved under it, the views with their poses and which were fitted, and
    what is worth recording; covariance [F, 6, 6] of poses that were tracked again, None: they are as they were given.
    """

    solution: Solution
    texels: SolvedTexels
    views: Views
    record: dict
    covariance: np.ndarray | None = None
