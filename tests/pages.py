"""Pages in a browser, headless Chromium; a test that uses them has a fixture `folder` with a report."""

import shutil

import pytest

playwright = pytest.importorskip("playwright.sync_api", reason="needs the playwright package")

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@pytest.fixture(scope="module")
def browser():
    path = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if path is None:
        pytest.skip("needs Chromium")
    with playwright.sync_playwright() as running:
        chromium = running.chromium.launch(executable_path=path, args=FLAGS)
        yield chromium
        chromium.close()


@pytest.fixture
def show(browser, folder):
    """Opens a page file; at the end nothing was complained of and nothing was asked for."""
    trouble, asked, contexts = [], [], []

    def opened(path=None, width=1440, height=1000, still=True, **settings):
        if still:
            settings["reduced_motion"] = "reduce"
        context = browser.new_context(viewport={"width": width, "height": height}, **settings)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(15_000)
        page.on("console", lambda said: trouble.append(f"{said.type}: {said.text}"))
        page.on("pageerror", lambda error: trouble.append(str(error)))
        page.on("dialog", lambda dialog: trouble.append(f"dialog: {dialog.message}"))
        page.on("request", lambda request: asked.append(request.url))
        page.goto((path or folder / "report.html").as_uri())
        page.wait_for_selector(".plot")
        if still:  # the whole flight from its beginning, and not the moment on which a page opens
            page.locator("#reset").click()
            page.keyboard.press("Home")
            page.evaluate("document.activeElement.blur()")
        return page

    yield opened
    for context in contexts:
        context.close()
    ours = "willReadFrequently"  # advice to `ink`, which reads the canvas
    assert [said for said in trouble if ours not in said] == []
    assert {url.split(":")[0] for url in asked} <= {"file", "data"}
    assert all(url.endswith(".html") for url in asked if url.startswith("file:"))


def until(page, condition):
    """Wait for a condition; Playwright's own way evaluates text in the page, which its policy forbids."""
    for _ in range(300):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"never came true: {condition}")
