"""What a training run tells: its lines, metrics.jsonl, TensorBoard and sinks."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from unips_jax.errors import InputError
from unips_jax.training import log as log_module
from unips_jax.training.log import TrainLog, duration
from unips_jax.training.validation import score_table


def test_a_torn_line_of_metrics_does_not_end_a_run(tmp_path):
    file = tmp_path / "metrics.jsonl"
    file.write_text('{"step": 1}\n{"step": 2}\n{"st')
    TrainLog(tmp_path, 1, 5)
    assert file.read_text() == '{"step": 1}\n'


def test_tensorboard_drops_the_steps_that_come_again(tmp_path, monkeypatch):
    opened = []
    fake = SimpleNamespace(SummaryWriter=lambda *_, **options: opened.append(options))
    monkeypatch.setitem(sys.modules, "tensorboardX", fake)
    TrainLog(tmp_path, 6, 9)
    assert opened == [{"purge_step": 7}]


def test_what_a_run_tells(tmp_path, capsys, monkeypatch):
    """The pace leaves compilation out; the first step is shown, but not recorded."""
    seconds = [0.0]
    monkeypatch.setattr(log_module.time, "monotonic", lambda: seconds[0])
    log = TrainLog(
        tmp_path, 6, 1006, every=3, pending=[{"loss": 1.0, "grad_norm": 1.0}]
    )
    with log.compiling("the step"):
        seconds[0] += 130
    for step in range(7, 12):
        seconds[0] += 4
        values = {"coarse": 0.12345, "grad_norm": 1, "loss": step}
        log.step(step, jax.tree.map(np.float32, values))
        with log.untimed():
            seconds[0] += 1000
    assert capsys.readouterr().err.splitlines() == [
        "compiling the step; it takes a minute or so",
        "compiled in 2 min",
        "step    7/1006  loss 7  coarse 0.123  4 s/step, 67 min left",
        "step    9/1006  loss 6.25  coarse 0.123  4 s/step, 66 min left",
    ]
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    (recorded,) = [json.loads(line) for line in lines]
    assert recorded == {
        "step": 9,
        "loss": (1 + 7 + 8 + 9) / 4,
        "grad_norm": 1,
        "coarse": pytest.approx(0.12345),
    }
    assert [values["loss"] for values in log.pending()] == [10, 11]


def test_a_sink_takes_metrics_and_pictures(tmp_path, monkeypatch):
    """One that is written against the protocol of `clu.metric_writers`."""
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    assert not TrainLog(tmp_path, 0, 5).shows_pictures
    taken = []

    class Writer:
        def write_scalars(self, step, scalars):
            taken.append((step, scalars))

        def write_images(self, step, images):
            taken.append((step, {k: v.shape for k, v in images.items()}))

    log = TrainLog(tmp_path, 0, 5, every=2, sink=Writer())
    for step in (1, 2):
        log.step(step, {"loss": np.float32(step)})
    log.record(2, {"validation/mae": 20})
    log.pictures(2, {"a": np.zeros((4, 6, 3), np.uint8)})
    assert taken == [
        (2, {"loss": 1.5}),
        (2, {"validation/mae": 20.0}),
        (2, {"a": (1, 4, 6, 3)}),
    ]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(3.4, "3 s"), (119, "119 s"), (130, "2 min"), (9000, "2.5 h"), (2e5, "2.3 days")],
)
def test_durations(seconds, text):
    assert duration(seconds) == text


def test_a_log_that_cannot_be_written_is_named(tmp_path):
    log = TrainLog(tmp_path, 0, 5)
    (tmp_path / "metrics.jsonl").mkdir()
    with pytest.raises(InputError, match=r"metrics\.jsonl: .* Is a directory"):
        log.record(1, {"loss": 1.0})
    full = Path("/dev/full")
    if full.exists():
        log._path = full
        with pytest.raises(InputError, match=r"/dev/full: .* No space left"):
            log.record(1, {"loss": 1.0})


def test_scores_are_a_short_table():
    names = [f"material/kind{i:02}" for i in range(12)]
    scores = dict.fromkeys(("mae", "constant", *names), 12.34)
    table = score_table(scores | {"light/point": 8.0, "light/area": 3.14}).splitlines()
    assert max(map(len, table)) <= 100 and len(table) == 3
    assert table[-1] == "  light     area 3.1, point 8.0"
    assert table[0].startswith("  material  kind00 12.3, kind01 12.3,")
    assert table[1].startswith("            kind") and table[1].endswith(" 12.3")
