"""The frames of a clip, or of several clips of one head in a row, as solvers see them: cameras, lights, pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from shared.imaging.frame_index import frames_of_lights
from shared.imaging.image_sampling import Picture


@dataclass(frozen=True, eq=False)
class Views:
    """F frames of one head.

    camera_from_head [F, 4, 4] mm; intrinsics [F, 3, 3] px of pictures of size (width, height); moves: "head" or
    "camera", what moved against the light; light_index [F] int: which light each frame stands in, 0 first, frames of
    one light in a row; fitted [F] bool: the other frames are held out; read_picture(f), read_mask(f): see picture and
    mask; gaze [F, 2, 2] radians: with which the mesh's right and left eyeball show the irises where the pictures do,
    NaN while shut (shared/geometry/eyeballs.py), None: not known, so that eyeballs do not turn; lids_px [F, 2, N, 2]: a
    polygon about what the lids leave open of each eye, NaN where it is not seen, None: as the mesh has it; gain [F, 3]:
    what makes a frame brighter than the still light does, which `picture` takes out, None: nothing does.
    """

    camera_from_head: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]
    moves: str
    light_index: np.ndarray
    fitted: np.ndarray
    read_picture: Callable[[int], Picture]
    read_mask: Callable[[int], np.ndarray]
    gaze: np.ndarray | None = None
    lids_px: np.ndarray | None = None
    gain: np.ndarray | None = None

    @classmethod
    def in_one_light(
        cls,
        camera_from_head: np.ndarray,
        lens: np.ndarray,
        size: tuple[int, int],
        moves: str,
        read_picture: Callable[[int], Picture],
        read_mask: Callable[[int], np.ndarray],
        fitted: np.ndarray | None = None,
        gaze: np.ndarray | None = None,
        lids_px: np.ndarray | None = None,
    ) -> Views:
        """All in one light through one lens [3, 3] px; fitted [F] bool, None: all; the others as of the class."""
        count = len(camera_from_head)
        return cls(
            camera_from_head=camera_from_head,
            intrinsics=np.broadcast_to(lens, (count, 3, 3)),
            size=size,
            moves=moves,
            light_index=np.zeros(count, int),
            fitted=np.ones(count, bool) if fitted is None else fitted,
            read_picture=read_picture,
            read_mask=read_mask,
            gaze=gaze,
            lids_px=lids_px,
        )

    def __len__(self) -> int:
        return len(self.camera_from_head)

    def picture(self, f: int) -> Picture:
        """Frame f, decoded and ready for sampling, as bright as the still light makes it."""
        picture = self.read_picture(int(f))
        return picture if self.gain is None else picture.dimmed(self.gain[f])

    def mask(self, f: int) -> np.ndarray:
        """Frame f's mask [H, W] uint8, 0: background."""
        return self.read_mask(int(f))

    @property
    def px_per_mm(self) -> float:
        """Pixels on a millimetre of the head where it is largest in the pictures."""
        return float(np.max(self.intrinsics[:, 0, 0]) / np.median(self.camera_from_head[:, 2, 3]))

    @property
    def frames_of_lights(self) -> list[np.ndarray]:
        """Of each light, the indices of its frames."""
        return frames_of_lights(self.light_index, len(self))

    def with_fitted(self, fitted: np.ndarray) -> Views:
        """The same with other frames fitted [F] bool."""
        return replace(self, fitted=fitted)

    def take(self, frames: np.ndarray, fitted: np.ndarray | None = None) -> Views:
        """Some frames [K], indices, and which of them are fitted [K] bool; None: those that were."""
        return replace(
            self,
            camera_from_head=self.camera_from_head[frames],
            intrinsics=self.intrinsics[frames],
            light_index=self.light_index[frames],
            fitted=self.fitted[frames] if fitted is None else fitted,
            read_picture=lambda k: self.read_picture(int(frames[k])),
            read_mask=lambda k: self.mask(frames[k]),
            gaze=None if self.gaze is None else self.gaze[frames],
            lids_px=None if self.lids_px is None else self.lids_px[frames],
            gain=None if self.gain is None else self.gain[frames],
        )
