"""Records of results from others: odd ones are one line, whatever they hold."""

import copy
import hashlib
import json
import os
import random

import numpy as np
import pytest
from plain_objects import hemisphere

from unips_jax.cli.relight import main as relight
from unips_jax.cli.surface import main as surface
from unips_jax.cli.view import main as view
from unips_jax.errors import InputError
from unips_jax.io.results import RECORD, read_record
from unips_jax.viewer.result import read_result


def good_record(folder):
    digest = hashlib.sha256((folder / "normals.npy").read_bytes()).hexdigest()
    return {
        "unips_jax": "0.3.0",
        "code": "abc",
        "weights": {"name": "tiny", "hash": "87dae457aa", "trained": True},
        "folder": "/photographs",
        "images": {"a.png": "0" * 64, "b.png": "1" * 64},
        "left_out": {"not an image": ["notes.txt"]},
        "mask": None,
        "mask_hash": None,
        "options": {"reader": "plain"},
        "date": "2026-11-27T10:00:00+00:00",
        "mask_pixels": 300,
        "width": 32,
        "height": 32,
        "transfer": "srgb",
        "transfer_rule": "8-bit values",
        "warnings": ["light from one side"],
        "surface": {
            "camera": "orthographic",
            "focal_px": None,
            "unit": "pixels",
            "scale": 1.0,
            "near": -3.0,
            "far": 4.5,
        },
        "files": {"normals.npy": digest},
    }


@pytest.fixture
def result(tmp_path):
    folder = tmp_path / "result"
    folder.mkdir()
    np.save(folder / "normals.npy", hemisphere(32)[0])
    return folder


def write(folder, record):
    (folder / RECORD).write_text(json.dumps(record))


ODD = [
    None,
    True,
    -1,
    0,
    1e308,
    10**400,
    float("nan"),
    float("inf"),
    "",
    "x" * 5000,
    [],
    [[]],
    {},
    {"a": {}},
    "/dev/zero",
    "../../etc/passwd",
    "a\0b",
    "\ud800",
    "\n",
]


def mutations():
    """Records with one odd value anywhere, or one field less; or no record at all."""

    def places(value, path=()):
        if isinstance(value, dict):
            for key in value:
                yield (*path, key)
                yield from places(value[key], (*path, key))

    def at(record, path):
        for key in path:
            record = record[key]
        return record

    def mutate(record, path, value):
        changed = copy.deepcopy(record)
        at(changed, path[:-1])[path[-1]] = value
        return json.dumps(changed)

    def without(record, path):
        changed = copy.deepcopy(record)
        del at(changed, path[:-1])[path[-1]]
        return json.dumps(changed)

    def renamed(record, path, name):
        changed = copy.deepcopy(record)
        inner = at(changed, path[:-1])
        inner[name] = inner.pop(path[-1])
        return json.dumps(changed)

    def every(record):
        for path in places(record):
            yield without(record, path)
            for odd in ODD:
                yield mutate(record, path, odd)
        for name in (
            "/dev/zero",
            "../x",
            "..",
            "",
            "pipe",
            "a\0b",
            "\ud800",
            "n" * 300,
        ):
            for path in (("files", "normals.npy"), ("images", "a.png")):
                yield renamed(record, path, name)
        for odd in ODD:
            yield json.dumps(odd)
        yield from ("", "{", "[" * 100_000, '{"a":' * 100_000, "\xff\xfe", "NaN", "nul")
        yield '{"files": {}, "files": 3}'

    return every


def one_line_or_nothing(call):
    try:
        call()
    except InputError as error:
        assert "\n" not in str(error) and str(error)
        return True
    return False


def test_no_record_makes_a_traceback(result):
    record = good_record(result)
    write(result, record)
    assert read_result(result).record["transfer"] == "srgb"
    os.mkfifo(result / "pipe")
    tried = refused = 0
    for text in mutations()(record):
        (result / RECORD).write_text(text, errors="surrogatepass")
        refused += one_line_or_nothing(lambda: read_result(result))
        tried += 1
    assert tried > 500 and refused > 300


def test_commands_answer_in_one_line(result, capsys):
    record = good_record(result)
    os.mkfifo(result / "pipe")
    texts = list(mutations()(record))
    random.Random(0).shuffle(texts)
    for index, text in enumerate(texts[:45]):
        (result / RECORD).write_text(text, errors="surrogatepass")
        out = str(result.parent / f"out-{index}")
        command = [
            lambda out: view([str(result), "--flat", "-o", f"{out}.html"]),
            lambda out: surface([str(result), "-o", out]),
            lambda out: relight([str(result), "-o", out]),
        ][index % 3]
        status = command(out)
        error = capsys.readouterr().err
        assert status in (0, 2) and (status == 0 or error.count("\n") == 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"files": {"/dev/zero": "0"}}, "files: expected plain names of files"),
        ({"files": {"pipe": "0"}}, "expected a regular file"),
        ({"files": 3}, "files: expected"),
        ({"surface": {"scale": -1.0}}, "surface.scale: expected above 0, got -1"),
        ({"transfer": "gamma"}, "transfer: expected one of"),
        ({"weights": {"name": "tiny"}}, "weights: expected hash, got none"),
    ],
)
def test_what_is_wrong_is_named(change, message, result):
    os.mkfifo(result / "pipe")
    write(result, {**good_record(result), **change})
    with pytest.raises(InputError) as caught:
        read_result(result)
    assert message in str(caught.value)
    assert read_record(result) is None


def test_what_older_versions_left_out_may_be_missing(result):
    record = good_record(result)
    for name in record.keys() - {"files"}:
        write(result, {key: value for key, value in record.items() if key != name})
        assert read_record(result) is not None
        assert read_result(result).photographs == ()


def test_names_may_have_what_the_system_takes(result):
    """On Windows a backslash leads elsewhere; elsewhere it is a letter."""
    record = good_record(result)
    write(result, {**record, "images": {"cat\\p0.png": "0"}})
    if os.name == "nt":
        with pytest.raises(InputError, match="expected plain names"):
            read_result(result)
    else:
        assert list(read_result(result).record["images"]) == ["cat\\p0.png"]
