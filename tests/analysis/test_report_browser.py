"""The report in a real browser: only tables and figures scroll sideways, nothing is fetched or complained of."""

import pytest

pytestmark = pytest.mark.nightly

OVERFLOW = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
IMAGES = "[...document.images].filter(image => !(image.complete && image.naturalWidth > 0)).length"
VISIBLE = "[...document.images].filter(image => image.checkVisibility()).length"
CUT = """[...document.querySelectorAll(".scroll")].filter(box =>
    box.getBoundingClientRect().right > innerWidth + 1 || box.getBoundingClientRect().left < 0).length"""


@pytest.mark.parametrize("width", [390, 1280])
def test_page(study, browser, width):
    page = browser.new_page(viewport={"width": width, "height": 844})
    address = (study / "report.html").as_uri()
    said, asked = [], []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(address)
    assert page.evaluate(OVERFLOW) == 0
    assert page.evaluate(CUT) == 0
    assert page.evaluate(IMAGES) == 0
    assert page.evaluate(VISIBLE) == page.locator("figure:has(img)").count() == 3
    assert page.locator("table").count() > 5
    assert said == []
    beside = study.as_uri()
    assert [url for url in asked if not url.startswith(("data:", beside))] == []
    page.close()
