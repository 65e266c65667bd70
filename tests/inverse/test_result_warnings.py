"""What a result says of itself."""

from types import SimpleNamespace

import numpy as np
import pytest

from shared.appearance.projection import reached_end
from shared.inverse.solve import highlight_warnings, in_words, warnings_about


def fit_of(roughness=0.4, specular=0.7, highlights_count=True):
    return SimpleNamespace(state=SimpleNamespace(roughness=roughness, specular=specular),
                           highlights_count=highlights_count)


@pytest.mark.parametrize("known, warned", [(0.0, True), (0.009, True), (0.02, False), (1.0, False)])
def test_maps_that_are_hardly_determined_are_said(known, warned):
    confidence = np.where(np.linspace(0.0, 1.0, 1000) < known, 0.9, 0.2)
    result = SimpleNamespace(
        record={"warnings": []}, texels=SimpleNamespace(maps={"confidence": confidence}),
        solution=SimpleNamespace(fitted=0.02, held_out=0.02, **vars(fit_of())),
    )
    assert any("hardly any of the maps" in text for text in warnings_about(result)) is warned


@pytest.mark.parametrize(("value", "end"), [(0.1, "lower"), (0.105, "lower"), (0.4, ""), (0.699, "upper"), (0.69, "")])
def test_a_parameter_at_the_end_of_its_range(value, end):
    assert reached_end(value, (0.1, 0.7)) == end


@pytest.mark.parametrize(("fit", "said"), [
    (fit_of(), []),
    (fit_of(roughness=0.7), ["roughness"]),
    (fit_of(roughness=0.1), ["roughness"]),
    (fit_of(specular=2.0), ["specular intensity"]),
    (fit_of(roughness=0.7, specular=2.0), ["roughness", "specular intensity"]),
    (fit_of(roughness=0.7, specular=0.0), []),
    (fit_of(highlights_count=False), ["usual values of skin"]),
])  # fmt: skip
def test_highlights_that_are_not_this_person_s_are_said(fit, said):
    found = highlight_warnings(fit)
    assert len(found) == len(said) and all(word in text for word, text in zip(said, found, strict=True))


def test_the_solved_model_is_one_line_for_people():
    model = {"light": "cubemap of 6 x 16^2 texels from 25 numbers per channel", "specular_intensity": 0.7,
             "roughness_variation": {"chosen": "one"}, "map_size": 512}
    soft = {"model": model, "shape": {"refined": True}, "poses": {"kept": False}}
    assert in_words(soft) == "light of 25 numbers per channel, one roughness, shape refined, maps of 512 texels"
    few = soft | {"model": model | {"solved_from": {"frames": 24, "points": 1500}}}
    assert in_words(few).startswith("light of 25 numbers per channel, from 1500 points in 24 frames, one roughness")
    near = soft | {"lamp": {"distance_mm": 750.0}, "poses": {"kept": True}, "exposure": {"brightness": 0.1}}
    assert ", lamp 0.75 m away, shape refined, poses solved anew on it, exposure of each frame, " in in_words(near)
    matt = {"model": model | {"specular_intensity": 0.0, "roughness_variation": {}}}
    assert in_words(matt) == "light of 25 numbers per channel, no highlights, shape as tracked, maps of 512 texels"
