"""The tiny subject: twelve frames of 144 px of a synthetic head, and parameters with which a stage takes seconds."""

from __future__ import annotations

from pathlib import Path

from tools.goldens.kernels import REPOSITORY

TINY_SUBJECT = REPOSITORY / "tests" / "tiny"
GOLDEN_FOLDER = REPOSITORY / "tests" / "golden"
STAGES = ("sample_frames", "track_landmarks", "init_albedo", "inverse_render", "export_usd")
SETTINGS: dict[str, tuple[str, ...]] = {
    "init_albedo": ("size=128",),
    "inverse_render": (
        "model=full",  # a choice could hang on how a processor rounds, and all that follows on the choice
        "map_size=128",
        "light_resolution=8",
        "points=1000",
        "directions=384",
        "bounce_nodes=300",
        "shape_subdivisions=0",
        "shape_steps=1",
        "render_count=2",
    ),
    "export_usd": ("view_size=128", "report_frames=2"),
}
"""Parameters that differ from the stages' defaults: all parts of the method take part, each as small as it goes."""


def stage_folder(run_folder: Path, stage: str) -> Path:
    """Where a run keeps one stage's files."""
    return run_folder / "export" if stage == "export_usd" else run_folder / "work" / stage


def run_tiny(destination: Path) -> Path:
    """The tiny subject from clip to export in destination -> the folder with work/ and export/.

    RuntimeError where the run does not end with a result.
    """
    from tools.limn import main as limn

    settings = [f"{stage}.{setting}" for stage, own in SETTINGS.items() for setting in own]
    words = [word for setting in settings for word in ("--set", setting)]
    code = limn(["run", str(TINY_SUBJECT), "--out", str(destination), *words])
    if code not in (0, 3):
        raise RuntimeError(f"the run of the tiny subject ended with exit code {code}")
    return destination / TINY_SUBJECT.name
