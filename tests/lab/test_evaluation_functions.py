"""Other people's methods: functions in modules and packages."""

import sys

import evaluation_data as data
import numpy as np
import pytest
from evaluation_folders import errors_of, run, truth

from unips_jax.baselines.method import Observed
from unips_jax.errors import InputError
from unips_jax.evaluation import foreign
from unips_jax.evaluation.methods import UnipsOptions, load_variants
from unips_jax.io.normals import read_normals

NO_WEIGHTS = UnipsOptions(())


@pytest.fixture(scope="module")
def objects(tmp_path_factory):
    """Two folders of photographs with true normals, `cup` and `shoe`."""
    return data.make_folder(tmp_path_factory.mktemp("objects"))


MODULE = '''
"""A module of the user's."""
import numpy as np

def leaning(*, degrees: float = 0.0):
    """All normals lean to the right. And more words."""
    lean = np.radians(degrees)
    normal = np.array([np.sin(lean), 0, np.cos(lean)])
    return lambda observed: observed.mask[..., None] * normal
'''


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "my_methods.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield tmp_path / "my_methods.py"
    sys.modules.pop("my_methods", None)


def test_a_function_of_ones_own_is_a_method(module):
    request = "python:my_methods:leaning:degrees=20.0"
    variant, _ = load_variants([request], NO_WEIGHTS)
    assert variant.label == "leaning:degrees=20.0"
    assert variant.about == "All normals lean to the right. And more words"
    found = variant.run(Observed(np.ones((1, 1, 1, 3)), np.ones((1, 1), bool)))
    np.testing.assert_allclose(found[0, 0], data.tilted(20)[0, 0])
    before = variant.key["method_code"]
    module.write_text(MODULE + "# changed\n")
    assert foreign.sources_hash(module) != before
    with pytest.raises(InputError, match="degrees: expected float, got 'much'"):
        load_variants(["python:my_methods:leaning:degrees=much"], NO_WEIGHTS)


def test_what_a_function_returns_is_stored_as_unit_vectors(module, objects, tmp_path):
    np.save("cup.npy", truth(0))
    module.write_text(
        "import numpy as np\n"
        "def long():\n    return lambda observed: 3 * np.load('cup.npy')\n"
    )
    chosen = ["--objects", "cup", "-m", "python:my_methods:long"]
    assert run(objects, tmp_path / "work", *chosen) == 0
    (path,) = (tmp_path / "work").glob("results/folder/cup/long-*.png")
    np.testing.assert_allclose(read_normals(path), truth(0), atol=1e-4)
    assert errors_of(tmp_path / "work")["long"] < 0.1


def test_a_function_may_write_into_what_it_is_given(module, objects, tmp_path):
    """Methods after it, and the score, see what was there before."""
    module.write_text(
        "def greedy():\n    def method(observed):\n"
        "        observed.images[...] = 0\n        observed.mask[:12] = False\n"
        "        return observed.images[0]\n    return method\n"
    )
    alone, after = tmp_path / "alone", tmp_path / "after"
    methods = ["hemisphere", "constant"]
    assert run(objects, alone, "-m", *methods) == 0
    assert run(objects, after, "-m", "python:my_methods:greedy", *methods) == 0
    found = errors_of(after)
    assert found.pop("greedy") == 90
    assert found == errors_of(alone)


def test_a_folder_as_option_is_known_by_its_files(module, tmp_path):
    module.write_text("def learnt(*, weights=''):\n    return lambda observed: None\n")
    folder = tmp_path / "checkpoint"
    folder.mkdir()
    keys = []
    for text in ("a", "ab"):
        (folder / "state").write_text(text)
        variant, _ = load_variants(
            [f"python:my_methods:learnt:weights={folder}"], NO_WEIGHTS
        )
        keys.append(variant.key["options"])
    assert keys[0] != keys[1]


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        ("observed.mask", "expected normals of shape (20, 20, 3), got (20, 20)"),
        ("{'normals': 1}", "expected normals, an array of numbers, got dict"),
        ("[[1, 2], [3]]", "expected normals, an array of numbers, got list"),
        ("None", "expected normals of shape (20, 20, 3), got ()"),
    ],
)
def test_a_function_that_returns_something_else_is_named(
    module, objects, tmp_path, capsys, returned, message
):
    module.write_text(f"def flat():\n    return lambda observed: {returned}\n")
    assert run(objects, tmp_path / "work", "-m", "python:my_methods:flat") == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert f"'flat': {message}" in error


def test_a_change_anywhere_in_a_package_is_seen(tmp_path):
    inner = tmp_path / "theirs" / "methods"
    inner.mkdir(parents=True)
    files = [
        inner.parent / "__init__.py",
        inner.parent / "core.py",
        inner / "__init__.py",
        inner / "ours.py",
    ]
    for path in files:
        path.write_text("")
    (tmp_path / "apart.py").write_text("")
    for file in (inner / "ours.py", inner.parent / "__init__.py"):
        hashes = {foreign.sources_hash(file)}
        for path in files:
            path.write_text(path.read_text() + "# changed\n")
            hashes.add(foreign.sources_hash(file))
        assert len(hashes) == 1 + len(files)
        (tmp_path / "apart.py").write_text("# changed\n")
        assert foreign.sources_hash(file) in hashes


def test_a_change_of_an_imported_neighbour_is_seen(module):
    helper = module.with_name("my_helper.py")
    helper.write_text("")
    module.write_text("import my_helper" + MODULE)
    key = load_variants(["python:my_methods:leaning"], NO_WEIGHTS)[0].key
    helper.write_text("# changed")
    module.with_name("other.py").write_text("# never imported")
    changed = load_variants(["python:my_methods:leaning"], NO_WEIGHTS)[0].key
    sys.modules.pop("my_helper")
    assert key["method_code"] != changed["method_code"]
    assert foreign.sources_hash(module) != changed["method_code"]  # not imported now


def test_a_package_brings_a_method(module, monkeypatch):
    known = {"leaning": "my_methods:leaning"}
    monkeypatch.setattr("unips_jax.evaluation.methods.installed", lambda: known)
    labels = [v.label for v in load_variants(["leaning:degrees=3.0"], NO_WEIGHTS)]
    assert labels == ["leaning:degrees=3.0", "constant"]
    with pytest.raises(InputError, match="classical, leaning, files:DIR and python"):
        load_variants(["phong"], NO_WEIGHTS)
