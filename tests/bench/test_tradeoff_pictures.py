"""The chart of speed against accuracy: its picture."""

from toy_tradeoff import ERROR, POINTS

from tools.bench.chart.tradeoff import tradeoff_picture
from tools.bench.drawing import Axis


def test_the_axis_is_logarithmic():
    scale = Axis(1.0, 1000.0, 0.0, 300.0, logarithmic=True)
    assert [round(scale(value)) for value in (1, 10, 100, 1000, 5000)] == [0, 100, 200, 300, 300]
    assert Axis(3.0, 60.0, 0.0, 1.0, logarithmic=True).ticks() == [5.0, 10.0, 20.0, 50.0]


def test_the_picture_names_the_presets_and_the_front():
    svg = tradeoff_picture(POINTS, ERROR, "error")
    assert svg.count("<circle") == len(POINTS) + 4
    for name in ("draft", "standard", "fine"):
        assert 'class="preset">' in svg and f">{name}</text>" in svg
    assert ">matte</text>" in svg and 'class="front"' in svg
    assert "http" not in svg.replace('xmlns="http://www.w3.org/2000/svg"', "")
