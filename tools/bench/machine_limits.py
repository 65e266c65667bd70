"""What this machine can do at best: float products, memory, rays, disk. Measured in a few seconds, never assumed.

`python -m tools.bench.machine_limits FOLDER` prints them as JSON; FOLDER is on the disk that counts. Each is the best
of several tries, since other work can only slow them down. A process of its own, so that the library of matrix products
has one thread for each of ours.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

from shared.contract.pipeline import REPOSITORY

TRIES = 5
EDGE, COPIED_MB, RAYS, WRITTEN_MB = 1024, 64, 200_000, 64


@dataclass(frozen=True)
class MachineLimits:
    """Of all cores together, but for rays (one core). Memory counts bytes read and bytes written alike."""

    cores: int
    gflops: float
    memory_gb_s: float
    rays_per_core_s: float
    disk_write_mb_s: float
    disk_read_mb_s: float


def measure_limits(folder: Path) -> MachineLimits:
    """The limits, from a process of its own."""
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(REPOSITORY), os.environ.get("PYTHONPATH", "")]))
    command = [sys.executable, "-m", "tools.bench.machine_limits", str(folder)]
    answer = subprocess.run(command, env=environment, cwd=REPOSITORY, check=True, capture_output=True, text=True)
    return MachineLimits(**json.loads(answer.stdout))


def _best_s(work: Callable[[], object], tries: int = TRIES) -> float:
    """The least seconds of several tries."""
    found = []
    for _ in range(tries):
        began = time.perf_counter()
        work()
        found.append(time.perf_counter() - began)
    return min(found)


def _on_all_cores(work: Callable[[int], object], cores: int) -> Callable[[], object]:
    pool = ThreadPoolExecutor(cores)
    return lambda: list(pool.map(work, range(cores)))


def _limits_here(folder: Path) -> MachineLimits:
    import numpy as np

    cores = len(os.sched_getaffinity(0))
    random = np.random.default_rng(0)
    matrices = random.standard_normal((cores, EDGE, EDGE), np.float32)
    products = np.empty_like(matrices)
    product_s = _best_s(_on_all_cores(lambda k: np.matmul(matrices[k], matrices[k], out=products[k]), cores))
    source = np.ones((cores, COPIED_MB << 18), np.float32)
    target = np.empty_like(source)
    copy_s = _best_s(_on_all_cores(lambda k: np.copyto(target[k], source[k]), cores))
    write_s, read_s = _disk_s(folder, random.bytes(WRITTEN_MB << 20))
    return MachineLimits(
        cores=cores,
        gflops=2e-9 * cores * EDGE**3 / product_s,
        memory_gb_s=2e-9 * source.nbytes / copy_s,
        rays_per_core_s=RAYS / _rays_s(),
        disk_write_mb_s=WRITTEN_MB / write_s,
        disk_read_mb_s=WRITTEN_MB / read_s,
    )


def _rays_s() -> float:
    """Rays from points of a bumpy sphere, half of which it covers itself."""
    import numpy as np

    from shared.geometry.raycast import RayScene

    across = np.linspace(0.0, 2.0 * np.pi, 101)[:-1]
    down = np.linspace(0.05, np.pi - 0.05, 60)
    theta, phi = np.meshgrid(down, across, indexing="ij")
    radius = 1.0 + 0.1 * np.sin(5.0 * phi) * np.sin(5.0 * theta)
    unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    vertices = (radius[..., None] * unit).reshape(-1, 3)
    here = (np.arange(59)[:, None] * 100 + np.arange(100)).ravel()
    right = here - here % 100 + (here + 1) % 100
    faces = np.concatenate([np.stack([here, here + 100, right], 1), np.stack([right, here + 100, right + 100], 1)])
    random = np.random.default_rng(0)
    origins = np.repeat(vertices[random.integers(0, len(vertices), RAYS // 500)] * 1.001, 500, axis=0)
    directions = random.standard_normal((RAYS, 3))
    scene = RayScene(vertices, faces)
    return _best_s(lambda: scene.occluded(origins, directions))


def _disk_s(folder: Path, content: bytes) -> tuple[float, float]:
    """Seconds to write and flush, and to read what the system no longer keeps in memory."""
    path = folder / f".disk.{os.getpid()}"

    def write() -> None:
        with open(path, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())

    def read() -> None:
        with open(path, "rb") as file:
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
            file.read()

    try:
        return _best_s(write, 3), _best_s(read, 3)
    finally:
        path.unlink(missing_ok=True)


if __name__ == "__main__":
    print(json.dumps(asdict(_limits_here(Path(sys.argv[1])))))
