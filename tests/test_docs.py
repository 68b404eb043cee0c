"""What README and the documentation show runs, and their links lead somewhere."""

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from small_networks import SHALLOW_OURS, lively_network

import unips_jax
import unips_jax.training
from unips_jax.cli.main import COMMANDS, main

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "unips_jax" / "assets" / "sample" / "obj000.data"
PAGES = [*ROOT.glob("*.md"), *sorted((ROOT / "docs").rglob("*.md"))]


def named(path):
    return str(path.relative_to(ROOT))


BLOCKS = [
    pytest.param(block, id=f"{named(path)}-{index}")
    for path in PAGES
    for index, block in enumerate(
        re.findall(r"^```python\n(.*?)^```", path.read_text(), re.DOTALL | re.MULTILINE)
    )
]


@pytest.fixture(params=["small", pytest.param("shipped", marks=pytest.mark.slow)])
def weights(request, monkeypatch):
    """Those that ship take a minute to compile and run; a small network runs it all."""
    if request.param == "small":
        network = lively_network(SHALLOW_OURS)
        shipped = {"tiny": network}
        monkeypatch.setattr(unips_jax, "load_weights", shipped.__getitem__)
    return request.param


def test_readme_shows_python():
    assert any("README" in block.id for block in BLOCKS)


@pytest.mark.parametrize("block", BLOCKS)
def test_python_runs_as_pasted(block, weights, tmp_path, monkeypatch):
    """In a folder with photographs, as the documentation assumes."""
    (tmp_path / "photographs").mkdir()
    for name in ("L_00.png", "L_01.png", "mask.png"):
        shutil.copy(SAMPLE / name, tmp_path / "photographs")
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "block", "exec"), {"__name__": "__main__"})


def commands(text):
    """Calls of `unips` in code, each as words; continued lines are joined."""
    text = re.sub(r"\\?\n +(?=[\[-])", " ", text)
    for line in re.findall(r"(?:^ *|`)(unips [a-z][^`\n#]*)", text, re.MULTILINE):
        yield re.sub(r"[\[\]|]", " ", line).split()[1:]


@pytest.mark.parametrize("name", COMMANDS)
def test_options_shown_are_there(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    shown = {
        option
        for path in [*PAGES, *(ROOT / "configs").glob("*.py")]
        if path.name != "CHANGELOG.md" and path.parent.name != "history"
        for command, *words in commands(path.read_text())
        if command == name and "cycles" not in words
        for option in words
        if option.startswith("-") and not option.startswith("--help")
    }
    config = ["--config", str(ROOT / "configs" / "tiny.py")] if name == "train" else []
    with contextlib.suppress(SystemExit):
        main([name, *config, "--help"])
    told = set(re.findall(r"--?[a-z][\w.-]*", capsys.readouterr().out))
    assert shown and shown <= told, shown - told


def anchors(text):
    """Anchors of headings, as GitHub makes them."""
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", t.lower()).replace(" ", "-") for t in titles}


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_lead_somewhere(page):
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if link.startswith(("https:", "http:")):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target.read_text()), link


def test_the_tutorial_runs(weights, tmp_path, monkeypatch):
    """Its cells in order, in one process; what it shows is in the file."""
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    cells = json.loads((ROOT / "docs" / "tutorial.ipynb").read_text())["cells"]
    names: dict = {"__name__": "__main__"}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
            assert cell["outputs"] or "=" in "".join(cell["source"]), cell["id"]
    matplotlib.pyplot.close("all")
    if weights == "shipped":
        assert names["error"][names["mask"]].mean() < 6
    assert names["errors"][-1] < 0.5 * names["errors"][0]
    assert abs(names["gradient"]).max() > 0


def built(program, folder):
    """Builds the site with a program into a folder; its API page."""
    shutil.copytree(ROOT / "docs", folder / "docs")
    (folder / "unips_jax").symlink_to(ROOT / "unips_jax", target_is_directory=True)
    text = (ROOT / "mkdocs.yml").read_text()
    (folder / "mkdocs.yml").write_text(text)
    build = subprocess.run(
        [sys.executable, "-m", program, "build", "--strict"],
        cwd=folder,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1", "REPO_URL": "https://a.org/b/c"},
        capture_output=True,
        text=True,
    )
    assert build.returncode == 0, build.stderr
    site = folder / "build" / "site"
    api = (site / "api" / "index.html").read_text()
    for name in set(unips_jax.__all__) - {"__version__"}:
        assert f'id="unips_jax.{name}"' in api, name
    for name in unips_jax.training.__all__:
        assert re.search(rf'id="unips_jax\.[\w.]*\b{name}"', api), name
    return site, api


def test_the_site_builds(tmp_path):
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocs_jupyter")
    site, api = built("mkdocs", tmp_path)
    start = api.index('id="unips_jax.estimate_normals"')
    entry = api[start : api.index('id="unips_jax.read_photographs"')]
    signature = re.sub("<[^>]*>", "", entry[: entry.index("</pre>")])
    assert "\n    uniform_contexts: bool = False,\n)" in signature  # wrapped
    returned = entry[entry.index("Returns:") : entry.index("Raises:")]
    assert returned.count("<li") == 1
    for page in site.rglob("index.html"):
        text = page.read_text()
        assert text.count("<h1") == text.count("<title>") == 1, page
        assert 'href="https://a.org/b/c"' in text, page
        assert "site/tables.js" in text, page


@pytest.mark.slow
def test_the_successor_of_the_sites_program_builds_it_too(tmp_path):
    """But for the notebook; docs/releasing.md says when it takes over."""
    pytest.importorskip("zensical", reason="zensical is not installed")
    built("zensical", tmp_path)
