"""All that is checked of an export, wherever it lies: by the stage that wrote it and by `limn check` years later.

Each check reads files of the folder and nothing else, and says in sentences what is wrong. What every export has is
missing where it is not there; what may be switched off, or came with a later version, is said not to be checked.
"""

from __future__ import annotations

import contextlib
import zipfile
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
from pxr import Tf, UsdUtils

from shared.errors import InputError, LimnError
from shared.geometry.mesh_checks import mesh_errors, uv_overlap
from shared.io.arrays import load_arrays
from shared.io.export_maps import DISPLACEMENT, HAIR_MAPS, MAPS, map_errors, map_path, read_map
from shared.io.exr_checks import header_errors, header_gaps
from shared.io.exr_header import check_decodable
from shared.io.gltf_validate import glb_errors
from shared.io.images import LARGEST_MAP, read_exr
from shared.io.meshes import read_obj
from shared.io.usd_validate import package_errors, usd_errors

SMALLEST_HEAD_MM, LARGEST_HEAD_MM = 100.0, 800.0
LARGEST_OVERLAP = 1e-3
"""Share of texels that several faces may cover: beyond it, parts of the head show what belongs to others."""
OVERLAP_TEXELS = 1024
"""Edge of the map on which overlap is measured."""
AGAIN = "export again: python -m stages.export_usd --subject SUBJECT --force"
HAIR_OBJ = "hair.obj"
_LAYERS = ("head.usda", "head_payload.usda", "head_geo.usdc", "head_mtl.usda")
_LIGHTS = ("envmap.exr", "envmap_far.exr", "envmaps/*.exr", "views/*_light.exr")
_WITH_ALPHA = ("layers/*.exr", "patches/*.exr")
_RIGID_TOLERANCE = 1e-6
_UNREADABLE = (AttributeError, IndexError, KeyError, OSError, RuntimeError, TypeError, ValueError, LimnError,
               Tf.ErrorException, zipfile.BadZipFile)
"""What the readers of several libraries raise on damaged files."""


@dataclass(frozen=True)
class ExportFault:
    """file: relative to the export. what: the sentence. hint: what to do about it. fatal: nothing with this fault is
    published; else the file can be used, and a person should know."""

    file: str
    what: str
    hint: str = AGAIN
    fatal: bool = True

    def __str__(self) -> str:
        return f"{self.file}: {self.what}"


@dataclass
class CheckedExport:
    """faults; unchecked: what could not be checked, and why; facts: what was found."""

    faults: list[ExportFault] = field(default_factory=list)
    unchecked: list[str] = field(default_factory=list)
    facts: list[str] = field(default_factory=list)


def check_export(
    folder: Path, spoilt: Collection[str] = (), older: bool = False, expected: Collection[str] = ()
) -> CheckedExport:
    """Everything in this module, of the export in folder.

    spoilt: files that are known to be damaged or missing, which are not opened. older: another version wrote it, so
    that what it lacks is said and is no fault. expected: of the files that may be switched off, those that were not.
    """
    checks = _Checks(folder, set(spoilt), older)
    checks.headers()
    checks.of("mesh.obj", checks.mesh)
    hairy = bool(checks.files(HAIR_OBJ, *(map_path(folder, name) for name in HAIR_MAPS)))
    if hairy:
        checks.of(HAIR_OBJ, checks.hair)
    for name in MAPS:
        file = map_path(folder, name)
        # the layers say whether there should be a displacement
        if hairy if name in HAIR_MAPS else name != DISPLACEMENT or checks.files(file):
            checks.of(file, lambda file, name=name: checks.map(file, name))
    checks.map_sizes()
    checks.of("envmap.exr", checks.light)
    checks.of("poses.npz", checks.poses)
    used = [*_LAYERS[1:], *checks.files("maps/*.exr", "envmap*.exr", "plates/*")]
    checks.of("head.usda", checks.usd, used)
    checks.of("head.usdz", checks.usdz, required="head.usdz" in expected)
    checks.of("head.glb", checks.glb, required="head.glb" in expected)
    return checks.found


class _Checks:
    """The checks of one folder, each a method that takes a file and gives sentences, and what they found so far."""

    def __init__(self, folder: Path, spoilt: set[str], older: bool):
        self.folder, self.spoilt, self.older = folder, spoilt, older
        self.unreadable: set[str] = set()
        self.found = CheckedExport()
        self.sizes: dict[str, tuple[int, int]] = {}

    def files(self, *patterns: str) -> list[str]:
        """Names of the files that match, those that are known to be missing too."""
        found = {path.relative_to(self.folder).as_posix() for pattern in patterns
                 for path in self.folder.glob(pattern) if path.is_file()}
        return sorted(found | {name for name in self.spoilt for pattern in patterns
                               if name.count("/") == pattern.count("/") and PurePosixPath(name).match(pattern)})

    def of(self, file: str, check, used: Collection[str] = (), required: bool = True) -> None:
        """Lets check look at the file, if it is there and neither it nor what it uses is spoilt."""
        if damaged := [name for name in (file, *used) if name in self.spoilt]:
            self.leave(file, "not as published" if damaged[0] == file else f"{damaged[0]} is not as published")
        elif file in self.unreadable:
            return
        elif not (self.folder / file).is_file():
            if required and not self.older:
                self.fault(file, "missing")
            else:
                self.leave(file, "not in this export")
        else:
            try:
                for sentence in check(file):
                    self.fault(file, sentence.removeprefix(f"{file}: "))
            except _UNREADABLE as error:
                self.unreadable.add(file)
                what = error.what if isinstance(error, InputError) else " ".join(f"{error}".split())
                self.fault(file, f"cannot be read: {what or type(error).__name__}")

    def leave(self, file: str, why: str) -> None:
        """Says once that a file is not checked."""
        if (sentence := f"{file} ({why})") not in self.found.unchecked:
            self.found.unchecked.append(sentence)

    def fault(self, file: str, what: str, hint: str = AGAIN, fatal: bool = True) -> None:
        self.found.faults.append(ExportFault(file, what, hint, fatal))

    def headers(self) -> None:
        """Of every EXR: channels, colour space, unit, content."""
        maps, lights = {map_path(self.folder, name): name for name in MAPS}, set(self.files(*_LIGHTS))
        layers = set(self.files(*_WITH_ALPHA))
        gaps: dict[str, list[str]] = {}

        def header(file: str) -> list[str]:
            part = check_decodable(self.folder / file, LARGEST_MAP)
            missing = header_gaps(part, maps.get(file, ""), file in lights)
            if missing and self.older:
                gaps[file] = missing
            stated = [f"does not state {', '.join(missing)}"] if missing and not self.older else []
            return stated + header_errors(part, maps.get(file, ""), file in lights, file in layers)

        for file in self.files("*.exr", "*/*.exr"):
            self.of(file, header)
        if gaps:
            names = sorted({name for missing in gaps.values() for name in missing})
            self.found.unchecked.append(f"{', '.join(names)} of {len(gaps)} EXR files (not stated)")

    def mesh(self, file: str) -> Iterator[str]:
        """Indices, positions, UVs, the size of a head; overlap in UV space."""
        mesh = read_obj(self.folder / file)
        if errors := mesh_errors(mesh):
            yield from errors
            return
        size = float(np.ptp(mesh.vertices, axis=0).max())
        if not SMALLEST_HEAD_MM < size < LARGEST_HEAD_MM:
            yield f"{size:.0f} mm is not the size of a head"
        share, (u, v) = uv_overlap(mesh, OVERLAP_TEXELS)
        self.found.facts.append(f"UV overlap {share:.2%}")
        if share > LARGEST_OVERLAP:
            self.fault(file, f"several faces cover {share:.2%} of the texels, about u {u:.2f}, v {v:.2f}",
                       "lay out the UVs anew: what faces share, all of them show", fatal=False)

    def hair(self, file: str) -> list[str]:
        """Indices, positions, UVs."""
        mesh = read_obj(self.folder / file)
        self.found.facts.append(f"hair of {len(mesh.faces)} faces")
        return mesh_errors(mesh)

    def map(self, file: str, name: str) -> list[str]:
        """Shape and values of one map."""
        values = read_map(self.folder / file, name)
        # the displacement needs no more texels than the mesh has vertices for, hair has an atlas of its own
        if name not in (DISPLACEMENT, *HAIR_MAPS):
            self.sizes[file] = values.shape[1], values.shape[0]
        return map_errors(name, values)

    def map_sizes(self) -> None:
        """All maps are of one size: one atlas for all."""
        sizes = sorted(set(self.sizes.values()))
        if len(sizes) == 1:
            self.found.facts.append(f"{len(self.sizes)} maps of {sizes[0][0]} px")
        elif sizes:
            common = max(sizes, key=lambda size: sum(own == size for own in self.sizes.values()))
            for file, size in self.sizes.items():
                if size != common:
                    self.fault(file, f"{size[0]} x {size[1]}, other maps {common[0]} x {common[1]}")

    def light(self, file: str) -> list[str]:
        """Radiance is finite, nowhere negative, and somewhere there is light."""
        radiance = read_exr(self.folder / file)
        if not np.isfinite(radiance).all() or radiance.min() < 0.0 or radiance.max() <= 0.0:
            return [f"radiance from {radiance.min():.4g} to {radiance.max():.4g} is no light"]
        return []

    def poses(self, file: str) -> Iterator[str]:
        """Rigid motions, one for each frame, frames in order; a lens that can be."""
        arrays = load_arrays(self.folder / file)
        poses, frames, lens = (np.asarray(arrays[name]) for name in ("camera_from_head", "frame_index", "intrinsics"))
        if poses.ndim != 3 or poses.shape != (len(frames), 4, 4) or len(frames) == 0:
            yield f"camera_from_head is {poses.shape}, expected ({len(frames)}, 4, 4)"
        elif not rigid_motions(poses).all():
            bad = np.nonzero(~rigid_motions(poses))[0]
            yield f"not all poses are rigid: {len(bad)} of {len(poses)}, the first in frame {frames[bad[0]]}"
        if (np.diff(frames) <= 0).any():
            yield "frame_index does not rise"
        if lens.shape != (3, 3) or not np.isfinite(lens).all() or min(lens[0, 0], lens[1, 1]) <= 0.0:
            yield "intrinsics are no lens"

    def usd(self, file: str) -> list[str]:
        """usd-core's validators, the MaterialX definitions, and what both are blind to."""
        with _silent_usd():
            return usd_errors(self.folder / file)

    def usdz(self, file: str) -> list[str]:
        """The same, and what viewers for consumers ask beyond."""
        with _silent_usd():
            return usd_errors(self.folder / file) + package_errors(self.folder / file)

    def glb(self, file: str) -> list[str]:
        """The rules of glTF."""
        return glb_errors(self.folder / file)


@contextlib.contextmanager
def _silent_usd() -> Iterator[None]:
    """USD's own warnings stay off the terminal: the validators say in sentences what they are about."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        delegate.TakeUncoalescedDiagnostics()


def rigid_motions(transforms: np.ndarray) -> np.ndarray:
    """[F, 4, 4] -> [F] bool: a proper rotation and a finite translation above the row 0, 0, 0, 1."""
    rotations = np.nan_to_num(transforms[:, :3, :3], nan=2.0, posinf=2.0, neginf=2.0)
    proper = np.isclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=_RIGID_TOLERANCE).all((1, 2))
    proper &= np.linalg.det(rotations) > 0.0
    return proper & np.isfinite(transforms).all((1, 2)) & (transforms[:, 3] == [0.0, 0.0, 0.0, 1.0]).all(1)
