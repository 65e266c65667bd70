"""A small export with its records, as export_usd publishes it, for what looks into exports."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from toy_result import ToyJob, toy_eyed_surface, write_toy_work

from shared.contract.sums import write_sums
from shared.geometry.surface import Surface
from shared.io.arrays import read_json, write_json
from shared.io.meshes import save_mesh
from stages import export_usd


def unfolded(surface: Surface) -> Surface:
    """Without the faces that span the map from side to side: what is left overlaps nowhere in UV space."""
    across = np.ptp(surface.mesh.uvs[surface.mesh.face_uvs][..., 0], axis=1)
    kept = across < 0.12
    mesh = surface.mesh.replace(faces=surface.mesh.faces[kept], face_uvs=surface.mesh.face_uvs[kept])
    return Surface(mesh, surface.face_segment[kept], surface.segment_names)


LAMP = {"near": True, "position_mm": [-500.0, 160.0, 300.0], "radius_mm": 35.0, "radiance": [8.0, 4.0, 2.0]}


def write_toy_export(base: Path, lamp: bool = False, hair: bool = False, **parameters) -> Path:
    """Exports the head with two eyes into base/export -> that folder, with manifest.json and SHA256SUMS. lamp: one
    stands near; hair: some stands off the head."""
    work = write_toy_work(base / "work", eyes=True, hair=hair)
    surface = unfolded(toy_eyed_surface())
    arrays = {"face_segment": surface.face_segment}
    save_mesh(work / "inverse_render" / "mesh.npz", surface.mesh, **arrays)
    if lamp:
        solved = work / "inverse_render"
        write_json(solved / "solve.json", read_json(solved / "solve.json") | {"lamp": LAMP})
        shutil.copy(solved / "envmap.exr", solved / "envmap_far.exr")
    job = ToyJob(work, base / "export", **parameters)
    export_usd.run(job)
    export_usd.check(job)
    write_json(job.out / "manifest.json", {"stage": "export_usd", "version": export_usd.STAGE.version})
    write_sums(job.out)
    return job.out
