"""Sheets and the report, the latter in a real browser."""

import itertools
import json
import re
import shutil
import subprocess

import evaluation_data as data
import numpy as np
import pytest
from matplotlib.image import imread

from unips_jax import __version__
from unips_jax.cli import evaluate as evaluation
from unips_jax.errors import InputError
from unips_jax.evaluation import summary
from unips_jax.evaluation.charts import charts
from unips_jax.evaluation.registry import NAMES
from unips_jax.evaluation.report import Exhibit, Header, report
from unips_jax.evaluation.results import Results
from unips_jax.evaluation.runner import Result
from unips_jax.evaluation.scores import Score
from unips_jax.evaluation.sections import sections
from unips_jax.evaluation.store import Store
from unips_jax.evaluation.styles import COLORS, styles

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    root = data.make_ps_wild(tmp_path_factory.mktemp("data"), size=32)
    (root / "mixed").rename(root / "dusk")  # a lighting the paper does not know
    work = tmp_path_factory.mktemp("work")
    arguments = data.ps_wild_arguments(root, work, 32, "3", "all")
    assert evaluation.main(arguments) == 0
    return work


def browse(page, fragment, profile, *options):
    done = subprocess.run(
        [
            CHROMIUM,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--no-first-run",
            f"--user-data-dir={profile}",
            "--enable-logging=stderr",
            *options,
            page.as_uri() + fragment,
        ],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]


def column(html, table, index):
    """Texts of a column of the table's body, in the order shown."""
    body = re.search(rf'data-name="{table}".*?<tbody>(.*?)</tbody>', html, re.S).group(
        1
    )
    rows = re.findall(r"<tr.*?</tr>", body, re.S)
    cells = [re.findall(r"<td.*?>(.*?)</td>", row, re.S)[index] for row in rows]
    return [re.sub("<.*?>", "", cell) for cell in cells]


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_report_opens_from_disk_and_sorts(work, tmp_path):
    page = work / "report.html"
    plain, messages = browse(page, "", tmp_path / "a", "--dump-dom")
    assert messages == []
    assert "<option" in plain  # the script filled the menus
    names = column(plain, "objects", 0)
    assert names[0] == "directional/obj000" and len(names) == 6
    risen, messages = browse(page, "#sort=objects.4", tmp_path / "b", "--dump-dom")
    fallen, more = browse(page, "#sort=objects.4.desc", tmp_path / "c", "--dump-dom")
    assert messages == more == []
    values = [float(text) for text in column(risen, "objects", 4)]
    assert values == sorted(values)
    values = [float(text) for text in column(fallen, "objects", 4)]
    assert values == sorted(values, reverse=True)
    assert 'aria-sort="descending"' in fallen
    # "mean" stays in the foot.
    assert "mean" not in column(risen, "objects", 0)


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_report_is_drawn(work, tmp_path):
    target = tmp_path / "page.png"
    options = (f"--screenshot={target}", "--window-size=1200,1600")
    _, messages = browse(work / "report.html", "", tmp_path / "a", *options)
    assert messages == []
    assert np.ptp(imread(target)[..., 0]) > 0.5


def test_a_sheet_is_enlarged_by_keys_and_fingers(work):
    """On a phone, with a button that closes it."""
    pytest.importorskip("selenium", reason="selenium is not installed")
    import browser
    from selenium.webdriver.support import wait

    if browser.ABSENT:
        pytest.skip("chromium or its driver is absent")
    with browser.browser() as driver:
        metrics = {"width": 375, "height": 667, "deviceScaleFactor": 1, "mobile": True}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        driver.get((work / "report.html").as_uri())
        driver.find_element("css selector", ".sheet").send_keys("\n")
        image = driver.find_element("css selector", "dialog img")

        def width():
            get = "return arguments[0].getBoundingClientRect().width"
            return driver.execute_script(get, image)

        def touch(kind, *places):
            points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(places)]
            given = {"type": kind, "touchPoints": points}
            driver.execute_cdp_cmd("Input.dispatchTouchEvent", given)

        fitted = pytest.approx(375, abs=1)
        wait.WebDriverWait(driver, 60).until(lambda _: width() == fitted)
        touch("touchStart", (150, 333), (200, 333))
        touch("touchMove", (100, 333), (200, 333))
        touch("touchEnd")
        assert width() == pytest.approx(750, rel=0.02)
        driver.switch_to.active_element.send_keys("0")
        assert width() == fitted
        driver.switch_to.active_element.send_keys("+")
        assert width() == pytest.approx(1.25 * 375, abs=1)
        driver.find_element("css selector", "dialog button").click()
        assert not image.is_displayed() and browser.messages(driver) == []


def test_report_needs_nothing_else(work):
    html = (work / "report.html").read_text()
    links = re.findall(r'(?:src|href)="([^"]*)"', html)
    assert links and all(link.startswith(("data:", "#")) for link in links)
    assert "http://" not in html.replace("http://www.w3.org", "")
    for word in ("summary", "objects", "categories", "images", "compare", "sheets"):
        assert f'id="{word}"' in html
    assert len(re.findall('class="sheet"', html)) == 6
    assert html.count("<svg xmlns") == html.count('<figure class="chart">') == 4


def best(html, table):
    """Per row of a table: its first cell, and the columns that are bold."""
    text = re.search(rf'data-name="{table}".*?</table>', html, re.S).group()
    rows = [re.findall("<td.*?</td>", row, re.S) for row in text.split("<tr")[2:]]
    return [
        (
            re.sub("<.*?>", "", row[0]),
            [c for c, cell in enumerate(row) if re.search('class=".* best"', cell)],
        )
        for row in rows
        if row  # no heading
    ]


def test_bold_compares_means_over_the_same_objects(work):
    html = (work / "report.html").read_text()
    # Least squares ran under directional light alone, where it is ahead.
    objects = best(html, "objects")
    assert objects[:3] == [
        ("directional/obj000", [3]),
        ("directional/obj001", [3]),
        ("environment/obj000", []),
    ]
    assert objects[-1] == ("mean", [])
    assert not any(columns for _, columns in best(html, "angles"))
    label, columns = best(html, "summary")[0]
    assert label.startswith("woodham") and columns == [2]


def test_published_means_are_over_the_lightings_evaluated(work):
    tables = json.loads((work / "tables" / "tables.json").read_text())
    for name in ("summary", "images"):
        columns, rows = tables[name]["columns"], tables[name]["rows"]
        shown = [dict(zip(columns, row, strict=True)) for row in rows]
        published = [row for row in shown if row["Source"] == "published"]
        assert published
        for row in published:
            pair = [row["directional"], row["environment"]]
            assert row["Mean"] == pytest.approx(np.mean(pair))


def test_sheets_are_there_and_not_redrawn(work):
    sheets = sorted((work / "sheets").glob("*.png"))
    assert len(sheets) == 6
    image = imread(sheets[0])
    assert image.shape[1] > 1200 and image[..., :3].min() < 0.1


def test_lost_normals_are_named(tmp_path):
    store = Store(tmp_path)
    store.commit("sphere", {}, np.zeros((4, 4, 3)))
    assert store.normals("sphere").shape == (4, 4, 3)
    stored = store.path("sphere").with_suffix(".png")
    for damage in (lambda: stored.write_bytes(b""), stored.unlink):
        damage()
        with pytest.raises(InputError, match=r"sphere\.png: .*delete the \.json"):
            store.normals("sphere")


def result_of(entry, label, *, mae=10.0, reason="", count=None):
    """A result whose pixels are as many degrees off as their error's mean."""
    numbers = [0] * 180
    numbers[int(mae)] = 60
    views = ((10,) * 6, (10 * mae,) * 6)
    score = Score(60, mae, mae, (0.0,) * 4, tuple(numbers), *views, 0, 0)
    tags = {"object": entry}
    return Result(
        entry,
        tags,
        [],
        label,
        count,
        8,
        None if reason else score,
        {},
        reason,
        f"{entry}-{label}",
    )


def results_of(*results):
    labels = dict.fromkeys(result.label for result in results)
    methods = dict.fromkeys(labels, "a method")
    return Results("ps-wild", "native", methods, [None], list(results))


URI = "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw=="
HEADER = Header("2026-01-02 03:04 UTC", "data", "unips eval", "0.1", {"a": "0f"})


def section_of(results, name):
    made = sections(results, summary.tables(results))
    return next(section for section in made if section.name == name)


def test_published_rows_are_apart_and_stay_so():
    shown = section_of(results_of(result_of("ball", "flat")), "summary")
    own, published = shown.parts
    assert [row[0].text for row in own.rows] == ["flat"]
    assert published.kind == "published" and "PS-Wild-Test" in published.heading
    assert [row[0].text for row in published.rows][:2] == ["UniPS", "GCNet"]


def test_ablations_are_collapsed():
    results = results_of(result_of("ball", "flat"))
    own, folded = section_of(results, "published").parts
    assert {row[0].text for row in own.rows} == {"method"}
    assert folded.kind == "folded" and "method" not in {r[0].text for r in folded.rows}
    html = report(HEADER, results, summary.tables(results), []).decode()
    details = re.search("<details>.*?</details>", html, re.S).group()
    assert "max-pooling" in details
    assert "max-pooling" not in html.replace(details, "")


def test_objects_without_estimates_are_not_compared():
    exhibits = [
        Exhibit("ball", "", URI, URI, [("flat", URI, URI, "a line")]),
        Exhibit("cow", "", URI, URI, []),
    ]
    results = results_of(result_of("ball", "flat"), result_of("cow", "flat"))
    html = report(HEADER, results, summary.tables(results), exhibits).decode()
    pictures = re.search('id="pictures">(.*?)</script>', html, re.S).group(1)
    assert [picture["name"] for picture in json.loads(pictures)] == ["ball"]
    assert len(re.findall('class="sheet"', html)) == 2


def test_unsupported_says_why():
    results = results_of(
        result_of("ball", "flat"),
        result_of("ball", "lit", reason="lit: no lights"),
        result_of("cow", "flat"),
        result_of("cow", "lit", reason="lit: too few"),
        result_of("mean", "flat"),
        result_of("mean", "lit", reason="lit: no lights"),
    )
    shown = section_of(results, "objects")
    assert shown.notes == ["no lights", "too few"]
    own, mean = shown.parts
    assert [row[2].note for row in own.rows] == [1, 2, 1]
    assert [row[1].note for row in own.rows] == [0, 0, 0]
    # An object of this name is no mean.
    assert len(own.rows) == 3 and mean.kind == "mean" and len(mean.rows) == 1


def test_angles_are_over_common_objects():
    results = results_of(
        result_of("ball", "flat", mae=10.0),
        result_of("cow", "flat", mae=30.0),
        result_of("ball", "half", mae=2.0),
        result_of("cow", "half", reason="no"),
        result_of("ball", "apart", reason="no"),
        result_of("cow", "apart", mae=5.0),
    )
    tables = {table.name: table for table in summary.tables(results)}
    # The third shares no object with the others, and so has no place next to them.
    assert tables["angles"].names == ["Angle", "Pixels", "flat", "half"]
    assert tables["angles"].values[0] == ["0-15", 10, 10.0, 2.0]
    assert "1 object," in tables["angles"].title


def test_the_header_says_where_all_comes_from(work):
    html = (work / "report.html").read_text()
    header = re.search("<header>.*?</header>", html, re.S).group()
    assert re.search(r'id="date">\d{4}-\d\d-\d\d \d\d:\d\d UTC<', header)
    command = re.search(r'id="command">(.*?)<', header).group(1)
    assert command.startswith("unips eval --benchmark ps-wild --root ")
    assert __version__ in header and "hash " in header


def test_colours_belong_to_methods():
    assert set(COLORS) == set(NAMES) and len(set(COLORS.values())) == len(NAMES)
    alone = styles(["mpm"])["mpm"].color
    many = styles(["unips", "l1", "mpm\N{DAGGER}:merge=angles", "mpm"])
    assert many["mpm\N{DAGGER}:merge=angles"].color == alone != many["mpm"].color
    assert many["mpm"].dashes  # variants of one method differ in more than shade


def test_lines_that_coincide_are_both_seen():
    labels = ["unips a", "unips b", "constant"]
    results = results_of(*(result_of("ball", label) for label in labels))
    first, second, third = (style for _, style in charts(results)[0].legend)
    assert first.width > second.width > third.width
    assert not first.dashes and second.dashes


def test_charts_on_one_page_share_no_names(work):
    html = (work / "report.html").read_text()
    svg = re.findall("<svg xmlns.*?</svg>", html, re.S)
    names = [re.findall(r'\bid="(.*?)"', text) for text in svg]
    assert len(set(sum(names, []))) == len(sum(names, []))
    for text, known in zip(svg, names, strict=True):
        used = re.findall(r'(?:url\(#|href="#)(.*?)[")]', text)
        assert used and set(used) <= set(known)


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
@pytest.mark.parametrize("width", [500, 1200])
def test_long_and_foreign_names_keep_the_page_within_the_screen(tmp_path, width):
    labels = ["a_name_" * 30, "測試用權重" * 12, "🐱" * 60, "<i>&amp;"]
    results = results_of(
        *map(result_of, *zip(*itertools.product(labels, labels), strict=True))
    )
    pictures = [
        Exhibit(label, label, URI, URI, [(label, URI, URI, label)]) for label in labels
    ]
    html = report(HEADER, results, summary.tables(results), pictures).decode()
    script = "document.title = document.documentElement.scrollWidth - innerWidth"
    page = tmp_path / "report.html"
    page.write_text(html.replace("</body>", f"<script>{script}</script></body>"))
    options = ("--dump-dom", f"--window-size={width},900")
    dom, messages = browse(page, "", tmp_path / "a", *options)
    assert messages == []
    assert int(re.search("<title>(.*?)</title>", dom).group(1)) <= 0
