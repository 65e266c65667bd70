"""The methods text: what the records say, nothing else, with references that are there and numbered in order."""

import json
import re

import pytest
from toy_result import ToyJob, write_toy_work

from shared.contract.pipeline import load_pipeline
from shared.report.methods import ClipRecords, RunRecords, methods_paragraphs, methods_text
from shared.report.references import REFERENCES
from stages import export_usd

FRAMES = {"source": {"name": "clip.mp4", "width": 1920, "height": 1080, "fps": 25.0}, "transfer": "srgb",
          "frames": [{}] * 48, "dropped": [{}] * 3,
          "focal_known": True, "intrinsics_source": [[5166.0, 0, 960], [0, 5166, 540], [0, 0, 1]]}
TRACKING = {"tracks": 5000, "frames": 47, "reprojection_px": {"median": 0.1, "p95": 0.3}, "rotation_range_deg": 61.2}
SOLVE = {"residuals": {"fitted": 0.0123, "held_out": 0.0145}, "held_out_frames": [1, 9], "shape": {"refined": True},
         "albedo_scale": {"method": "priors: skin's luminance"}}
SAMPLE_FRAMES = f"sample_frames {load_pipeline().stages['sample_frames'].version}"
PACKAGES = {"limn": "0.1.0", "numpy": "2.4.6", "torch": "2.13.0+cpu", "av": "18.1.0", "usd-core": "26.11"}


def records(clips=("",), solve=SOLVE, packages=PACKAGES, given=(), **settings):
    """The records of a run with the stages' defaults and these settings of inverse_render."""
    stages = {}
    for name, stage in load_pipeline().stages.items():
        parameters = stage.defaults() | (settings if name == "inverse_render" else {})
        own = [f"{clip}/{name}" for clip in clips] if clips != ("",) and not stage.joins else [name]
        stages |= {label: {"version": stage.version, "parameters": parameters} for label in own}
    parts = [ClipRecords(clip, FRAMES, TRACKING, frozenset(given)) for clip in clips]
    return RunRecords({"stages": stages}, solve, parts, packages)


def flat(text):
    return " ".join(text.split())


def test_figures_and_versions_are_those_of_the_run():
    text = flat(methods_text(records()))
    for part in ("Limn 0.1.0", SAMPLE_FRAMES, "NumPy 2.4.6", "PyTorch 2.13.0+cpu", "PyAV 18.1.0", "OpenUSD 26.11",
                 "1920 x 1080 px, 25 frames/s", "48 frames", "focal length 5166 px, given", "3 were left out",
                 "5000 points in 47 frames", "0.10 px (95 %: 0.30 px)", "turn of 61 degrees", "fitted frames by 0.0123",
                 "2 frames held out of the solve by 0.0145", "priors: skin's luminance", "scene-linear Rec.709"):
        assert part in text, part
    assert "SciPy" not in text and "colour chart" not in text and "another tracker" not in text


SETTINGS = ({"light_model": "harmonics_2"}, {"light_model": "sun_sky"}, {"light_model": "camera"}, {"model": "full"},
            {"solver": "reference"}, {"visibility": False, "bounce": False, "specular": False}, {"bounce": False}, {})


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_references_are_numbered_in_the_order_of_their_use(settings):
    paragraphs, references = methods_paragraphs(records(**settings))
    cited = [int(n) for group in re.findall(r"\[([\d, ]+)\]", " ".join(paragraphs)) for n in group.split(",")]
    assert list(dict.fromkeys(cited)) == list(range(1, len(references) + 1))
    assert set(references) <= set(REFERENCES.values()) and not re.search(r"[{}]", " ".join(paragraphs))


def test_settings_change_the_text():
    texts = {flat(methods_text(records(**settings))) for settings in SETTINGS}
    assert len(texts) == len(SETTINGS)
    assert "without highlights" in methods_text(records(specular=False))
    chart = SOLVE | {"albedo_scale": {"method": "a chart", "chart": {}}, "shape": {"refined": False, "outline": {}}}
    text = flat(methods_text(records(solve=chart, given=("poses",))))
    assert "colour chart in view" in text and "was not used" in text and "outline meets the person masks" in text
    assert "used poses that another tracker gave" in text


def test_a_grey_place_gets_its_sentence():
    said = {"light": 0, "log_ratios": [0.1, 0.0], "log_sigma": [0.06, 0.06]}
    grey = {"method": "priors: skin's luminance", "grey": [said]}
    assert "named a place in the picture as grey" in flat(methods_text(records(solve=SOLVE | {"albedo_scale": grey})))
    assert "grey" not in flat(methods_text(records()))


def test_hair_is_told_of_where_it_stands_off():
    hairy = flat(methods_text(records(solve=SOLVE | {"hair": {"thickness_mm": 16.4}})))
    assert "16 mm (median) off the head" in hairy and "Visual Hull" in hairy
    assert "visual hull" not in flat(methods_text(records())).lower()


def test_numbered_images_are_not_decoded_as_video():
    images = {**FRAMES, "source": {**FRAMES["source"], "name": "%05d.png"}}
    found = records()
    text = methods_text(RunRecords(found.run, SOLVE, [ClipRecords("", images, TRACKING)], PACKAGES))
    assert "FFmpeg" not in text and "FFmpeg" in methods_text(found)


def test_several_clips_are_told_one_by_one():
    text = flat(methods_text(records(clips=("sun", "lamp"))))
    assert "Of the clip sun (1920" in text and "Of the clip lamp 5000 points" in text
    assert "place the clips on one mesh" in text and text.count(SAMPLE_FRAMES) == 1


def test_braces_in_records_are_text():
    text = methods_text(records(solve=SOLVE | {"albedo_scale": {"method": "priors {of} {a} {kind"}}))
    assert "{of} {a} {kind" in text


def test_export_writes_it_and_the_report_shows_it(tmp_path):
    job = ToyJob(write_toy_work(tmp_path / "work"), tmp_path / "export", "<b>toy</b>", views=False)
    export_usd.run(job)
    text, page = flat((job.out / "methods.txt").read_text()), (job.out / "report.html").read_text()
    assert "Of the clip (160 x 120 px, 25 frames/s" in text and "OpenUSD 2" in text and "References [1] Xu" in text
    assert '<section id="methods">' in page and "another version" not in page
    assert json.loads((job.out / "run.json").read_text())["subject"] == "<b>toy</b>"
    paragraph = next(line for line in (job.out / "methods.txt").read_text().splitlines() if "Reflectance" in line)
    assert paragraph[:60] in page


TRIED = [{"distance_mm": None, "held_out": 0.03}, {"distance_mm": 700.0, "held_out": 0.02}]


def test_gains_and_what_is_known_of_the_scale_are_stated():
    exposure = {"brightness": 0.07, "tint": 0.03}
    scale = {"method": "priors", "log_sigma": {"luminance": 0.21}, "prior_share": 0.4}
    text = flat(methods_text(records(solve=SOLVE | {"exposure": exposure, "albedo_scale": scale})))
    assert "Exposure, which wandered by 7%, and white balance, by 3%" in text and "Irons" in text
    assert "luminance is known to 21%" in text and "40% of which" in text
    assert "wandered" not in methods_text(records())


@pytest.mark.parametrize("lamp, says", [
    ({"near": True, "distance_mm": 650.0, "tried": TRIED}, "main lamp stands 0.65 m from the head"),
    ({"distance_mm": 500.0}, "main lamp was said to stand 0.50 m from the head"),
    ({"near": False, "tried": TRIED}, "main lamp is far away"),
])
def test_the_lamp_stands_where_the_record_says(lamp, says):
    assert says in flat(methods_text(records(solve=SOLVE | {"lamp": lamp})))
    assert "main lamp" not in methods_text(records())


@pytest.mark.parametrize(
    ("found", "said"),
    [
        ({"irises": 9, "with_catchlight": 0, "compared": 0}, "No catchlight stands out on any of 9 irises"),
        ({"irises": 9, "with_catchlight": 4, "compared": 0}, "irises show one, where the solved light gives none"),
        ({"irises": 9, "with_catchlight": 4, "compared": 3, "apart_deg": {"median": 6.8, "p95": 9.0},
          "light_over_solved": 0.517}, "directions 7 degrees apart (median), and the clip's hold 0.52 times as much"),
    ],
)
def test_the_check_by_catchlights_is_said(found, said):
    assert said in flat(methods_text(records(solve=SOLVE | {"catchlights": found})))
    assert "catchlight" not in flat(methods_text(records())).lower()
