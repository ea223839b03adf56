"""The HTML page in a headless Chromium, at the widths of a phone and of a desktop."""

from __future__ import annotations

import pytest

from coliags_plugin.comparison.report.report import write_report
from coliags_plugin.config.options import ReportOptions
from tests.comparison.report.made import made_scenes, write_comparison, write_run

pytestmark = pytest.mark.thorough

METHODS = {"coliags": 2.0, "gaussian-pancakes": 0.0, "pr-endo": -0.4}
DESKTOP, PHONE = 1400, 390


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """Two scenes and a failed cell; small, as every test loads it."""
    folder = tmp_path_factory.mktemp("report")
    results = made_scenes(METHODS, scenes=2, values={"psnr": (30.0, 29.0, 31.0, 20.0, 32.0)})[:-1]
    write_comparison(folder / "c", results, [("scene-2", "pr-endo", 0, "ran out of memory")])
    for result in results:
        run = folder / f"c/runs/{result.scene.name}/{result.method}/s0-{result.key[:8]}"
        write_run(run, result, depth=0.5 + len(result.method) / 40)
    write_report([folder / "c"], ReportOptions(folder / "report.html", title="Two scenes", frames=3))
    return folder / "report.html"


@pytest.fixture(params=[DESKTOP, PHONE], ids=["desktop", "phone"])
def opened(request, browser, page):
    """The page at one width; nothing may have gone wrong in the end."""
    browser.open(page, request.param, phone=request.param == PHONE)
    yield browser
    assert browser.errors() == []
    assert browser.requests() == [page.resolve().as_uri()]
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")


def cells(browser, table, index, what):
    """Something of the cells of a column, by the name of its table."""
    rows = f"[...document.querySelector('table[data-name={table}]').tBodies[0].rows]"
    return browser.run(f"{rows}.map(row => row.cells[{index}]).map(cell => {what})")


def names(browser):
    return cells(browser, "summary-test", 0, "cell.textContent")


def test_the_page_fits_and_nothing_is_loaded(opened):
    assert opened.run("document.documentElement.scrollHeight") < 6000
    for state in ("open", "closed"):
        opened.run(f"document.querySelectorAll('details').forEach(each => each.open = {str(state == 'open').lower()})")
        assert opened.run("innerWidth") in (DESKTOP, PHONE)
        assert opened.run("document.documentElement.scrollWidth") == opened.run("innerWidth")
    assert opened.run("document.title") == "Two scenes"
    summaries = (
        "[...document.querySelectorAll('.scroll')].filter(each => each.querySelector('[data-name^=summary]'))"
        ".map(each => each.scrollWidth - each.clientWidth)"
    )
    assert opened.run("innerWidth") == PHONE or opened.run(summaries) == [0, 0]


def test_sorting_by_mouse_puts_missing_last(opened):
    written, head = names(opened), "table[data-name=summary-rotation] th[data-key=psnr] button"
    values = [float(value) for value in cells(opened, "summary-rotation", 1, "cell.dataset.value")]
    ordered = sorted(values, reverse=True)
    for expected, state in ((ordered, "descending"), (ordered[::-1], "ascending"), (values, None)):
        opened.click(head)
        assert [float(value) for value in cells(opened, "summary-rotation", 1, "cell.dataset.value")] == expected
        assert opened.run(f"document.querySelector({head!r}).parentElement.getAttribute('aria-sort')") == state
    assert names(opened) == written, "another table was sorted"
    # The method without a result of scene 2, in a folded table.
    opened.run("document.querySelectorAll('details').forEach(each => each.open = true)")
    for _ in range(2):
        opened.click("table[data-name=scene-scene-2-test] th[data-key=ssim] button")
        assert cells(opened, "scene-scene-2-test", 2, "cell.dataset.value ?? null")[-1] is None


def test_sorting_by_keyboard(opened):
    opened.run("document.querySelector('table[data-name=summary-test] thead button').focus()")
    opened.key("Enter", 13, "\r")
    assert names(opened) == sorted(METHODS)
    opened.key(" ", 32, " ")
    assert names(opened) == sorted(METHODS, reverse=True)


def shown_columns(browser, table):
    return browser.run(
        f"[...document.querySelectorAll('table[data-name={table}] th[data-key]')]"
        ".filter(head => head.checkVisibility()).map(head => head.dataset.key)"
    )


def test_columns_are_chosen_for_all_tables(opened):
    default = ["psnr", "ssim", "depth_mse", "depth_mse_inner", "depth_median_error"]
    assert shown_columns(opened, "summary-test") == default
    opened.run("document.querySelectorAll('details').forEach(each => each.open = true)")
    opened.click(".chooser[data-family=metrics] input[value=depth_abs_rel]")
    opened.click(".chooser[data-family=metrics] input[value=ssim]")
    chosen = [name for name in default if name != "ssim"] + ["depth_abs_rel"]
    for table in ("summary-test", "scene-scene-2-test"):
        assert shown_columns(opened, table) == chosen
        rows = opened.run(
            f"[...document.querySelector('table[data-name={table}]').rows]"
            ".map(row => [...row.cells].filter(cell => !cell.hidden).length)"
        )
        assert set(rows) == {len(chosen) + 1}
    assert "psnr_seen" in shown_columns(opened, "summary-rotation")
    hidden = opened.run("[...document.querySelectorAll('li[data-columns=lpips]')].map(note => note.hidden)")
    assert hidden and all(hidden), "the footnote of a hidden column is shown"
    opened.click(".chooser[data-family=metrics] input[value=lpips]")
    assert "lpips" in shown_columns(opened, "summary-test")


def at(browser):
    """Position of the slider, which is the visible share of the left picture, percent."""
    value = float(browser.run("document.querySelector('.compare input').value"))
    clip = browser.run("getComputedStyle(document.querySelector('.stage .left')).clipPath")
    assert clip == f"inset(0px calc({100 - value:g}%) 0px 0px)" or clip == f"inset(0px {100 - value:g}% 0px 0px)"
    return value


def test_the_slider_by_keyboard_mouse_and_touch(request, opened):
    opened.run("document.querySelector('.compare input').focus()")
    assert at(opened) == 50
    for key, code, value in (
        ("ArrowRight", 39, 51),
        ("ArrowLeft", 37, 50),
        ("PageUp", 33, 60),
        ("Home", 36, 0),
        ("End", 35, 100),
    ):
        opened.key(key, code)
        assert at(opened) == value
    assert opened.run("document.querySelector('.compare input').getAttribute('aria-valuetext')") == "100 % coliags"
    opened.drag(".stage", 0.5, 0.4, 0.3, 0.2, touch="phone" in request.node.name)
    assert at(opened) == pytest.approx(20, abs=1)


def choose(browser, name, value):
    browser.run(
        f"(() => {{ const s = document.querySelector('[data-choice={name}]'); s.value = {value!r};"
        " s.dispatchEvent(new Event('change')); })()"
    )


def stage(browser):
    return browser.run("[...document.querySelectorAll('.stage img')].map(image => image.alt).reverse()")


def test_methods_frames_and_errors_are_chosen(opened):
    names = opened.run("[...document.querySelector('[data-choice=left]').options].map(option => option.value)")
    assert sorted(names) == sorted(["truth", *METHODS])
    assert stage(opened) == ["frame 0004, rendered by coliags", "frame 0004, rendered by gaussian-pancakes"]
    choose(opened, "left", "truth")
    choose(opened, "right", "pr-endo")
    assert stage(opened) == ["frame 0004, true image", "frame 0004, rendered by pr-endo"]
    choose(opened, "kind", "1")
    assert stage(opened) == ["frame 0004, true depth", "frame 0004, absolute depth error of pr-endo"]
    assert opened.run("[...document.querySelectorAll('.side')].map(side => side.textContent)") == ["truth", "pr-endo"]
    sources = opened.run(
        "[document.querySelector('.stage .right').src,"
        " document.querySelector('figure[data-method=pr-endo]').querySelectorAll('img')[1].src]"
    )
    assert sources[0] == sources[1]
    loaded = "Promise.all([...document.querySelectorAll('.stage img')].map(image => image.decode())).then(() => true)"
    assert opened.run(loaded)
    frames = opened.run("[...document.querySelector('[data-choice=frame]').options].map(option => option.text)")
    assert frames[0] == "scene-1 · test · frame 0004" and any(
        frame.startswith("scene-2 · rotation") for frame in frames
    )
    opened.click("article.frame:nth-of-type(2) .show-above")
    assert stage(opened)[1] == "frame 0020, absolute depth error of pr-endo"
    assert opened.run("document.activeElement.type") == "range"


def curves(browser):
    """Numbers of visible charts against steps, and against seconds, once what they are folded in is open."""
    browser.run("document.querySelector('[data-switch=curves]').closest('details').open = true")
    visible = "document.querySelectorAll('figure.{}').values().filter(each => each.checkVisibility()).toArray().length"
    return [browser.run(visible.format(kind)) for kind in ("by-step", "by-seconds")]


def test_curves_against_steps_or_seconds(opened):
    assert curves(opened) == [2, 0]
    opened.click("[data-switch=curves] input[value=by-seconds]")
    assert curves(opened) == [0, 2]


def test_every_control_can_be_reached_by_keyboard(browser, page):
    browser.open(page, DESKTOP)
    reached = set()
    for _ in range(80):
        browser.key("Tab", 9)
        reached.add(browser.run("document.activeElement.tagName + (document.activeElement.type || '')"))
    assert {"BUTTONbutton", "SUMMARY", "SELECTselect-one", "INPUTrange"} <= reached


def test_without_scripts_all_is_there_but_the_choices(browser, page):
    browser.open(page, PHONE, phone=True, scripts=False)
    browser._call("Emulation.setScriptExecutionDisabled", value=False)
    assert browser.run("document.querySelector('.compare').checkVisibility()") is False
    assert browser.run("document.querySelectorAll('thead button, .chooser').length") == 0
    assert shown_columns(browser, "summary-test")[:2] == ["psnr", "ssim"]
    assert browser.run("document.querySelector('article.frame img').checkVisibility()")
    assert curves(browser) == [2, 2]
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")


def test_a_dark_page_is_dark(browser, page):
    colors = []
    for dark in (False, True):
        browser.dark(dark)
        browser.open(page, DESKTOP)
        colors.append(browser.run("getComputedStyle(document.body).backgroundColor"))
    browser.dark(False)
    assert colors == ["rgb(255, 255, 255)", "rgb(20, 23, 27)"]
