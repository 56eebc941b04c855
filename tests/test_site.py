"""The documentation as a site: it builds, pages are short, tables are narrow, and a browser cuts
nothing off without a hint.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.displays.browser import serve_folder, start_chromium

import carlasc

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
MOST_WORDS, MOST_ON_A_PAGE, MOST_COLUMNS = 46_000, 2_500, 7
# Of one page: what is wider than its place and gives no hint that it can be scrolled.
CUT = """
const found = [], width = document.documentElement.clientWidth;
const main = document.querySelector('.md-main');
if (main.scrollWidth > width) found.push(`the page is ${main.scrollWidth} wide`);
for (const table of document.querySelectorAll('.md-content table')) {
  const place = table.closest('.md-typeset__scrollwrap');
  const name = table.textContent.trim().slice(0, 40);
  if (!place) { found.push(`no place to scroll: ${name}`); continue; }
  if (table.offsetWidth <= place.clientWidth + 1) continue;
  const style = getComputedStyle(place), cell = table.querySelector('tbody tr').children[0];
  if (!/auto|scroll/.test(style.overflowX)) found.push(`cannot be scrolled: ${name}`);
  if (!style.backgroundImage.includes('gradient')) found.push(`no shadow: ${name}`);
  const tooWide = cell.offsetWidth > 0.6 * place.clientWidth;
  if (getComputedStyle(cell).position !== 'sticky' || tooWide)
    found.push(`the first column is not kept: ${name}`);
}
// 8 pixels: the padding of code at the end of a line.
const parts = '.md-content :is(pre > code, pre, img, p, li, h1, h2, h3, dd)';
for (const part of document.querySelectorAll(parts))
  if (!part.closest('table') && !part.querySelector('table') && part.clientWidth
      && part.scrollWidth > part.clientWidth + 8 && getComputedStyle(part).display !== 'inline')
    found.push(`${part.localName} is cut: ${part.textContent.trim().slice(0, 40)}`);
return found;
"""
DRAWN = "requestAnimationFrame(() => requestAnimationFrame(arguments[0]))"  # at its new size


def words(page: Path) -> int:
    """Return the number of words of a page outside of code, tables, comments, addresses and
    directives for the API.
    """
    text = page.read_text()
    for pattern in (
        r"<!--.*?-->",
        r"^ *```.*?^ *```\s*$",
        r"^:::.*\n(?: {4}.*\n)*",
        r"^\s*\|.*?$",
        r"(?<=\])\([^)]*\)",
        r"\{#[\w-]+\}",
    ):
        text = re.sub(
            pattern, "", text, flags=re.DOTALL | re.MULTILINE if pattern[0] != ":" else re.MULTILINE
        )
    return len(re.findall(r"\S*\w\S*", text))


def columns(page: Path) -> list[int]:
    """Return the number of columns of each table of a page."""
    lines = re.findall(r"^\s*\|[-:| ]+\|\s*$", page.read_text(), re.MULTILINE)
    return [line.count("|") - 1 for line in lines]


def test_the_documentation_is_short():
    counted = {str(page.relative_to(ROOT)): words(page) for page in PAGES}
    assert sum(counted.values()) <= MOST_WORDS
    free = {"docs/format.md"}
    assert not [
        name
        for name, count in counted.items()
        if count > MOST_ON_A_PAGE and "/studies/" not in name and name not in free
    ]


def test_words_are_counted_outside_of_code_and_tables(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# Two words {#anchor}\n\nA [link](far/away.md), 3 m.\n\n```sh\ncode code\n```\n\n| a | b "
        "|\n|---|---|\n<!-- no\nword -->\n::: carlasc.x\n    options: { a: b }\n"
    )
    assert (words(page), columns(page)) == (6, [2])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_tables_are_narrow(page):
    assert max(columns(page), default=0) <= MOST_COLUMNS


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """The folder of the built site."""
    for package in ("mkdocs", "material", "mkdocstrings"):
        pytest.importorskip(package)
    folder = tmp_path_factory.mktemp("site")
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    arguments = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(folder)]
    ran = subprocess.run(
        arguments, check=False, cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stderr
    return folder


def test_the_site_builds_without_a_warning(site):
    html = (site / "format.html").read_text()
    assert "velodyne/000000.bin" in html and "generated:" not in html
    assert "--free-step-m" in (site / "commands" / "regrid.html").read_text()
    pack = (site / "commands" / "pack.html").read_text()
    # the options of all commands of the page
    assert "--lossy-mm" in pack and "--incomplete" in pack
    api = re.sub(r"<[^>]*>", "", (site / "api" / "groundtruth.html").read_text())
    # public names
    assert "carlasc.regrid(source" in api and "carlasc.groundtruth.RegridResult" in api
    assert not list(site.rglob("*.py"))
    # Opened from the disk, the menu leads to files and the search has its index; nothing is fetched
    # from another host.
    assert (site / "search" / "search_index.js").is_file()
    assert 'href="commands/regrid.html"' in (site / "index.html").read_text()
    assert not [
        page for page in site.rglob("*.html") if re.search(r'src="https?:', page.read_text())
    ]
    # Pictures open in full, the footer names the version, and a page that is missing leads on.
    home = (site / "index.html").read_text()
    assert '<a class="picture" href="images/traces.png">' in home
    assert f"carlasc {carlasc.__version__}" in home and "assets/logo.svg" in home
    assert "howto/own-recording.html" in (site / "404.html").read_text()
    tutorial = (site / "tutorials" / "1_first_look.html").read_text()
    assert 'src="1_first_look_1.png"' in tutorial
    assert (site / "tutorials" / "1_first_look_1.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    "wish",
    [
        "howto/own-recording.html",
        "howto/clean-map.html",
        "howto/train.html",
        "networks.html",
        "commands/evaluate.html#conventions",
        "commands/audit.html",
        "howto/publish.html",
        "howto/semantickitti-clean.html",
    ],
)
def test_the_landing_page_leads_to_what_people_want_in_one_click(site, wish):
    content = (site / "index.html").read_text().partition('class="md-content"')[2]
    assert f'href="{wish}"' in content


def test_the_menu_has_at_most_twelve_entries():
    (menu,) = re.findall(
        r"^nav:\n(.*)", (ROOT / "mkdocs.yml").read_text(), re.DOTALL | re.MULTILINE
    )
    assert 5 < len(re.findall(r"^  - ", menu, re.MULTILINE)) <= 12
    assert "navigation.expand" not in (ROOT / "mkdocs.yml").read_text()  # it is folded


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    driver = start_chromium(tmp_path_factory.mktemp("chromium"))
    yield driver
    driver.quit()


def resize(browser, width):
    browser.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False},
    )


@pytest.mark.slow
def test_no_page_is_cut_without_a_hint(site, browser):
    cut = {}
    for page in sorted(site.rglob("*.html")):
        browser.get(page.as_uri())
        for width in (1280, 390):
            resize(browser, width)
            browser.execute_async_script(DRAWN)
            if found := browser.execute_script(CUT):
                cut[f"{page.relative_to(site)} at {width}"] = found
    assert not cut


@pytest.mark.slow
def test_the_search_finds_pages_from_the_disk_and_over_http(site, browser):
    resize(browser, 1280)
    with serve_folder(site) as address:
        for start in ((site / "index.html").as_uri(), f"{address}index.html"):
            browser.get(start)
            browser.find_element("css selector", "input.md-search__input").send_keys("slurm")
            found = browser.execute_async_script(
                "const done = arguments[0], look = () => { const links = "
                "document.querySelectorAll('.md-search-result__link'); links.length ? "
                "done([...links].map((link) => link.href)) : setTimeout(look, 50); }; look();"
            )
            assert any("many-machines.html" in link for link in found), start


@pytest.mark.slow
@pytest.mark.parametrize(("word", "first"), [("map", "howto/clean-map"), ("train", "howto/train")])
def test_the_search_finds_guides_before_the_api(site, browser, word, first):
    resize(browser, 1280)
    browser.get((site / "index.html").as_uri())
    browser.find_element("css selector", "input.md-search__input").send_keys(word)
    found = browser.execute_async_script(
        "const done = arguments[0], look = () => { const links = "
        "document.querySelectorAll('.md-search-result__link'); links.length ? "
        "done([...links].map((link) => link.href)) : setTimeout(look, 50); }; look();"
    )
    assert f"{first}.html" in found[0], found[:5]
