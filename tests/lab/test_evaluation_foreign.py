"""Other people's methods: normals in files."""

import re

import evaluation_data as data
import numpy as np
import pytest
from evaluation_folders import errors_of, run, tables_of, truth
from scipy.io import savemat

from unips_jax.baselines.method import Observed
from unips_jax.cli import evaluate as evaluation
from unips_jax.errors import InputError
from unips_jax.evaluation import axes, plan, protocols
from unips_jax.evaluation.benchmarks import files
from unips_jax.evaluation.methods import UnipsOptions, load_variants
from unips_jax.evaluation.normal_files import Subset, from_files
from unips_jax.io.color import srgb_encode
from unips_jax.io.images import write_exr
from unips_jax.io.normals import encode_normals

NO_WEIGHTS = UnipsOptions(())


@pytest.fixture(scope="module")
def objects(tmp_path_factory):
    """Two folders of photographs with true normals, `cup` and `shoe`."""
    return data.make_folder(tmp_path_factory.mktemp("objects"))


WRITERS = {
    "name.npy": lambda path, n: np.save(path / "cup.npy", n),
    "name.mat": lambda path, n: savemat(path / "cup.mat", {"anything": n}),
    "name.png": lambda path, n: data.write_image(path / "cup.png", encode_normals(n)),
    "name.exr": lambda path, n: write_exr(path / "cup.exr", {"RGB": n}),
    "folder": lambda path, n: data.write_image(
        path / "cup" / "normals.png", encode_normals(n)
    ),
    "folder.data": lambda path, n: data.write_image(
        path / "cup.data" / "nml_predict.png", encode_normals(n)
    ),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_normals_are_found_and_read_in_every_format(objects, tmp_path, kind):
    made = tmp_path / "mine"
    made.mkdir()
    WRITERS[kind](made, truth(0))
    if "folder" in kind:  # what macOS leaves on disks of other systems
        (next(made.iterdir()) / "._normals.png").write_bytes(b"\0\5\x16\7")
    assert run(objects, tmp_path / "work", "-m", f"files:{made}") == 0
    summary = tables_of(tmp_path / "work")["summary"]["rows"]
    assert summary[0][0] == "mine" and summary[0][3] < 0.01
    assert summary[0][-1] == "1 of 2"  # the shoe has none, and a remark says so
    remarks = tables_of(tmp_path / "work")["remarks"]["rows"]
    assert ["shoe", "mine", "files: no normals in mine"] in remarks


@pytest.mark.parametrize("background", [0, np.nan, 0.3, (0, 0, 1)])
@pytest.mark.parametrize("center", [(16, 44), (8, 55), (31.5, 31.5)])
def test_which_size_is_meant_where_both_are_one(tmp_path, center, background):
    mask, normals = data.sphere(64, 64, center=center, radius=7)
    protocol = protocols.Protocol("crop", 64)
    shown = protocols.shown_mask(mask, protocol)
    cropped = protocols.shown_normals(normals, mask, protocol)
    kinds = {"whole": (mask, normals), "crop": (shown, cropped)}
    files = from_files(f"files:{tmp_path}").files
    for name, (meant, values) in kinds.items():
        values = np.where(meant[..., None], values, background)
        np.save(tmp_path / f"{name}.npy", values)
        run = files.method(
            name,
            Subset(None, None, True),
            mask,
            lambda x: protocols.shown_normals(x, mask, protocol),
        )
        found = run(Observed(np.ones((1, 64, 64, 3)), shown))
        np.testing.assert_allclose(found[shown], cropped[shown], atol=1e-6)
        assert files.read(tmp_path / f"{name}.npy", [mask, shown])[1] is meant
    # Without a background, or with one that fits neither.
    everywhere = np.random.default_rng(0).normal(size=normals.shape)
    for values in (everywhere, np.roll(normals, 20, axis=1)):
        np.save(tmp_path / "unclear.npy", values)
        with pytest.raises(InputError, match="64 x 64 pixels .* does not show which"):
            files.read(tmp_path / "unclear.npy", [mask, shown])


def test_a_file_may_be_named(objects, tmp_path):
    for i, name in enumerate(("cup", "shoe")):
        place = tmp_path / "mine" / "results" / f"{name}.data"
        data.write_image(place / "out.png", encode_normals(truth(i)))
    request = f"files:{tmp_path / 'mine'},file=results/{{object}}.data/out.png,name=SDM"
    assert run(objects, tmp_path / "work", "-m", request) == 0
    assert errors_of(tmp_path / "work")["SDM"] < 0.01


TURNS = {
    "x=left": (-1, 1, 1),
    "y=down": (1, -1, 1),
    "z=away": (1, 1, -1),
    "y=down,z=away": (1, -1, -1),
    "x=left,y=down": (-1, -1, 1),
}


@pytest.mark.parametrize("options", [*TURNS, "channels=bgr"])
def test_a_turned_axis_is_named_and_can_be_said(objects, tmp_path, capsys, options):
    made = tmp_path / "mine"
    made.mkdir()
    for i, name in enumerate(("cup", "shoe")):
        turned = truth(i) * np.float32(TURNS.get(options, (1, 1, 1)))
        np.save(made / f"{name}.npy", turned[..., ::-1] if "bgr" in options else turned)
    work = tmp_path / "work"
    assert run(objects, work, "-m", f"files:{made}") == 0
    warnings = [x for x in capsys.readouterr().err.splitlines() if "warning" in x]
    assert len(warnings) == 1 and f"files:DIR,{options} says so" in warnings[0]
    assert errors_of(work)["mine"] > 20
    remarks = tables_of(work)["remarks"]["rows"]
    assert [row[:2] for row in remarks] == [["all", "mine"]]
    assert run(objects, work, "-m", f"files:{made},{options}") == 0
    assert "warning" not in capsys.readouterr().err
    assert errors_of(work)["mine"] < 0.01


@pytest.mark.parametrize(
    ("signs", "stated", "advised"),
    [
        ((1, 1, 1), "y=down", ""),
        ((1, 1, 1), "channels=bgr", ""),
        ((-1, 1, 1), "y=down", "x=left"),
        ((1, -1, -1), "z=away", "y=down,z=away"),
        ((-1, 1, -1), "z=away", "x=left,z=away"),
        ((1, 1, -1), "z=away,channels=bgr", "z=away"),
    ],
)
def test_what_was_stated_wrongly_is_known(
    objects, tmp_path, capsys, signs, stated, advised
):
    made = tmp_path / "mine"
    made.mkdir()
    for i, name in enumerate(("cup", "shoe")):
        np.save(made / f"{name}.npy", truth(i) * np.float32(signs))
    assert run(objects, tmp_path / "work", "-m", f"files:{made},{stated}") == 0
    warnings = [x for x in capsys.readouterr().err.splitlines() if "warning" in x]
    said = f"files:DIR,{advised} says so" if advised else "files:DIR alone says so"
    assert len(warnings) == 1 and f"(of files, {said})" in warnings[0]
    assert "0.0 degrees when turned" in warnings[0]


def test_a_bad_method_is_not_called_turned():
    """Normals far off, which no turn makes much better."""
    mask, true = data.sphere(30, 30)
    noise = np.random.default_rng(0).normal(size=true.shape)
    flat = np.broadcast_to(np.float32([0, 0, 1]), true.shape)
    for normals in (noise, flat, true + 0.5 * noise):
        mae = axes.errors_if_turned(normals, true, mask)
        known = float(axes.error_map(normals, true)[mask].mean())
        assert axes.find_turned([(known, mae)]) is None
    # Nor where one of three objects alone is better, if much.
    pairs = [(60.0, {"y=down": 5.0}), *[(10.0, {"y=down": 12.0})] * 2]
    assert axes.find_turned(pairs) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda n: n / 2 + 0.5, r"length of 1\.\d+; it seems to hold \(n \+ 1\) / 2"),
        (lambda n: n[:10], "expected normals of 20 x 20 pixels, got 20 x 10"),
        (lambda n: n[..., :2], r"expected normals \[H, W, 3\], got \(20, 20, 2\)"),
        (lambda n: 0 * n, "found only zeros"),
        (lambda n: np.rint(127.5 * (n + 1)), "it seems to hold bytes"),
        (lambda n: 2 * srgb_encode(n / 2 + 0.5) - 1, "hold colours as a display shows"),
        (lambda n: srgb_encode(n / 2 + 0.5), "it seems to hold such colours in floats"),
    ],
)
def test_what_are_no_normals_is_refused_in_one_line(
    objects, tmp_path, capsys, change, message
):
    made = tmp_path / "mine"
    made.mkdir()
    np.save(made / "cup.npy", change(truth(0)))
    request = f"files:{made},values=stored"
    assert run(objects, tmp_path / "work", "-m", request) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert not (tmp_path / "work").exists()  # before any work
    assert re.search(message, error)


MENDED = {
    "(n + 1) / 2 of that": lambda n: n / 2 + 0.5,
    "between 0 and 255": lambda n: np.rint(127.5 * (n + 1)),
    "the array holds uint8": lambda n: np.rint(127.5 * (n + 1)).astype(np.uint8),
    "as a display's values": lambda n: srgb_encode(n / 2 + 0.5),
    "the blue channel is constant": lambda n: n * np.float32([1, 1, 0]),
}


@pytest.mark.parametrize("line", MENDED)
@pytest.mark.parametrize("background", [0, 1])
def test_values_that_certainly_stand_for_others_are_mended(
    tmp_path, capsys, line, background
):
    root = data.make_folder(tmp_path / "bench", size=60)
    made = tmp_path / "mine"
    made.mkdir()
    for i, name in enumerate(("cup", "shoe")):
        mask, normals = data.sphere(60, 60 + i)
        values = MENDED[line](normals.astype(np.float32))
        values[~mask] = background  # whatever is there does not matter
        np.save(made / f"{name}.npy", values[..., ::-1])
    request = f"files:{made},channels=bgr"
    assert run(root, tmp_path / "work", "-m", request) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert said.count(line) == 1 and "(cup.npy and 1 more)" in said
    assert "files:DIR,values=stored" in said or "the array holds" in said
    assert errors_of(tmp_path / "work")["mine"] < 0.6
    if "blue" not in line:  # which are of unit length to the format
        assert run(root, tmp_path / "b", "-m", f"{request},values=stored") == 2
        assert "expected unit vectors" in capsys.readouterr().err


def test_honest_normals_are_taken_as_they_are(tmp_path):
    mask, true = data.sphere(60, 60)
    rng = np.random.default_rng(0)
    noise = np.where(mask[..., None], rng.normal(size=true.shape), 0)
    lit = np.abs(noise) + [0, 0, 0.1]  # all positive: (n + 1) / 2 would be so too
    flat = np.broadcast_to([0, 0, 1.0], true.shape)
    read = from_files(f"files:{tmp_path}").files.read
    stored = from_files(f"files:{tmp_path},values=stored").files.read
    for normals in (true, -true, flat, noise, lit, true + 0.3 * noise):
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = (normals / np.where(length > 0, length, 1)).astype(np.float32)
        np.save(tmp_path / "a.npy", normals)
        savemat(tmp_path / "a.mat", {"n": normals})
        write_exr(tmp_path / "a.exr", {"RGB": normals})
        for dtype in (np.uint8, np.uint16):
            top = np.iinfo(dtype).max
            pixels = np.rint((normals + 1) / 2 * top).astype(dtype)
            data.write_image(tmp_path / f"{np.dtype(dtype)}.png", pixels)
        for name in ("a.npy", "a.mat", "a.exr", "uint8.png", "uint16.png"):
            lines = []
            found, _ = read(tmp_path / name, [mask], lines)
            expected, _ = stored(tmp_path / name, [mask])
            np.testing.assert_array_equal(found, expected)
            assert lines == []


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ("files:nowhere", "expected files:DIR, found no such folder"),
        ("files:HERE,y=sideways", "y: expected .*'down'.*, got 'sideways'"),
        ("files:HERE,q=1", "unexpected keyword argument 'q'"),
        ("python:json", "expected python:package.module:factory"),
        ("python:no_such_module:make", "no module 'no_such_module'"),
        ("python:json:nothing", "json has no function 'nothing'"),
        ("python:json:dumps", "returns the method"),
        ("python:builtins:str", "expected str to return a method"),
    ],
)
def test_bad_requests(tmp_path, request_, message):
    with pytest.raises(InputError, match=message):
        load_variants([request_.replace("HERE", str(tmp_path))], NO_WEIGHTS)


def test_two_files_that_could_be_meant(objects, tmp_path, capsys):
    for name in ("normals.png", "nml.png"):
        data.write_image(tmp_path / "mine" / "cup" / name, encode_normals(truth(0)))
    assert run(objects, tmp_path / "work", "-m", f"files:{tmp_path / 'mine'}") == 2
    assert "found nml.png and normals.png; say which" in capsys.readouterr().err


def test_changed_files_are_scored_again(objects, tmp_path):
    made = tmp_path / "mine"
    made.mkdir()
    for normals in (truth(0), np.float32([0, 0, 1]) + 0 * truth(0)):
        np.save(made / "cup.npy", normals)
        assert run(objects, tmp_path / "work", "-m", f"files:{made}") == 0
    assert errors_of(tmp_path / "work")["mine"] > 20


def test_mat_of_many_variables(tmp_path):
    normals = truth(0)
    savemat(tmp_path / "a.mat", {"a": normals, "b": normals, "Normal_est": -normals})
    np.testing.assert_array_equal(
        files.read_array_normals(tmp_path / "a.mat"), -normals
    )
    savemat(tmp_path / "a.mat", {"a": normals, "b": normals})
    with pytest.raises(InputError, match="or one named Normal_est, found"):
        files.read_array_normals(tmp_path / "a.mat")


def test_backgrounds_of_nothing_are_read_from_images_too(objects, tmp_path, capsys):
    normals = truth(0)
    normals[normals[..., 2] == 0] = np.nan
    write_exr(tmp_path / "cup.exr", {"RGB": normals})
    chosen = ["--objects", "cup", "-m", f"files:{tmp_path},name=mine"]
    assert run(objects, tmp_path / "work", *chosen) == 0
    assert errors_of(tmp_path / "work")["mine"] < 0.1
    assert plan._faces_away(normals * [1, 1, -1]) and not plan._faces_away(normals)


def test_two_folders_of_one_name(tmp_path):
    for name in ("a/out", "b/out"):
        (tmp_path / name).mkdir(parents=True)
    requests = [f"files:{tmp_path / 'a/out'}", f"files:{tmp_path / 'b/out'}"]
    with pytest.raises(InputError, match="two methods are called 'out'; .*name="):
        load_variants(requests, NO_WEIGHTS)
    assert from_files(f"{requests[0]},name=first").label == "first"


@pytest.mark.parametrize(("sign", "warned"), [(1, False), (-1, True)])
def test_where_the_truth_is_withheld_slopes_tell(tmp_path, capsys, sign, warned):
    root = data.make_uw(tmp_path / "data", size=(60, 64))
    rows, columns = np.mgrid[:60, :64] / 6.0
    # Of a surface whose height is a sum of waves, all of them aslant.
    p, q = np.cos(rows + columns), -np.cos(rows + columns)
    normals = np.stack([-p, -q * sign, np.ones_like(p)], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    (tmp_path / "mine").mkdir()
    np.save(tmp_path / "mine" / "cat.npy", normals.astype(np.float32))
    named = ["--benchmark", "uw", "--root", str(root), "--objects", "cat"]
    chosen = ["--workdir", str(tmp_path / "work"), "--no-pictures"]
    request = ["-m", f"files:{tmp_path / 'mine'}"]
    assert evaluation.main([*named, *chosen, *request]) == 0
    assert ("an axis seems to be the other way" in capsys.readouterr().err) == warned
    np.save(tmp_path / "mine" / "cat.npy", (normals * [1, 1, -1]).astype(np.float32))
    assert evaluation.main([*named, *chosen, *request]) == 0
    error = capsys.readouterr().err
    assert "z points away from the viewer (cat.npy); files:DIR,z=away says so" in error
    np.save(tmp_path / "mine" / "cat.npy", normals.astype(np.float32))
    assert evaluation.main([*named, *chosen, request[0], f"{request[1]},z=away"]) == 0
    error = capsys.readouterr().err
    assert "z points away from the viewer (cat.npy); leave z=away out" in error


def test_slopes_of_three_objects_in_four_decide():
    """What is near 0 says nothing."""
    assert "(correlation -0.30)" in axes.misfit([-0.5, -0.6, -0.5, 0.4, 0.1, -0.1])
    assert axes.misfit([-0.5, -0.6, 0.5, 0.4]) == axes.misfit([-0.1]) == ""
