"""The report's 3D view of a head whose hair stands off it."""

import pytest
from browser import needs_browser, visit
from toy_result import ToyJob, write_toy_work

from stages import export_usd

SHOWN = "document.getElementById('viewer').toDataURL()"
LEAST_OPAQUE = """(() => {
    const shown = document.getElementById('viewer'), copy = document.createElement('canvas');
    [copy.width, copy.height] = [shown.width, shown.height];
    const to = copy.getContext('2d');
    to.drawImage(shown, 0, 0);
    const codes = to.getImageData(0, 0, copy.width, copy.height).data.filter((_, k) => k % 4 === 3);
    return codes.reduce((a, b) => Math.min(a, b), 255);
})()"""


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """A visit to the page, drawn."""
    base = tmp_path_factory.mktemp("hair_view")
    job = ToyJob(write_toy_work(base / "work", hair=True), base / "export", views=False, usdz=False, glb=False)
    export_usd.run(job)
    with visit(job.out / "report.html") as visited:
        visited.page.wait_for_function("document.getElementById('viewer').dataset.drawn === 'yes'")
        yield visited


@needs_browser
def test_hair_can_be_left_away(opened):
    pictures = [opened.page.evaluate(SHOWN)]
    for _ in range(2):
        opened.page.click("#viewer-hair")
        pictures.append(opened.page.evaluate(SHOWN))
    assert pictures[0] == pictures[2] != pictures[1]
    assert opened.problems == []


@needs_browser
def test_the_page_does_not_shine_through_it(opened):
    assert opened.page.evaluate(LEAST_OPAQUE) == 255
