"""The tiny subject with the least work in every stage: for tests of what happens around the stages."""

from pathlib import Path

TINY = Path(__file__).resolve().parents[1] / "tiny"
SETTINGS = (
    "track_landmarks.start_frames=8", "track_landmarks.references=1", "track_landmarks.flow_tracks=100",
    "track_landmarks.tracks=100", "track_landmarks.texel_px=2", "track_landmarks.warp_width=100", "init_albedo.size=64",
    "init_albedo.frames=4", "inverse_render.points=200", "inverse_render.directions=128",
    "inverse_render.bounce_nodes=50", "inverse_render.light_resolution=4", "inverse_render.light_frames=4",
    "inverse_render.light_steps=2", "inverse_render.map_size=64", "inverse_render.render_count=1",
    "inverse_render.fit_roughness=false", "inverse_render.shape=false", "export_usd.report_frames=1",
    "export_usd.view_size=64", "export_usd.actions=false", "export_usd.detail=false",
)
QUICK = tuple(word for setting in SETTINGS for word in ("--set", setting))
"""Arguments of `limn run`."""
