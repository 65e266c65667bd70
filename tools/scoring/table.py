"""Scores as a few aligned lines for people."""

from __future__ import annotations

from shared.geometry.eyeballs import SIDES

GAINS = "{psnr:.1f} dB, with gains {psnr_gain:.1f} dB"
SCALAR = (
    "RMSE {rmse:.3f}, scaled {rmse_scaled:.3f}, correlation {correlation:.2f}, mean {mean_result:.3f} "
    "(truth {mean_gt:.3f})"
)
LIGHT = (
    "relative RMSE matte {irradiance_rel_rmse:.1%}, front {irradiance_front_rel_rmse:.1%}; 25 deg lobe "
    "{lobe25_rel_rmse:.1%}, front {lobe25_front_rel_rmse:.1%}"
)
ALBEDO = "dE2000 median {delta_e2000_median:.2f}, {psnr_srgb:.1f} dB sRGB, {psnr_linear:.1f} dB linear"
CONFIDENT = (
    "confident dE2000 median {delta_e2000_median:.2f}, p99 {delta_e2000_p99:.2f}, within 8 {acceptable:.1%}; "
    "{share:.1%} of the pixels"
)
ALBEDO_NAMES = {"aligned": "aligned  ", "aligned_one_gain": "one gain ", "raw": "raw      "}


def table(scores: dict) -> str:
    """What tools.scoring.score.score returns -> text, one measure a line."""
    lines = _shape_lines(scores) + _appearance_lines(scores) + _label_lines(scores) + _eye_lines(scores)
    width = max(len(name) for name, _ in lines)
    return "\n".join(f"{name:{width}s}  {text}" for name, text in lines)


def _shape_lines(scores: dict) -> list[tuple[str, str]]:
    geometry, pose, own = scores["geometry_mm"], scores["pose"], scores["pose_own_alignment"]
    within, scale = geometry["within_5mm"], scores["alignment"]["scale"]
    frames, depth = pose["frames"], pose["depth_mm_median"]
    return [
        ("geometry", f"{_spread(geometry)} mm, within 5 mm {within:.1%}, scale {scale:.4f}"),
        ("rotation", f"{_spread(pose['rotation_deg'])} deg, without the mesh {_spread(own['rotation_deg'])}"),
        ("translation", f"{_spread(pose['translation_mm'])} mm, depth {depth:.3g} median, {frames} frames"),
        ("normals", f"{_spread(scores['normal_deg'])} deg, coverage {scores['mask_coverage']:.1%}"),
    ]


def _appearance_lines(scores: dict) -> list[tuple[str, str]]:
    lines = []
    if "albedo" in scores:
        lines += [("albedo", title + ALBEDO.format(**scores["albedo"][name])) for name, title in ALBEDO_NAMES.items()]
        if "acceptable" in (confident := scores["albedo"].get("confident", {})):
            lines.append(("albedo", CONFIDENT.format(**confident)))
    if "confident_texels" in scores:
        lines.append(("all texels", _all_texels(scores["confident_texels"])))
    lines += [(name, SCALAR.format(**scores[name])) for name in ("specular", "roughness") if name in scores]
    if "envmap" in scores:
        lines.append(("light", LIGHT.format(**scores["envmap"])))
    if "rerender" in scores:
        lines.append(("re-render", GAINS.format(**scores["rerender"])))
    return lines + [(f"relight {light}", GAINS.format(**value)) for light, value in scores.get("relight", {}).items()]


def _all_texels(texels: dict) -> str:
    """How much of the head is confident and wrong, and the three segments with most of that."""
    worst = ", ".join(f"{name} {part:.1%}" for name, part in list(texels.get("of_segments", {}).items())[:3])
    text = f"confident {texels['share']:.1%}, of these off by dE2000 6 or more {texels['wrong']:.1%}"
    return text + (f" ({worst})" if worst else "")


def _label_lines(scores: dict) -> list[tuple[str, str]]:
    """Intersection over union by label."""
    if "labels" not in scores:
        return []
    own = scores["labels"]
    rows = [(f"labels, {where}", ", ".join(f"{name} {value:.3f}" for name, value in own[where].items()))
            for where in ("texels", "pixels")]
    covered = ", ".join(f"{name} {value:.1%}" for name, value in own["covered"].items())
    if "hair_outline_mm" in scores:
        outline = scores["hair_outline_mm"]
        rows.append(("hair outline", f"off by {_spread(outline)} mm, outwards {outline['outwards']:.3g}, "
                                     f"{outline['frames']} frames"))
    return [*rows, ("labels", f"{own['unknown']:.1%} of the texels unknown; pixels that the mesh covers: {covered}")]


def _eye_lines(scores: dict) -> list[tuple[str, str]]:
    lines, gaze = [], scores.get("gaze")
    if "gaze" in scores and not gaze:
        lines.append(("gaze", "the result has none"))
    elif gaze:
        lines.append(("gaze", _gaze_angles(gaze) if "deg" in gaze else "no open eye in common"))
        shut = gaze["shut"]
        found = f"{shut['recall']:.1%} found" if "recall" in shut else "none in the truth"
        false = f"; {shut['false']:.1%} of open eyes called shut" if "false" in shut else ""
        lines.append(("blinks", f"{shut['eyes']} shut eyes, {found}{false}; {gaze['frames']} frames"))
    if "iris_px" in scores:
        lines.append(("irises", f"centres off by {_spread(scores['iris_px'])} px"))
    if "rerender_eyes" in scores:
        held = scores["rerender_eyes"].get("held_out")
        text = GAINS.format(**scores["rerender_eyes"]) + f", {scores['rerender_eyes']['frames']} frames"
        lines.append(("eyes", text + (f"; held out {GAINS.format(**held)}, {held['frames']} frames" if held else "")))
    if "lid_margins_mm" in scores:
        margins = scores["lid_margins_mm"]
        lines.append(("lids", f"margins off by {_spread(margins)} mm, {margins['openings']} openings"))
    return lines


def _gaze_angles(gaze: dict) -> str:
    eyes = ", ".join(f"{side} mean {gaze[side]['mean']:.3g}" for side in SIDES if side in gaze)
    return f"{_spread(gaze['deg'])} deg ({eyes}), offsets removed {_spread(gaze['deg_centred'])}"


def _spread(values: dict[str, float]) -> str:
    return "median {median:.3g}, mean {mean:.3g}, p95 {p95:.3g}".format(**values)
