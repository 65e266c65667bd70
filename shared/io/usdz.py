"""Packages a USD layer and its textures as .usdz, the same bytes for the same content.

A .usdz is a zip whose members are stored uncompressed with their data aligned to 64 bytes, the root layer
first. USD's own packager stamps the files' modification times into it; this one stamps a constant.

Reference: Usdz file format specification 1.3.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

from pxr import UsdUtils

from shared.errors import LimnError

_ALIGNMENT = 64
_EPOCH = (1980, 1, 1, 0, 0, 0)
_LOCAL_HEADER = 30
_PADDING_ID = 0x1986


def write_usdz(path: Path | str, layer: Path | str) -> None:
    """Packs layer and every file that it names, directly or through other layers, below the layer's folder.

    LimnError when a file is missing or lies outside of that folder.
    """
    layer = Path(layer).resolve()
    layers, assets, unresolved = UsdUtils.ComputeAllDependencies(str(layer))
    if unresolved:
        raise LimnError(f"{path}: files named in {layer.name} are missing: {', '.join(map(str, unresolved))}")
    files = [Path(found.realPath) for found in layers] + [Path(asset) for asset in assets]
    rest = sorted({file.resolve() for file in files} - {layer})
    outside = [file for file in rest if not file.is_relative_to(layer.parent)]
    if outside:
        raise LimnError(f"{path}: outside of the asset's folder: {', '.join(map(str, outside))}")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for file in (layer, *rest):
            _add_aligned(archive, file, file.relative_to(layer.parent).as_posix())


def _add_aligned(archive: zipfile.ZipFile, file: Path, name: str) -> None:
    member = zipfile.ZipInfo(name, _EPOCH)
    member.external_attr = 0o644 << 16
    used = archive.fp.tell() + _LOCAL_HEADER + len(name.encode())
    padding = -used % _ALIGNMENT
    if 0 < padding < 4:
        padding += _ALIGNMENT
    if padding:
        size = padding - 4
        member.extra = _PADDING_ID.to_bytes(2, "little") + size.to_bytes(2, "little") + bytes(size)
    archive.writestr(member, file.read_bytes())
