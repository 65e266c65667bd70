"""The map of materials as a file: what it holds, how it reads back, what is refused."""

import numpy as np
import OpenEXR
import pytest

from shared.errors import InputError, LimnError
from shared.imaging.material_labels import CLOTH, HAIR, LABELS, SKIN, UNKNOWN
from shared.io.export_maps import MAPS, MapWriter, map_errors, read_map
from shared.io.exr_checks import header_errors
from shared.io.exr_header import read_parts
from shared.io.images import read_exr, write_exr
from shared.io.material_maps import (
    CHANNELS,
    LABEL_COLOURS,
    LABEL_WORDS,
    STEPS,
    label_picture,
    read_material,
    rounded_shares,
    write_material,
)


@pytest.fixture
def probabilities():
    """[16, 16, len(LABELS)]: four quarters, each of one material for the most part."""
    values = np.full((16, 16, len(LABELS)), 0.05, np.float32)
    for rows, columns, label in ((0, 0, SKIN), (0, 8, HAIR), (8, 0, CLOTH), (8, 8, UNKNOWN)):
        values[rows:rows + 8, columns:columns + 8, label] = 0.7
    return values


def test_it_reads_back_as_written_and_y_is_the_likeliest(tmp_path, probabilities):
    write_material(tmp_path / "material.exr", probabilities, half=True, attributes={"content": "material"})
    np.testing.assert_array_equal(read_material(tmp_path / "material.exr"), rounded_shares(probabilities))
    with OpenEXR.File(str(tmp_path / "material.exr")) as file:
        channels = file.channels()
        assert set(channels) == set(CHANNELS)
        labels = channels["Y"].pixels
    assert labels[0, 0] == SKIN and labels[0, 15] == HAIR and labels[15, 0] == CLOTH and labels[15, 15] == UNKNOWN


def test_rounded_shares_still_sum_to_one():
    shares = np.random.default_rng(2).dirichlet(np.full(len(LABELS), 0.4), (40, 30))
    rounded = rounded_shares(shares)
    np.testing.assert_array_equal(rounded.sum(-1), 1.0)
    np.testing.assert_array_equal(rounded * STEPS, np.round(rounded * STEPS))
    assert np.abs(rounded - shares).max() < 1.0 / STEPS
    np.testing.assert_array_equal(rounded_shares(rounded), rounded)


def test_the_numbers_of_labels_are_those_of_the_page():
    assert LABELS == ("unknown", "skin", "lips", "brow", "hair", "eye", "cloth")


@pytest.mark.parametrize("layout", ["scanline", "mipmap"])
def test_as_an_exported_map_it_states_what_it_is(tmp_path, probabilities, layout):
    writer = MapWriter(half=False, acescg=True, attributes={"stage": "x"}, layout=layout, udim=True)
    writer.write_maps(tmp_path, {"material": probabilities})
    path = tmp_path / "material.1001.exr"
    part = read_parts(path)[0]
    assert header_errors(part, "material") == [] and part.values["limn:unit"] == MAPS["material"][1]
    assert np.array_equal(read_map(path, "material"), rounded_shares(probabilities))
    assert "channels" in header_errors(part, "roughness")[0]


def test_what_is_no_map_of_materials_is_refused(tmp_path, probabilities):
    with pytest.raises(LimnError, match=r"\[S, S, 7\]"):
        write_material(tmp_path / "a.exr", probabilities[..., :3], half=True, attributes={})
    with pytest.raises(LimnError, match="layout"):
        write_exr(tmp_path / "a.exr", probabilities, colour_space="data", layout="mipmap", channels=LABELS)
    write_exr(tmp_path / "grey.exr", probabilities[..., 0], colour_space="data")
    with pytest.raises(InputError, match="other channels"):
        read_material(tmp_path / "grey.exr")
    write_material(tmp_path / "material.exr", probabilities, half=True, attributes={})
    with pytest.raises(InputError, match="other channels"):
        read_exr(tmp_path / "material.exr")


def test_probabilities_that_do_not_add_up_are_said(probabilities):
    assert map_errors("material", probabilities) == []
    assert "add up" in map_errors("material", 0.5 * probabilities)[0]
    assert "at most 1" in map_errors("material", 2.0 * probabilities)[0]
    assert map_errors("material", probabilities[:12])


def test_its_picture_shows_each_material_in_a_colour_of_its_own(probabilities):
    picture = label_picture(probabilities)
    assert picture.dtype == np.uint8 and (picture[0, 0] == LABEL_COLOURS[SKIN]).all()
    assert (picture[15, 0] == LABEL_COLOURS[CLOTH]).all()
    assert len(np.unique(LABEL_COLOURS, axis=0)) == len(LABELS) and set(LABEL_WORDS) == set(LABELS)
