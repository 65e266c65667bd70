"""Which views of a solved head there are, apart from the code that renders them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

NOVEL_VIEWS = {"left": (-50.0, 0.0), "right": (50.0, 0.0), "above": (0.0, 30.0), "below": (0.0, -25.0)}
"""name -> yaw and pitch of the camera in degrees; right is the picture's right of a face seen from the front."""
ROUGHNESSES = (0.1, 0.3, 0.5, 0.8)


@dataclass(frozen=True)
class ViewCamera:
    """camera_from_head [4, 4] mm, intrinsics [3, 3] px of a picture of size (width, height); gaze [2, 2] radians: how
    the eyeballs are turned in the head that it looks at, None: straight ahead; lids [2]: how far its right and left eye
    are shut, None: as the mesh has them; gain [3]: of its exposure, None: 1; pitch [2] radians: how far these eyes look
    up from where they do with lids at rest, None: not at all."""

    camera_from_head: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]
    gaze: np.ndarray | None = None
    gain: np.ndarray | None = None
    lids: np.ndarray | None = None
    pitch: np.ndarray | None = None


@dataclass(frozen=True)
class ViewSet:
    """Pictures [h, w, 3], linear, 0 beside the head: novel {name of NOVEL_VIEWS} under the clip's light, relit {name of
    studio_lights.STUDIO_LIGHTS}, all seen by relit_camera; visibility {roughness: [h, w], NaN beside the head};
    held_out {frame: re-render of a crop of the clip that took no part in the fit}."""

    novel: dict[str, np.ndarray]
    relit: dict[str, np.ndarray]
    visibility: dict[float, np.ndarray]
    held_out: dict[int, np.ndarray]
    relit_camera: ViewCamera
