"""The chart of speed against accuracy: its picture and its page."""

from browser import needs_browser, visit
from toy_tradeoff import ERROR, POINTS

from tools.bench.chart.cases import GROUPS
from tools.bench.chart.page import tradeoff_page
from tools.bench.chart.svg import Axis, log_ticks, tradeoff_svg


def test_the_axis_is_logarithmic():
    scale = Axis(1.0, 1000.0, 0.0, 300.0, logarithmic=True)
    assert [round(scale(value)) for value in (1, 10, 100, 1000, 5000)] == [0, 100, 200, 300, 300]
    assert log_ticks(3.0, 60.0) == [5.0, 10.0, 20.0, 50.0]


def test_the_picture_names_the_presets_and_the_front():
    svg = tradeoff_svg(POINTS, ERROR, "error")
    assert svg.count("<circle") == len(POINTS) + 3
    for name in ("draft", "standard", "fine"):
        assert 'class="preset" x=' in svg and f">{name}</text>" in svg
    assert ">matte</text>" in svg and 'class="front"' in svg
    assert "http" not in svg.replace('xmlns="http://www.w3.org/2000/svg"', "")


@needs_browser
def test_the_page_answers(tmp_path):
    path = tmp_path / "chart.html"
    path.write_text(tradeoff_page(POINTS, ERROR, "a </script> clip", GROUPS), encoding="utf-8")
    with visit(path) as visited:
        page = visited.page
        assert page.evaluate("document.querySelectorAll('#chart circle').length") == len(POINTS)
        front = "[...document.querySelectorAll('#rows tr.front td:first-child')].map(c => c.textContent).join()"
        assert page.evaluate(front) == "draft, matte,draft,standard"
        page.evaluate("at('cost').value = 'peak_mb'; at('cost').dispatchEvent(new Event('change'))")
        assert page.evaluate(front) == "standard"
        page.click("#rows tr:nth-child(2)")
        chosen = page.evaluate("document.querySelector('tr.chosen td').textContent")
        assert page.evaluate("document.getElementById('about').textContent").startswith(chosen)
        page.click("#groups input")
        assert page.evaluate("document.querySelectorAll('#chart circle').length") == len(POINTS) - 3
        assert visited.problems == [] and visited.requests == [path.resolve().as_uri()]
