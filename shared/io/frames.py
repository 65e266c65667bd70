"""The cropped frames that sample_frames publishes, as the later stages read them: one at a time."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shared.errors import InputError
from shared.imaging.color import decode_transfer
from shared.io.arrays import read_json
from shared.io.images import read_png

_FILE = re.compile(r"(frames|masks)/\d{6,9}\.png")


@dataclass(frozen=True)
class FrameSet:
    """F frames of one clip, cropped: u_crop = (u_source - x0) * scale, pixel centres at integer + 0.5.

    frame_index [F] counts the source's frames; intrinsics [3, 3] belong to the crop, intrinsics_source to the full
    frame; size and source_size are (width, height). chart: what a colour chart says, see ChartWatch.record;
    grey: what a grey place does, see GreyWatch.record, None without one.
    """

    folder: Path
    files: tuple[str, ...]
    mask_files: tuple[str, ...]
    frame_index: np.ndarray
    time_s: np.ndarray
    fps: float
    size: tuple[int, int]
    source_size: tuple[int, int]
    source_name: str
    crop: tuple[float, float, float]
    intrinsics: np.ndarray
    intrinsics_source: np.ndarray
    focal_known: bool
    transfer: str
    moves: str
    chart: tuple[dict, ...] = ()
    grey: dict | None = None

    @classmethod
    def open(cls, folder: Path | str) -> FrameSet:
        """Reads frames.json. InputError when it is missing."""
        folder = Path(folder)
        content = read_json(folder / "frames.json")
        frames, source, crop = content["frames"], content["source"], content["crop"]
        names = [(frame["file"], frame["mask"]) for frame in frames]
        for name in [name for pair in names for name in pair]:
            if not _FILE.fullmatch(name):
                raise InputError("not the name of a sampled frame", where=str(folder / "frames.json"), got=name,
                                 hint="remove the folder and run again")
        return cls(
            folder=folder,
            files=tuple(file for file, _ in names),
            mask_files=tuple(mask for _, mask in names),
            frame_index=np.array([frame["frame_index"] for frame in frames], np.int64),
            time_s=np.array([frame["time_s"] for frame in frames]),
            fps=float(source["fps"]),
            size=tuple(content["size"]),
            source_size=(source["width"], source["height"]),
            source_name=source["name"],
            crop=(crop["x0"], crop["y0"], crop["scale"]),
            intrinsics=np.array(content["intrinsics"]),
            intrinsics_source=np.array(content["intrinsics_source"]),
            focal_known=content["focal_known"],
            transfer=content["transfer"],
            moves=content["moves"],
            chart=tuple(content.get("chart", ())),
            grey=content.get("grey"),
        )

    @property
    def count(self) -> int:
        """F, the number of frames."""
        return len(self.files)

    def read_codes(self, i: int) -> np.ndarray:
        """Frame i as stored: [H, W, 3] RGB code values, uint8 or uint16."""
        return read_png(self.folder / self.files[i])

    def read_linear(self, i: int) -> np.ndarray:
        """Frame i with the transfer function undone: float32 [H, W, 3], 1 is the code maximum."""
        codes = self.read_codes(i)
        maximum = np.iinfo(codes.dtype).max
        table = decode_transfer(np.arange(maximum + 1) / maximum, self.transfer)
        return table[codes]

    def read_mask(self, i: int) -> np.ndarray:
        """uint8 [H, W]: 0 background, 128 person, 255 face."""
        return read_png(self.folder / self.mask_files[i])

    def position(self, frame_index: int) -> int:
        """Where a source frame stands in this set. KeyError when it was not sampled."""
        found = np.nonzero(self.frame_index == frame_index)[0]
        if len(found) == 0:
            raise KeyError(f"source frame {frame_index} is not among the sampled frames")
        return int(found[0])
