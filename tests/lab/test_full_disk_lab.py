"""Full disks in the laboratory: one line, exit status 2, and nothing half-written."""

import json

import cv2
import evaluation_data as data
import pytest
from small_disk import small_disk

from unips_jax.cli.evaluate import main as evaluate


@pytest.mark.parametrize("options", [[], ["--write-inputs"]])
@pytest.mark.parametrize("kilobytes", [8, 24])
def test_an_evaluation(options, kilobytes, tmp_path, capsys):
    data.make_folder(tmp_path / "bench")
    arguments = ["--benchmark", "folder", "--root", str(tmp_path / "bench")]
    arguments += ["-m", "constant", *options]
    with small_disk(tmp_path / "disk", kilobytes * 1024) as place:
        assert evaluate([*arguments, "--workdir", str(place / "out")]) == 2
        error = capsys.readouterr().err
        lines = [line for line in error.splitlines() if line.startswith("error: ")]
        assert len(lines) == 1 and "cannot be written: No space left" in lines[0]
        assert not list(place.rglob("*.tmp*"))
        for path in place.rglob("*.json"):
            json.loads(path.read_bytes())
        for path in place.rglob("*.png"):
            assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED) is not None
