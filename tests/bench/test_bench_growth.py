"""Growth: thinned clips, exponents, the page."""

import pytest

from shared.errors import InputError
from tools.bench.growth import exponent, growth_page, thinned
from tools.goldens.tiny import TINY_SUBJECT


def test_a_thinned_clip_spans_the_whole_turn(tmp_path):
    clip = thinned(TINY_SUBJECT, tmp_path / "clip4", 4)
    pictures, whole = sorted((clip / "frames").iterdir()), sorted((TINY_SUBJECT / "frames").glob("*.png"))
    assert [path.name for path in pictures] == ["0000.png", "0001.png", "0002.png", "0003.png"]
    assert pictures[0].read_bytes() == whole[0].read_bytes() and pictures[-1].read_bytes() == whole[-1].read_bytes()
    assert (clip / "subject.yaml").read_bytes() == (TINY_SUBJECT / "subject.yaml").read_bytes()
    with pytest.raises(InputError, match="too few"):
        thinned(TINY_SUBJECT, tmp_path / "clip99", 99)


def test_exponents():
    assert exponent([1, 2, 4], [3.0, 6.0, 12.0]) == pytest.approx(1.0)
    assert exponent([1, 2, 4], [3.0, 12.0, 48.0]) == pytest.approx(2.0)
    assert exponent([1], [3.0]) is None and exponent([1, 2], [0.0, 1.0]) is None


def test_texels_count_by_their_number():
    rows = [{"kind": "texels", "size": size, "stage": "a", "wall_s": size**2 / 1e4, "cpu_s": 2.0, "peak_mb": 5.0}
            for size in (100, 200)]  # fmt: skip
    lines = growth_page(rows).splitlines()
    assert lines[0] == "| texels | 100 | 200 | exponent |"
    assert lines[2] == "| a, s | 1 | 4 | 1 |" and lines[3] == "| all, s | 1 | 4 | 1 |"
    assert lines[-1].startswith("| all, MB | 5 | 5 |")
