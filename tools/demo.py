"""The main job on the embedded subject: make a clip with known truth, run it, score the result, say where to look."""

from __future__ import annotations

import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SUBJECT = ROOT / "demo" / "subject"


def main() -> int:
    """Exit code 0 when the run and its scoring went through."""
    from tools.limn import main as limn
    from tools.scoring.score import main as score
    from tools.synthesis.subject import main as synthesize

    began = time.monotonic()
    if not (SUBJECT / "subject.yaml").exists():
        print("Rendering the demo subject: a head that turns, with every truth known ...", flush=True)
        if code := synthesize([str(SUBJECT), "--preset", "demo"]):
            return code
    if code := limn(["run", str(SUBJECT)]):
        return code
    export = SUBJECT / "export"
    print("\nScores against the subject's truth:", flush=True)
    if code := score([str(SUBJECT), str(export)]):
        return code
    print(f"\nDone in {time.monotonic() - began:.0f} s. Open")
    for name, what in (
        ("report.html", "the clip beside the re-render, maps, light, poses"),
        ("head.usda", "the asset, for usdview, Blender, Houdini, Maya"),
        ("maps/diffuse_albedo.exr", "the albedo map"),
    ):
        print(f"  {(export / name).relative_to(ROOT)}  {what}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
