"""Sheets and the report, the latter in a real browser."""

import io
import json
import re
import shutil
import subprocess

import evaluation_data as data
import numpy as np
import pytest
from matplotlib.image import imread

from unips_jax.baselines.method import Observed
from unips_jax.cli import eval as evaluation
from unips_jax.errors import InputError
from unips_jax.evaluation.protocols import Case
from unips_jax.evaluation.sheets import Panel, sheet
from unips_jax.evaluation.store import Store
from unips_jax.pictures import maps

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    root = data.make_ps_wild(tmp_path_factory.mktemp("data"), size=32)
    (root / "mixed").rename(root / "dusk")  # a lighting the paper does not know
    work = tmp_path_factory.mktemp("work")
    arguments = [
        *("--benchmark", "ps-wild", "--root", str(root), "--workdir", str(work)),
        *("--method", "woodham", "constant", "--num-images", "3", "all"),
        *("--crop-size", "32"),
    ]
    assert evaluation.main(arguments) == 0
    return work


def browse(page, fragment, profile, *options):
    done = subprocess.run(
        [
            *(CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu"),
            *("--disable-background-networking", "--disable-component-update"),
            *("--disable-sync", "--no-first-run", f"--user-data-dir={profile}"),
            *("--enable-logging=stderr", *options, page.as_uri() + fragment),
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
    return [re.findall(r"<td.*?>(.*?)</td>", row, re.S)[index] for row in rows]


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


def test_report_needs_nothing_else(work):
    html = (work / "report.html").read_text()
    links = re.findall(r'(?:src|href)="([^"]*)"', html)
    assert links and all(link.startswith(("data:", "#")) for link in links)
    assert "http://" not in html.replace("http://www.w3.org", "")
    for word in ("summary", "objects", "categories", "images", "compare", "sheets"):
        assert f'id="{word}"' in html
    assert len(re.findall('class="sheet"', html)) == 6
    assert html.count("image/svg+xml") == 4


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
    ]


def test_bold_compares_means_over_the_same_objects(work):
    html = (work / "report.html").read_text()
    # Least squares ran under directional light alone, where it is ahead.
    objects = best(html, "objects")
    assert objects[:3] == [
        *(("directional/obj000", [3]), ("directional/obj001", [3])),
        ("environment/obj000", []),
    ]
    assert objects[-1] == ("mean", [])
    assert not any(columns for _, columns in best(html, "angles"))
    label, columns = best(html, "summary")[0]
    assert label.startswith("woodham") and columns == [3]


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
        with pytest.raises(InputError, match=r"sphere\.png: .*missing or damaged"):
            store.normals("sphere")


def case_of(**changes):
    mask, normals = data.sphere(40, 60)
    images = data.shade(normals, data.lights(3)).astype(np.float32)
    case = Case(Observed(images, mask), normals.astype(np.float32))
    return case._replace(**changes)


def test_sheet_of_many_methods_wraps():
    case = case_of()
    panels = [Panel(f"method number {i}", case.normals, float(i)) for i in range(10)]
    few, many = (imread(io.BytesIO(sheet("x", case, p))) for p in (panels[:3], panels))
    assert many.shape[0] > 1.4 * few.shape[0]
    assert sheet("x", case, panels) == sheet("x", case, panels)


def test_names_on_sheets_are_no_formulas():
    panels = [Panel(r"$5_$6_\frac", case_of().normals, 1.0)]
    assert imread(io.BytesIO(sheet(r"$5_$6_\frac", case_of(), panels))).ndim == 3


def test_sheet_without_truth_or_estimate():
    panels = [Panel("good", case_of().normals, None), Panel("lacking", None, None)]
    assert imread(io.BytesIO(sheet("x", case_of(normals=None), panels))).ndim == 3


def test_pictures_are_white_outside_and_exact_inside():
    mask = np.array([[True, True, True, False]])
    normals = np.array([[[1.0, 0, -1], [-0.6, 0.8, 0], [0, -1, 0], [0, 0, 1]]])
    white = [255, 255, 255]
    np.testing.assert_array_equal(
        maps.normals_picture(normals, mask),
        [[[255, 128, 0], [51, 230, 128], [128, 0, 128], white]],
    )
    # Inferno from nothing over half the scale to 80 degrees, where it is clipped.
    errors = maps.error_picture(np.array([[0.0, 40, 80, 40]]), mask)
    np.testing.assert_array_equal(
        errors, [[[0, 0, 4], [188, 55, 84], [252, 255, 164], white]]
    )
    clipped = maps.error_picture(np.array([[170.0, 0, 0, 0]]), mask)
    np.testing.assert_array_equal(clipped[0, 0], errors[0, 2])
    black = np.zeros((1, 4, 3), np.float32)
    np.testing.assert_array_equal(maps.photograph_picture(black, mask)[0, 0], 0)
    # Half of white is 188 in sRGB (IEC 61966-2-1); what lies outside has no say.
    image = np.array([[[8, 4, 0], [8, 8, 8], [8, 0, 0], [99, 99, 99]]], np.float32)
    np.testing.assert_array_equal(
        maps.photograph_picture(image, mask),
        [[[255, 188, 0], white, [255, 0, 0], white]],
    )
