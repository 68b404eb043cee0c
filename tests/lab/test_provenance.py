import pytest

from unips_jax import provenance
from unips_jax.evaluation.store import Store
from unips_jax.evaluation.variants import hashed
from unips_jax.provenance import code_hash

FILES = {
    "__init__.py": "",
    "a.py": "from pack.inner import b\n\n\ndef f():\n    import pack.lazy\n",
    "lazy.py": "X = 1\n",
    "other.py": "X = 1\n",
    "inner/__init__.py": "",
    "inner/b.py": "from pack.inner.c import g\n",
    "inner/c.py": '"""Doc."""\n\n\ndef g():\n    """Doc."""\n    return 1\n',
    "console.py": "X = 1\n",
}


@pytest.fixture
def hash_with(tmp_path, monkeypatch):
    """A function that hashes module `a` of a package with some files changed."""
    monkeypatch.setattr(provenance, "_PACKAGE", tmp_path / "pack")
    monkeypatch.setattr(provenance, "_NAME", "pack")
    monkeypatch.setattr(provenance, "_SILENT", {"pack.console"})

    def run(**changed):
        for name, text in {**FILES, **changed}.items():
            path = tmp_path / "pack" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        code_hash.cache_clear()
        return code_hash("a")

    yield run
    code_hash.cache_clear()


@pytest.mark.parametrize("name", ["a.py", "inner/b.py", "inner/c.py", "lazy.py"])
def test_what_is_imported_counts(hash_with, name):
    assert hash_with() != hash_with(**{name: FILES[name] + "Y = 2\n"})


@pytest.mark.parametrize("name", ["other.py", "console.py"])
def test_what_is_not_imported_or_only_read_does_not(hash_with, name):
    changed = FILES["a.py"] + "from pack import console\n"
    assert hash_with(**{"a.py": changed}) == hash_with(
        **{"a.py": changed, name: FILES[name] + "Y = 2\n"}
    )


def test_what_only_type_checkers_import_does_not(hash_with):
    unseen = "from typing import TYPE_CHECKING\n"
    unseen += "if TYPE_CHECKING:\n    from pack import other\n"
    changed = {"inner/b.py": FILES["inner/b.py"] + unseen}
    assert hash_with(**changed) == hash_with(**changed, **{"other.py": "X = 2\n"})


def test_comments_and_docstrings_do_not_count(hash_with):
    text = '"""Other."""\n\n# Why.\ndef g():\n    """Other."""\n\n    return 1\n'
    assert hash_with() == hash_with(**{"inner/c.py": text})


def test_a_module_that_is_not_there_is_an_error():
    with pytest.raises(FileNotFoundError):
        code_hash("no_such_module")


def test_the_code_of_an_estimate_is_followed_into_all_rooms():
    reached = provenance._reached(["unips_jax.estimation.streaming"])
    wanted = {"models.unips", "models.upernet", "models.ops", "io.color"}
    assert {f"unips_jax.{name}" for name in wanted} <= set(reached)


def test_of_a_file_its_contents_count(tmp_path):
    """Results made with other weights under the same name are other results."""
    first, second = tmp_path / "a", tmp_path / "b"
    keys = []
    for place, content in ((first, "1"), (second, "1"), (first, "2")):
        place.write_text(content)
        keys.append(hashed({"weights": str(place), "clip": 0.5}))
    assert keys[0] == keys[1] != keys[2] and keys[0]["clip"] == 0.5


def test_of_a_folder_what_its_user_put_there_counts(tmp_path, monkeypatch):
    def key(value="."):
        return hashed({"root": value})["root"]

    monkeypatch.chdir(tmp_path)
    (tmp_path / "lights").mkdir()
    (tmp_path / "lights" / "1.txt").write_text("1")
    before = key()
    assert key("") == ""  # no folder, not this one
    Store(tmp_path / "runs" / "out").path("ball").write_text("{}")
    for name in (".git", "__pycache__"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a").write_text("")
    assert key() == before
    (tmp_path / "lights" / "2.txt").write_text("2")
    assert key() != before
