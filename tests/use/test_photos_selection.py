"""Which files of a folder are the photographs."""

from pathlib import Path

import numpy as np
import pytest

from unips_jax.errors import InputError
from unips_jax.io.selection import drawn, is_map, select
from unips_jax.lighting.known import read_known_lights
from unips_jax.lighting.rig import read_rig


@pytest.mark.parametrize(
    "name",
    [
        "normal.tif",
        "normals.png",
        "Normal_gt.png",
        "NORMAL01.PNG",
        "obj_normal.png",
        "mask.png",
        "mask_02.png",
        "objMask.tif",
        "depth.exr",
        "Depth0001.exr",
        "baseColor.tif",
        "base_color.png",
        "BaseColour.png",
        "roughness.tif",
        "metal.tif",
        "metallic.png",
        "albedo.png",
        "ball_albedo.png",
        "ball_gt.png",
        "ballGT.png",
        "gt.png",
        "gt_normal.tif",
        "sheet.png",
    ],
)
def test_maps_and_outputs_are_recognised(name):
    assert is_map(name)


@pytest.mark.parametrize(
    "name",
    [
        "001.png",
        "L_1.png",
        "IMG_20240101.JPG",
        "length_01.png",
        "abnormal.jpg",
        "light3.png",
        "unmasked.png",
        "sheets_1.png",
        "strength.tif",
        "DSC0001.tif",
        "maskot_1.png",
        "normandy.jpg",
        "depths.png",
    ],
)
def test_photographs_are_not_taken_for_maps(name):
    assert not is_map(name)


def touch(folder: Path, *names: str):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_bytes(b"x")


def test_plain_folder_lists_what_is_left_out(tmp_path):
    touch(tmp_path, "b.PNG", "a.jpg", ".hidden.png", "normal.tif", "notes.txt")
    touch(tmp_path, "mask.TIF", "c.jxl", "d.PSD", "depth.exr")
    (tmp_path / "sub.png").mkdir()
    selection = select(tmp_path)
    assert selection.names == ("a.jpg", "b.PNG")
    assert selection.mask_file == tmp_path / "mask.TIF"
    assert selection.left_out == {
        "a map or output, by its name": ["depth.exr", "normal.tif"],
        "not an image": ["notes.txt"],
        ".jxl is not read: export PNG or TIFF": ["c.jxl"],
        ".psd is not read: export PNG or TIFF": ["d.PSD"],
    }


def test_data_folders(tmp_path):
    test, train, other = (tmp_path / f"{n}.data" for n in ("test", "train", "other"))
    touch(test, "L_1.png", "L_2.png", "0.png", "view.png", "mask.png")
    touch(train, "000.tif", "001.tif", "normal.tif", "baseColor.tif", "x.png")
    touch(other, "a.png", "b.png")
    assert select(test).names == ("L_1.png", "L_2.png")
    assert select(test).left_out == {
        "not named L* in a .data folder": ["0.png", "view.png"]
    }
    assert select(train).names == ("000.tif", "001.tif")
    assert select(other).names == ("a.png", "b.png")


@pytest.mark.parametrize("name", ["metal_bowl_{}.png", "{:02}-goldMask.jpg"])
def test_names_decide_only_between_files(tmp_path, name):
    series = [name.format(i) for i in range(3)]
    touch(tmp_path, *series, "normal.tif", "depth_1.exr", "depth_2.exr")
    selection = select(tmp_path)
    assert selection.names == tuple(series)
    maps = ["depth_1.exr", "depth_2.exr", "normal.tif"]
    assert selection.left_out == {"a map or output, by its name": maps}
    touch(tmp_path, "a.png")  # a preview
    assert select(tmp_path).names == tuple(series)
    touch(tmp_path, "b.png")
    assert select(tmp_path).names == ("a.png", "b.png")


def test_planes_of_a_texture_map_lie_next_to_its_record(tmp_path):
    """Photographs of a toy plane do not."""
    planes = [f"plane_{index}.jpg" for index in range(12)]
    touch(tmp_path, *planes)
    assert select(tmp_path).names == tuple(planes)
    # The application sees no record, and sets them aside.
    assert [is_map(name) for name in planes] == [True] * 6 + [False] * 6
    for record in ("info.json", "normals.json"):
        touch(tmp_path, record)
        selection = select(tmp_path)
        assert selection.names == tuple(planes[6:])
        assert selection.left_out["a map or output, by its name"] == planes[:6]
        assert select(tmp_path, include=["plane_?.jpg"]).names == tuple(planes[:10])
        (tmp_path / record).unlink()
    touch(tmp_path, "info.json", "a.png")
    for index in range(6, 12):
        (tmp_path / planes[index]).unlink()
    assert select(tmp_path).names == ("a.png",)


def test_a_pattern_that_fits_no_file_is_named(tmp_path):
    touch(tmp_path, "a.png", "b.png", "mask.png")
    selection = select(tmp_path, exclude=["b*", "mask*", "c*", "B.PNG?"])
    assert selection.names == ("a.png",)
    unmet = selection.left_out["by --exclude, which fits no file"]
    assert unmet == ["c*", "B.PNG?"]
    assert (
        "by --exclude, which fits no file"
        not in select(tmp_path, exclude=["b*"]).left_out
    )


def test_heif_of_cameras_is_an_image(tmp_path):
    pytest.importorskip("pillow_heif", reason="pillow-heif is not installed")
    touch(tmp_path, "DSC1.HIF", "DSC1.JPG", "DSC2.HIF", "DSC2.JPG")
    assert select(tmp_path).names == ("DSC1.HIF", "DSC2.HIF")


def test_maps_alone_are_no_photographs(tmp_path):
    touch(tmp_path, "normal_1.png", "normal_2.png", "ball_depth.png")
    with pytest.raises(InputError, match="got none; 3 left out .a map or output"):
        select(tmp_path)


def test_patterns_overrule_names(tmp_path):
    touch(tmp_path, "depth_1.png", "depth_2.png", "a.png", "b.PNG", "notes.txt")
    touch(tmp_path, "mask.png")
    chosen = select(tmp_path, include=["depth_*", "*.txt"], exclude=["*_2.png"])
    assert chosen.names == ("depth_1.png",)
    assert chosen.mask_file == tmp_path / "mask.png"
    assert chosen.left_out == {
        "not among --include": ["a.png", "b.PNG"],
        "by --exclude": ["depth_2.png"],
        "not an image": ["notes.txt"],
    }
    assert select(tmp_path, exclude=["mask*"]).mask_file is None
    better = tmp_path / "elsewhere" / "better.png"
    better.parent.mkdir()
    touch(better.parent, better.name)
    chosen = select(tmp_path, include=["*.png"], mask_file=better)
    assert chosen.names == ("a.png", "depth_1.png", "depth_2.png")
    assert chosen.left_out["a mask, and another one is given"] == ["mask.png"]
    with pytest.raises(InputError, match="4 left out .not among --include."):
        select(tmp_path, include=["*.exr"])


def test_numbers_are_in_order(tmp_path):
    names = [f"IMG_{number}.jpg" for number in (1, 2, 9, 10, 11, 100)]
    touch(tmp_path, *names)
    assert select(tmp_path).names == tuple(names)
    odd = ["10\u00b2.jpg", "a.jpg", "b01.jpg", "b1.jpg", "B2.jpg", "\u0663.jpg"]
    touch(tmp_path / "odd", *odd)
    assert select(tmp_path / "odd").names == tuple(odd)


def test_given_mask_is_no_photograph(tmp_path):
    touch(tmp_path, "a.png", "shape.png", "mask.png")
    selection = select(tmp_path, mask_file=tmp_path / "shape.png")
    assert selection.names == ("a.png",)
    assert selection.left_out == {"a mask, and another one is given": ["mask.png"]}


def test_drawn_images_depend_on_the_seed_only(tmp_path):
    touch(tmp_path, *(f"{i:02}.png" for i in range(20)))
    first, again, other = (drawn(select(tmp_path), 5, seed=s) for s in (3, 3, 4))
    assert first == again
    assert len(first.names) == 5 and list(first.names) == sorted(first.names)
    assert first.names != other.names
    assert len(first.left_out["not among the 5 drawn with seed 3"]) == 15
    assert drawn(select(tmp_path), 20).left_out == {}


def test_masks_named_after_the_object(tmp_path):
    touch(tmp_path, "buddha.0.png", "buddha.1.png", "buddha.mask.png", "filenames.txt")
    selection = select(tmp_path)
    assert selection.names == ("buddha.0.png", "buddha.1.png")
    assert selection.mask_file == tmp_path / "buddha.mask.png"
    touch(tmp_path, "mask.png")
    with pytest.raises(InputError, match="one mask, got buddha.mask.png, mask.png"):
        select(tmp_path)


def test_a_photograph_in_two_formats_counts_once(tmp_path):
    touch(tmp_path, "a.JPG", "a.tif", "b.JPG", "b.tif", "c.JPG", "c.tif")
    selection = select(tmp_path)
    assert selection.names == ("a.tif", "b.tif", "c.tif")
    assert selection.left_out == {
        "the same photographs as .tif": ["a.JPG", "b.JPG", "c.JPG"]
    }
    assert select(tmp_path, include=["*.JPG"]).names == ("a.JPG", "b.JPG", "c.JPG")
    (tmp_path / "c.tif").unlink()  # what all have comes first
    assert select(tmp_path).names == ("a.JPG", "b.JPG", "c.JPG")


@pytest.mark.parametrize("installed", [True, False])
def test_raw_files_come_first_where_they_are_read(tmp_path, monkeypatch, installed):
    found = object() if installed else None
    monkeypatch.setattr("importlib.util.find_spec", lambda name: found)
    touch(tmp_path, "a.JPG", "a.CR2", "b.JPG", "b.CR2")
    suffix = "CR2" if installed else "JPG"
    assert select(tmp_path).names == (f"a.{suffix}", f"b.{suffix}")


def test_a_list_of_lights_names_the_photographs(tmp_path):
    touch(tmp_path, "rti 01.jpg", "rti 02.jpg", "Ball_mask.png", "setup.jpg")
    text = "3\nC:\\work\\rti 01.jpg 0.1 -0.2 0.97\nx/RTI 02.JPG\t.5 5e-1 0.7\n"
    (tmp_path / "coin.lp").write_text(text + "rti 03.jpg 0 0 1\nnonsense\n")
    selection = select(tmp_path)
    assert selection.names == ("rti 01.jpg", "rti 02.jpg")
    assert selection.left_out == {
        "not understood in coin.lp": [
            "coin.lp, line 5: no name and light, 'nonsense'",
            "coin.lp: 3 lights by its first line, 4 there",
        ],
        "not listed in coin.lp": ["Ball_mask.png", "setup.jpg"],
        "listed in coin.lp, but not there": ["rti 03.jpg"],
    }
    (tmp_path / "coin.lp").write_bytes(b"\xff\x00nothing of ours")
    assert select(tmp_path).names == ("rti 01.jpg", "rti 02.jpg", "setup.jpg")


def test_accents_may_be_written_as_macos_does(tmp_path):
    apart = "Scha\u0308del"  # the dots of the letter are a character of their own
    touch(tmp_path, f"{apart}_1.jpg", f"{apart}_2.jpg", f"{apart}_3.jpg")
    selection = select(tmp_path, include=["Schädel_[12].jpg"])
    assert selection.names == (f"{apart}_1.jpg", f"{apart}_2.jpg")
    lights = "2\nschädel_1.jpg 0 0 1\nSchädel_3.tif .6 0 .8\n"
    (tmp_path / "dome.lp").write_text(lights, "utf-8")
    selection = select(tmp_path)
    assert selection.names == (f"{apart}_1.jpg", f"{apart}_3.jpg")
    for given in ([str(tmp_path / "dome.lp")], ["Schädel_1: left", "Schädel_3: left"]):
        assert read_known_lights(given, selection.names).any(axis=1).all()
    names = (selection.names[1], "a.jpg", selection.names[0])
    with pytest.raises(InputError, match="none for a.jpg"):
        read_rig(tmp_path / "dome.lp", names)
    rig = read_rig(tmp_path / "dome.lp", names[::2])
    np.testing.assert_allclose(rig, [[0.6, 0, 0.8], [0, 0, 1]], atol=1e-6)


def test_links_and_hidden_files(tmp_path):
    touch(tmp_path, "b.png", ".b.png", "._b.png")
    touch(tmp_path / "elsewhere", "c.png")
    (tmp_path / "a.png").symlink_to("b.png")
    (tmp_path / "c.png").symlink_to("elsewhere/c.png")
    selection = select(tmp_path)
    assert selection.names == ("b.png", "c.png")
    assert selection.left_out == {"another name of b.png": ["a.png"]}
