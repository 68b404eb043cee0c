"""Sets rendered with Cycles, as far as they need no Blender: a stand-in renders."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
from blender_stand_in import written

from unips_jax.cli import render
from unips_jax.cycles import assets, blender_process, run
from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks.ps_wild import PSWildTest, PSWildTrain
from unips_jax.io.claims import claim
from unips_jax.io.ps_wild import PSWildFolders

SETTINGS = run.Settings(images=2, size=24)


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    python = written(tmp_path)
    monkeypatch.setenv(blender_process.VARIABLE, python)
    return python


def contents(root):
    return {
        p.relative_to(root).as_posix(): p.read_bytes()
        for p in sorted(root.rglob("*"))
        if p.is_file() and ".locks" not in p.parts
    }


def test_a_set_goes_on_with_the_blender_that_began_it(stand_in, tmp_path, monkeypatch):
    def rendered(count, version):
        monkeypatch.setattr(
            blender_process.Blender,
            "ask",
            lambda self, do, **more: (
                {"blender": version} if do == "version" else asked(self, do, **more)
            ),
        )
        jobs = assets.drawn_jobs(count, 5)
        with blender_process.Blender(stand_in) as blender:
            run.render_set(blender, jobs, SETTINGS, tmp_path / "set")

    asked = blender_process.Blender.ask
    rendered(1, "4.5.15")
    with pytest.raises(InputError, match=r"made_by.*Blender 4\.5\.15.*Blender 5\.0\.1"):
        rendered(2, "5.0.1")
    # A set of an earlier version of this package does not say.
    path = tmp_path / "set" / "settings.json"
    record = json.loads(path.read_text())
    del record["made_by"]
    path.write_text(json.dumps(record))
    rendered(2, "5.0.1")
    assert len(list((tmp_path / "set").glob("*/*.data"))) == 6


def test_a_set_is_what_the_readers_read(stand_in, tmp_path):
    with blender_process.Blender(stand_in) as blender:
        run.render_set(blender, assets.drawn_jobs(2, 5), SETTINGS, tmp_path / "set")
    folder = tmp_path / "set" / "mixed" / "obj001.data"
    names = sorted(p.name for p in folder.iterdir())
    assert names == sorted(
        ["L_00.png", "L_01.png", "baseColor.tif", "depth.exr", "mask.png", "meta.json"]
        + ["metal.tif", "normal.tif", "roughness.tif"]
    )
    benchmark = PSWildTest(tmp_path / "set")
    assert len(benchmark) == 6
    item = benchmark[0]
    assert item.tags["lighting"] == "directional" and item.tags["category"] == "Fabric"
    c = (np.arange(24) + 0.5) / 12 - 1
    x, y = np.meshgrid(c, -c)
    np.testing.assert_array_equal(item.mask, x**2 + y**2 < 1)
    np.testing.assert_allclose(item.normals[item.mask][:, 0], x[item.mask], atol=4e-5)
    bright = np.percentile(item.images[0].max(-1)[item.mask], 99.5)
    assert bright / 65535 == pytest.approx(0.9, abs=2e-3)
    assert item.lights.directions.shape == (2, 3)
    roughness = cv2.imread(str(folder / "roughness.tif"), cv2.IMREAD_UNCHANGED)
    assert roughness.dtype == np.uint16 and roughness.max() == 32768
    meta = json.loads((folder / "meta.json").read_text())
    assert meta["versions"] == {"blender": "stand-in"} and len(meta["lights"]) == 2


def test_intensities_told_are_those_of_a_lambertian_surface():
    """Cycles does give irradiance / pi, see `test_cycles_blender`."""
    x, y = np.meshgrid(np.linspace(-1, 1, 24), np.linspace(1, -1, 24))
    mask = x**2 + y**2 < 0.9
    normals = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], -1)

    class Matt:
        def picture(self, what, *, lamps, **_):
            cosine = np.maximum(normals @ lamps[0]["direction"], 0)
            light = np.array(lamps[0]["irradiance"]) / np.pi
            channels = {c: 0.6 * light[i] * cosine for i, c in enumerate("RGB")}
            return channels | {"A": np.ones_like(x)}

    job = assets.drawn_jobs(1, 5)[0]
    photographs = run._Photographs(Matt(), job, "directional", SETTINGS)
    images = list(photographs.render(mask))
    facts = photographs.all_facts()
    for image, direction, intensity in zip(
        images, facts["light_directions"], facts["light_intensities"], strict=True
    ):
        cosine = np.maximum(normals @ direction, 0)[mask][:, None]
        np.testing.assert_allclose(image[mask], 0.6 * np.array(intensity) * cosine)


def test_training_sets_have_the_training_names(stand_in, tmp_path):
    arguments = ["--preset", "train", "--objects", "1", "--images", "2"]
    more = ["--size", "24", "--lightings", "near", "--sheet", str(tmp_path / "s.png")]
    out = tmp_path / "set"
    every = ["--engine", "cycles", "-o", str(out), *arguments, *more]
    assert render.main(every) == 0
    assert (out / "near" / "obj000.data" / "00.tif").is_file()
    assert len(PSWildTrain(out)) == 1
    more = tmp_path / "more"
    settings = run.Settings(("near",), images=12, size=24, training=True)
    with blender_process.Blender(stand_in) as blender:
        assert not run.render_set(blender, assets.drawn_jobs(1, 5), settings, more)
    names = [f"{number:03d}.tif" for number in range(12)]
    for entry in (
        PSWildTrain(more).entries[0].images,
        PSWildFolders(more, min_images=12)[0].photographs,
    ):
        assert [path.name for path in entry] == names
    assert cv2.imread(str(tmp_path / "s.png")).shape == (3 * 128, 128, 3)


def test_failures_are_recorded_and_the_rest_is_rendered(
    stand_in, tmp_path, monkeypatch
):
    monkeypatch.setenv("CRASH", "1")
    monkeypatch.setenv("FAIL", "1")
    jobs = assets.drawn_jobs(4, 5)  # cut, displaced, knot, lathe
    with blender_process.Blender(stand_in) as blender:
        failed = run.render_set(blender, jobs, SETTINGS, tmp_path / "set")
    assert failed == ["obj000", "obj002"]
    message = {p.name: p.read_text() for p in (tmp_path / "set" / "failures").iterdir()}
    assert (
        "no faces" in message["obj000.txt"]
        and "died at 'build'" in message["obj002.txt"]
    )
    assert len(list((tmp_path / "set" / "near").parent.glob("*/*.data"))) == 6
    monkeypatch.delenv("CRASH")
    monkeypatch.delenv("FAIL")
    monkeypatch.setattr(
        run, "track", lambda items, _, *, total: totals.append(total) or items
    )
    totals = []
    with blender_process.Blender(stand_in) as blender:
        assert not run.render_set(blender, jobs, SETTINGS, tmp_path / "set")
    assert totals == [2]  # what is there does not count as progress
    assert not any((tmp_path / "set" / "failures").iterdir())
    assert len(list((tmp_path / "set").glob("*/*.data"))) == 12


def test_answers_are_waited_for_with_a_limit(stand_in, monkeypatch):
    def only_sockets(*_):
        raise OSError(10038, "an operation on something that is not a socket")

    monkeypatch.setattr("select.select", only_sockets)  # as under Windows
    monkeypatch.setenv("SLOW", "30")
    asked = {"size": 8, "seed": 0}
    with blender_process.Blender(stand_in) as blender:
        for _ in range(2):  # the second asks a process of its own
            assert blender.ask("version") == {"blender": "stand-in"}
            began = time.monotonic()
            with pytest.raises(
                blender_process.BlenderError, match="did not answer in 1 s at 'image'"
            ):
                blender.ask("image", limit_s=1, path="", **asked)
            assert time.monotonic() - began < 10


def test_drawn_environments_go_with_their_object(stand_in, tmp_path, monkeypatch):
    left = []
    with blender_process.Blender(stand_in) as blender:

        def seen(jobs, *_, **__):
            for job in jobs:
                yield job
                left.extend(path.name for path in blender.folder.glob("*.hdr"))

        monkeypatch.setattr(run, "track", seen)
        out = tmp_path / "set"
        assert not run.render_set(blender, assets.drawn_jobs(2, 5), SETTINGS, out)
    assert left == [] and len(list(out.glob("environment/*.data"))) == 2


def test_rotations_that_do_not_fit_are_drawn_again(stand_in, monkeypatch):
    monkeypatch.setenv("UNFIT", "1")
    with blender_process.Blender(stand_in) as blender:
        for job in assets.drawn_jobs(3, 5):
            facts = run.pose(blender, job, SETTINGS, np.random.default_rng(job.seed))
            assert facts["rotation"][0] > 0.5


def test_a_bad_environment_costs_one_lighting(stand_in, tmp_path, capsys):
    around = tmp_path / "around"
    around.mkdir()
    (around / "sky.hdr").write_bytes(b"not a picture")
    command = ["--engine", "cycles", "-o", str(tmp_path / "set"), "--objects", "2"]
    more = ["--size", "24", "--images", "1", "--environments", str(around)]
    lit = ["--lightings", "environment", "directional", "near"]
    sheet = tmp_path / "sheet.png"
    assert render.main([*command, *more, *lit, "--sheet", str(sheet)]) == 2
    assert "2 of 2 objects could not be rendered" in capsys.readouterr().err
    failures = tmp_path / "set" / "failures"
    message = (failures / "obj000.txt").read_text()
    assert message.startswith("environment: ") and "sky.hdr" in message
    for place in ("directional", "near"):
        assert len(list((tmp_path / "set" / place).glob("*.data"))) == 2
    assert cv2.imread(str(sheet)).shape == (5 * 128, 2 * 128, 3)


def test_killed_runs_go_on_and_end_with_the_same_bytes(stand_in, tmp_path):
    arguments = ["--objects", "3", "--images", "4", "--size", "24"]
    command = [
        "-m",
        "unips_jax.cli.main",
        "render",
        "--engine",
        "cycles",
        *arguments,
    ]
    assert render.main([*command[3:], "-o", str(tmp_path / "whole")]) == 0
    slow = {**os.environ, "SLOW": "0.1"}
    out = tmp_path / "killed"
    process = subprocess.Popen(
        [sys.executable, *command, "-o", str(out)], env=slow, start_new_session=True
    )
    while len(list(out.glob("*/.obj*"))) + len(list(out.glob("*/*.data"))) < 2:
        assert process.poll() is None
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert len(list(out.glob("*/*.data"))) < 9
    pair = [
        subprocess.Popen([sys.executable, *command, "-o", str(out)]) for _ in range(2)
    ]
    assert [p.wait(timeout=300) for p in pair] == [0, 0]
    assert contents(out) == contents(tmp_path / "whole")


def test_what_another_process_renders_is_waited_for(stand_in, tmp_path):
    command = ["--engine", "cycles", "-o", str(tmp_path / "set"), "--objects", "2"]
    command += ["--images", "1", "--size", "24", "--lightings", "near"]
    with contextlib.ExitStack() as held, ThreadPoolExecutor() as pool:
        (tmp_path / "set" / ".locks").mkdir(parents=True)
        held.enter_context(claim(tmp_path / "set" / ".locks" / "obj000"))
        status = pool.submit(render.main, command)
        while not list(tmp_path.glob("set/near/obj001.data")):
            assert not status.done()
            time.sleep(0.01)
        with pytest.raises(TimeoutError):
            status.result(timeout=0.5)
        held.close()  # as if it had been killed
        assert status.result(timeout=60) == 0
    assert len(list(tmp_path.glob("set/near/*.data"))) == 2


def test_other_settings_are_refused(stand_in, tmp_path, capsys):
    command = ["--engine", "cycles", "-o", str(tmp_path / "s"), "--objects", "1"]
    assert render.main([*command, "--size", "24", "--images", "1"]) == 0
    assert render.main([*command, "--size", "32", "--images", "1"]) == 2
    message = capsys.readouterr().err
    assert "begun with other settings" in message and "'size': (24, 32)" in message


def test_other_files_are_refused(stand_in, tmp_path, capsys):
    out = tmp_path / "set"
    command = ["--engine", "cycles", "-o", str(out), "--objects", "1", "--size", "24"]
    command += ["--images", "1"]
    assert render.main(command) == 0
    before = json.loads((out / "settings.json").read_text())
    assert "files" not in before and not any(k.startswith("--") for k in before)

    around, maps = tmp_path / "around", tmp_path / "maps"
    around.mkdir()
    cv2.imwrite(str(around / "a.hdr"), np.ones((8, 16, 3), np.float32))
    maps.mkdir()
    cv2.imwrite(str(maps / "a_color.png"), np.ones((8, 8, 3), np.uint8))
    listed = tmp_path / "list.csv"
    listed.write_text("object,material,category\na,b,Wood\nc,d,Wood\n")
    given = ["--environments", str(around), "--materials", str(maps)]
    given += ["--manifest", str(listed)]
    assert render.main([*command, *given]) == 2
    assert "'--environments a.hdr': (None, " in capsys.readouterr().err
    command[3] = str(tmp_path / "other")
    assert render.main([*command, *given]) == 0
    assert len(list((tmp_path / "other").glob("*/*.data"))) == 3  # --objects 1
    assert render.main([*command, *given]) == 0
    cv2.imwrite(str(around / "a.hdr"), np.ones((16, 16, 3), np.float32))
    cv2.imwrite(str(maps / "a_roughness.png"), np.ones((8, 8, 3), np.uint8))
    listed.write_text("object,material,category\na,b,Metal\nc,d,Wood\n")
    assert render.main([*command, *given]) == 2
    message = capsys.readouterr().err
    for name in ("--environments a.hdr", "--materials maps/a_rough", "--manifest"):
        assert f"'{name}" in message
    assert message.count("\n") == 1 and "a_color" not in message


def test_our_scenes_do_not_become_a_set_of_cycles(stand_in, tmp_path, capsys):
    (tmp_path / "directional" / "obj000.data").mkdir(parents=True)
    assert render.main(["--engine", "cycles", "-o", str(tmp_path)]) == 2
    assert "found objects without settings.json" in capsys.readouterr().err


def test_without_blender_it_says_how_to_get_it(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv(blender_process.VARIABLE, "/bin/false")
    assert render.main(["--engine", "cycles", "-o", str(tmp_path)]) == 2
    message = capsys.readouterr().err
    assert "cannot import bpy" in message and "--setup" in message


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--size", "0"], "--size: expected at least 1, got 0"),
        (["--seed", "-1"], "--seed: expected at least 0, got -1"),
        (["-o", "file"], "-o file: cannot be a folder"),
        (["--sheet", "a.gif"], "--sheet: expected a file ending in .png"),
        (["--perspective", "2"], "--perspective: expected 0 to 1"),
        (["--meshes", "."], "--meshes .: expected files .blend"),
        (["--materials", "."], "--materials .: expected files"),
    ],
)
def test_bad_arguments_are_named(monkeypatch, tmp_path, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    assert render.main(["--engine", "cycles", "-o", "x", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_what_blender_prints_while_it_is_imported_is_no_answer(tmp_path):
    stubs = {
        "bpy": "import os; os.write(1, b'Unable to initialise audio\\n')\n"
        "class app: version_string = 'stub'",
        "bmesh": "",
        "mathutils": "Euler = Matrix = Quaternion = Vector = None",
    }
    for name, text in stubs.items():
        (tmp_path / f"{name}.py").write_text(text)
    folder = Path(blender_process.__file__).parent
    done = subprocess.run(
        [sys.executable, "-m", "blender.worker"],
        env={**os.environ, "PYTHONPATH": f"{folder}:{tmp_path}"},
        input='{"do": "version"}\n',
        stdout=subprocess.PIPE,
        text=True,
    )
    assert json.loads(done.stdout)["ok"]["blender"] == "stub"


def test_focal_lengths_are_in_pixels_of_the_photographs(stand_in):
    settings = run.Settings(size=24, perspective=1)
    with blender_process.Blender(stand_in) as blender:
        job = assets.drawn_jobs(1, 5)[0]
        facts = run.pose(blender, job, settings, np.random.default_rng(0))
    assert 35 <= facts["focal_mm"] <= 200
    assert facts["focal"] == pytest.approx(24 * facts["focal_mm"] / 36)
