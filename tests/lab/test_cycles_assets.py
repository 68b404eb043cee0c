"""What sets rendered with Cycles are made of: meshes, texture sets, manifests."""

from pathlib import Path

import pytest

from unips_jax.cycles import assets
from unips_jax.cycles.command import PRESETS
from unips_jax.errors import InputError


def test_objects_do_not_depend_on_the_rest_of_the_set():
    assert assets.drawn_jobs(3, 1) == assets.drawn_jobs(9, 1)[:3]
    assert assets.drawn_jobs(3, 1) != assets.drawn_jobs(3, 2)


def test_manifests_name_objects_materials_and_lightings(tmp_path):
    (tmp_path / "cow.obj").write_text("")
    maps = tmp_path / "tex" / "Fabric" / "linen"
    maps.mkdir(parents=True)
    for name in ("linen_basecolor.png", "linen_metal_roughness.png"):
        (maps / name).write_bytes(b"")
    found = assets.find_materials(tmp_path / "tex")
    linen = found["Fabric/linen"]
    assert linen["category"] == "Fabric"
    assert sorted(linen["maps"]) == ["baseColor", "roughness"]
    listed = tmp_path / "list.csv"
    listed.write_text(
        "id,object,material,category,lighting\n7,cow,linen,Fabric,near\n"
        "8,pig,oak,Wood,\n9,pig,gold,Metal,\n",
        encoding="utf-8-sig",
    )
    jobs = assets.manifest_jobs(listed, 0, [tmp_path / "cow.obj"], found)
    assert [job.name for job in jobs] == [
        "007-cow-linen",
        "008-pig-oak",
        "009-pig-gold",
    ]
    assert jobs[0].shape["file"].endswith("cow.obj") and jobs[0].lightings == ("near",)
    assert jobs[0].material is linen and jobs[1].lightings is None
    assert jobs[1].shape == jobs[2].shape and jobs[1].material != jobs[2].material


def test_libraries_may_be_linked_to(tmp_path):
    (tmp_path / "library").mkdir()
    (tmp_path / "library" / "cow.obj").write_text("")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "all").symlink_to(tmp_path / "library")
    found = assets.find_files(tmp_path / "mine", assets.MESHES, "--meshes")
    assert found == [tmp_path / "mine" / "all" / "cow.obj"]


def test_texture_sets_of_one_name_stay_apart(tmp_path):
    root = tmp_path / "wood-and-metal"
    for name in ("Wood/01/a_basecolor", "Metal/01/b_basecolor", "Wood/02/c_roughness"):
        file = root / f"{name}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"")
    found = assets.find_materials(root)
    categories = {name: entry["category"] for name, entry in found.items()}
    assert categories == {"Metal/01": "Metal", "Wood/01": "Wood"}
    unknown = assets.find_materials(root / "Wood")["01"] | {"category": ""}
    (job,) = assets.drawn_jobs(1, 0, materials={"01": unknown})
    assert job.facts == {"shape": "cut", "material": "01"}


@pytest.mark.parametrize(
    "files, maps",
    [
        ("a_diff_4k a_rough_4k a_arm_4k", "baseColor packed roughness"),
        ("A-1K_Color A-1K_Metalness A-1K_NormalGL", "baseColor metal"),
        ("a_COL_2K a_col a_protocol", "baseColor"),
        ("a_baseColor a_metallicRoughness", "baseColor packed"),
        ("a_albedo a_OcclusionRoughnessMetallic", "baseColor packed"),
        ("rusty_metal_diff rusty_metal_rough_2k", "baseColor roughness"),
    ],
)
def test_maps_are_told_by_their_names(tmp_path, files, maps):
    for name in files.split():
        (tmp_path / f"{name}.png").write_bytes(b"")
    (found,) = assets.find_materials(tmp_path).values()
    assert sorted(found["maps"]) == maps.split()


def test_the_papers_list_is_a_manifest():
    from unips_jax.evaluation.benchmarks import ps_wild

    jobs = assets.manifest_jobs(Path(ps_wild.__file__).with_name("ps_wild_test.csv"), 0)
    assert len({job.name for job in jobs}) == 50


@pytest.mark.parametrize(
    "text, message",
    [
        ("object,material\na,b\n", "line 2: expected object, material and category"),
        ("object,material,category\na,b,Glass\n", "expected one of Fabric.*'Glass'"),
        ("object,material,category\n", "expected lines of objects"),
        (
            "object,material,category,lighting\na,b,Wood,moon\n",
            "expected some of directional.*'moon'",
        ),
    ],
)
def test_bad_manifests_are_named(tmp_path, text, message):
    path = tmp_path / "list.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        assets.manifest_jobs(path, 0)


def test_the_real_set_refuses_to_draw_its_shapes(tmp_path):
    """It stands on meshes of others: drawn ones would be another test."""
    manifest = PRESETS["ps-wild-real"]["manifest"]
    jobs = assets.manifest_jobs(manifest, 2026)
    names = [job.facts["shape"] for job in jobs]
    assert len({job.facts["category"] for job in jobs}) == 6
    meshes = [tmp_path / f"{name}.stl" for name in names]
    assets.require_meshes(manifest, meshes, "ps-wild-real")
    for found, missing in ((None, names[0]), (meshes[:3] + meshes[4:], names[3])):
        with pytest.raises(InputError, match=f"found no {missing}; `python tools"):
            assets.require_meshes(manifest, found, "ps-wild-real")
