"""Every JSON file that is read may be anything."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from toile.blind.grading import _graded_before
from toile.blind.run import Predictions, read_predictions
from toile.blind.sealing import BlindSet, read_commitments
from toile.diagnosis.record import GapReport
from toile.diagnosis.stage_times import read_times
from toile.errors import InputError
from toile.generation.truth import TRUTH_FILE, read_truth
from toile.json_file import parse_json_object, place, read_json_object
from toile.preparation.template_making.intrinsics import Intrinsics
from toile.preparation.template_making.still import VIDEO, _frame_rate
from toile.reports.run_folder import RunFolder, read_metrics
from toile.scenes.native import load_native
from toile.scenes.phi_sft import load_phi_sft

DEEP = b"[" * 100_000


def predictions(path: Path) -> object:
    import hashlib

    place = Predictions(path.parent)
    place.hash.write_text(hashlib.sha256(path.read_bytes()).hexdigest())
    return read_predictions(BlindSet(path.parent), place)


# Everything that reads a JSON file: the file's name, and the reader.
READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "scene": ("scene.json", lambda path: load_native(path.parent)),
    "published scene": ("scenes/R1.json", lambda path: load_phi_sft("R1", path.parent.parent)),
    "metrics": ("metrics.json", lambda path: read_metrics(RunFolder(path.parent))),
    "diagnosis": ("diagnosis.json", GapReport.read),
    "times": ("times.json", read_times),
    "truth": (TRUTH_FILE, lambda path: read_truth(path.parent.parent)),
    "camera": ("camera.json", lambda path: Intrinsics(file=str(path)).camera((4, 6), "camera")),
    "video": (VIDEO, lambda path: _frame_rate(path.parent, None, (4, 6))),
    "blind set": ("set.json", lambda path: BlindSet(path.parent).read_description()),
    "commitments": ("commitments.json", read_commitments),
    "predictions": ("predictions.json", predictions),
    "graded": ("opened.json", _graded_before),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(
    "content",
    [DEEP, b"[" * 5000 + b"]" * 5000, b"{", b"\xff\xfe{", b"[]", b"{}", b""],
    ids=lambda c: str(c[:3]),
)
def test_one_message_names_the_file(tmp_path: Path, reader: str, content: bytes) -> None:
    name, read = READERS[reader]
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    if (reader, content) in {("metrics", b"{}"), ("truth", b"{}")}:
        assert read(path) == {}
        return
    with pytest.raises(InputError) as refused:
        read(path)
    assert str(path.parent) in refused.value.where
    assert len(str(refused.value).splitlines()) <= 5


def test_a_byte_order_mark_is_no_mistake(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b'\xef\xbb\xbf{"name": "\xc3\xa4"}')
    assert read_json_object(tmp_path / "a.json") == {"name": "ä"}


def test_a_scene_with_byte_order_mark(tiny_folder: Path) -> None:
    path = tiny_folder / "scene.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert load_native(tiny_folder).name == "tiny"


def test_only_objects() -> None:
    with pytest.raises(ValueError, match="a list at the top level"):
        parse_json_object(b"[1]")
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_json_object(b'{"a":' * 100_000)


def test_a_place_reads_as_in_python() -> None:
    assert place(("effects", 0, "shrink")) == "effects[0].shrink"
    assert place((0, 1)) == "[0][1]"
    assert place(()) == ""
