"""Phases of a stage: which part of the work a sampled stack belongs to.

A stack is walked from the innermost call outward; the first module that stands in PHASES decides. Modules that serve
several phases (threads, arrays, meshes) do not stand there, so that their time goes to whoever called them. What no
row knows is `other`, and is listed with its functions.
"""

from __future__ import annotations

from collections.abc import Iterable

OTHER, IMPORTS, COMPILED = "other", "imports", "compile loops"
START = "interpreter's start"
CHILDREN, SAMPLER = "child processes", "(the profiler itself)"

PHASES = {
    "shared.io.video": "decode",
    "shared.io.image_sequence": "decode",
    "shared.io.source": "decode",
    "shared.io.pixel_format": "decode",
    "shared.io.plates": "decode",
    "shared.io.frames": "reading pictures",
    "shared.io.images.read": "reading pictures",
    "shared.io.images.load": "reading pictures",
    "shared.io.images.write": "encoding",
    "shared.io.images": "encoding",
    "shared.io.exr_picture": "encoding",
    "shared.io.exr_header": "reading pictures",
    "shared.capture.face_tracker": "landmarks",
    "shared.capture.landmarks": "landmarks",
    "shared.capture.framing": "framing",
    "shared.capture.crop_pixels": "crops",
    "shared.capture": "frame quality and survey",
    "shared.tracking.texture_tracks": "texture tracks",
    "shared.tracking.texture_tracking": "texture tracks",
    "shared.tracking.tracks": "dense tracks",
    "shared.tracking.bundle": "bundle",
    "shared.tracking.depth_noise": "bundle",
    "shared.tracking.motion_prior": "bundle",
    "shared.tracking.pose_uncertainty": "bundle",
    "shared.tracking.pnp": "bundle",
    "shared.tracking.first_poses": "bundle",
    "shared.tracking.focal_search": "bundle",
    "shared.tracking.fit_head": "head fit",
    "shared.tracking.fit_surface": "head fit",
    "shared.tracking.head_model": "head fit",
    "shared.tracking.track_quality": "report",
    "shared.geometry.raycast": "rays",
    "shared.geometry.atlas": "atlas and texels",
    "shared.geometry.mesh_checks": "mesh checks",
    "shared.geometry.intersections": "mesh checks",
    "shared.imaging.texels": "atlas and texels",
    "shared.imaging.texture": "atlas and texels",
    "shared.imaging.image_sampling": "sampling of pictures",
    "shared.imaging.picture_detail": "sampling of pictures",
    "shared.imaging.views": "sampling of pictures",
    "shared.rendering.lobes": "tables of lobes",
    "shared.rendering.specular_transfer": "tables of lobes",
    "shared.rendering.split_sum": "tables of lobes",
    "shared.rendering.transfer": "transfer",
    "shared.rendering.precomputed_transfer": "transfer",
    "shared.rendering.shading": "shading",
    "shared.rendering.envmap": "shading",
    "shared.rendering.normal_derivatives": "fine normals",
    "shared.rendering.render": "re-renders and views",
    "shared.rendering.view_set": "re-renders and views",
    "shared.rendering.views": "re-renders and views",
    "shared.rendering.studio_lights": "re-renders and views",
    "shared.appearance.products": "light and material products",
    "shared.appearance.transport": "light and material products",
    "shared.appearance.preconditioner": "light and material steps",
    "shared.appearance.light_step": "light and material steps",
    "shared.appearance.texture": "texture pass",
    "shared.appearance.texture_pass": "texture pass",
    "shared.appearance.fine_normals": "fine normals",
    "shared.appearance.maps": "texture pass",
    "shared.appearance": "light and material steps",
    "shared.shape.equations": "shape equations",
    "shared.shape.samples": "shape equations",
    "shared.shape": "shape steps",
    "shared.compute.sparse_solve": "factorisation",
    "shared.published": "published solver",
    "shared.report": "report",
    "shared.io.gltf": "export of the asset",
    "shared.io.usd": "export of the asset",
    "shared.io.usdz": "export of the asset",
    "shared.io.usd_material": "export of the asset",
    "shared.io.usd_capture": "export of the asset",
    "shared.io.usd_validate": "export of the asset",
    "shared.io.export_maps": "export of the asset",
    "shared.io.arrays": "arrays and meshes in files",
    "shared.io.meshes": "arrays and meshes in files",
    "shared.contract.hashing": "hashes and records",
    "shared.contract.manifest": "hashes and records",
    "shared.contract.currency": "hashes and records",
    "shared.contract.sums": "hashes and records",
    "shared.contract.shapes": "hashes and records",
    "shared.contract.provenance": "hashes and records",
    "shared.contract.drift": "hashes and records",
    "shared.contract.source": "hashes and records",
    "shared.contract.models": "hashes and records",
}
"""{package, module, module and beginning of a function's name: phase}; the longest that fits decides."""

OTHERS_OF = {"tools.cli": "workflow's start", "snakemake": "workflow's start"}


def phase_of(frames: Iterable[tuple[str, str]]) -> tuple[str, str]:
    """(module, function) of a stack, innermost first -> its phase, and the call that decided (else the innermost)."""
    innermost = None
    for module, function in frames:
        innermost = innermost or f"{module}:{function}"
        if module == "numba.core.dispatcher" and "compile" in function:
            return COMPILED, f"{module}:{function}"
        if module.startswith("importlib._bootstrap") or module.startswith("_frozen_importlib"):
            return IMPORTS, innermost
        if found := _row(module, function):
            return found, f"{module}:{function}"
    return OTHER, innermost or "no Python frame"


def _row(module: str, function: str) -> str | None:
    if function == "<module>":
        return None
    name = f"{module}.{function.lstrip('_').partition('_')[0]}"
    if name in PHASES:
        return PHASES[name]
    while module:
        if found := PHASES.get(module) or OTHERS_OF.get(module):
            return found
        module = module.rpartition(".")[0]
    return None
