"""``toile garment`` and ``toile subject`` as a user calls them."""

from __future__ import annotations

import builtins
from pathlib import Path

import pytest
import torch

from toile.capture.body.subject import Subject, load_subject
from toile.capture.garments import Garment, attached_targets


def test_skirt_out_and_back_in(toile, tmp_path: Path) -> None:
    """The mesh that is written is a garment of one's own: same vertices, fixed at the same places."""
    status, out, err = toile("garment", "garment.vertices=400", "file=a.npz", "mesh=a.obj", "fabric=silk")
    assert (status, err) == (0, "")
    assert "fixed to the body" in out
    assert out.split()[-2:] == ["a.npz", "a.obj"]
    made = Garment.load(tmp_path / "a.npz")
    assert made.material.density == 0.07
    status, _, err = toile("garment", "garment=mesh", "garment.file=a.obj", "file=b.npz")
    assert (status, err) == (0, "")
    again = Garment.load(tmp_path / "b.npz")
    assert again.material.density == 0.15
    assert torch.equal(again.attached, made.attached)
    subject = load_subject()
    targets = attached_targets(again, subject.rest_vertices, subject.faces)
    assert targets.allclose(made.rest_vertices[made.attached], atol=1e-12)
    assert toile("garment", "garment.vertices=400", "file=c.npz", "fabric=silk").status == 0
    assert (tmp_path / "c.npz").read_bytes() == (tmp_path / "a.npz").read_bytes()
    before = (tmp_path / "a.npz").read_bytes()
    status, _, err = toile("garment", "garment=dress", "file=a.npz")
    assert status == 2
    assert "overwrite=true" in err
    assert (tmp_path / "a.npz").read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("garment",), "file="),
        (("garment", "file=a.obj"), ".npz"),
        (("garment", "file=a.npz", "subject=nobody"), "nobody"),
        (("garment", "file=a.npz", "garment.length=3"), "length"),
        (("garment", "file=a.npz", "garment.vertices=10"), "resolution"),
        (("garment", "file=a.npz", "garment.ease=-0.01"), "garment.ease"),
        (("garment", "file=a.npz", "garment.material.poisson=-1"), "garment.material.poisson"),
        (("garment", "file=a.npz", "garment=mesh", "garment.file=none.obj"), "none.obj"),
        (("garment", "file=a.npz", "garment=cape"), "dress"),
        (("subject",), "file="),
        (("subject", "file=a.npz", "body=gltf", "body.file=none.glb"), "none.glb"),
        (("subject", "file=a.npz", "body.gender=2"), "body.gender"),
    ],
)
def test_bad_input_is_named(toile, tmp_path: Path, arguments: tuple[str, ...], says: str) -> None:
    status, out, err = toile(*arguments)
    assert (status, out) == (2, "")
    assert says in err
    assert not (tmp_path / "a.npz").exists()


def test_subject_without_anny_says_how_to_get_it(toile, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without_anny(name: str, *arguments: object, **named: object) -> object:
        if name == "anny":
            raise ImportError("No module named 'anny'")
        return real(name, *arguments, **named)

    monkeypatch.setattr(builtins, "__import__", without_anny)
    status, _, err = toile("subject", "file=a.npz")
    assert status == 2
    assert "toile[subjects]" in err


def test_subject_of_ones_own(toile, tmp_path: Path) -> None:
    """A garment is made for the file that is given."""
    subject = load_subject()
    small = Subject(
        **{
            **{name: getattr(subject, name) for name in subject.__dataclass_fields__},
            "rest_vertices": 0.8 * subject.rest_vertices,
            "rest_joints": torch.cat(
                (
                    torch.cat((subject.rest_joints[:, :3, :3], 0.8 * subject.rest_joints[:, :3, 3:]), 2),
                    subject.rest_joints[:, 3:],
                ),
                1,
            ),
        }
    )
    small.save(tmp_path / "small.npz")
    status, _, _ = toile("garment", "subject=small.npz", "garment.vertices=400", "file=a.npz")
    assert status == 0
    top = float(Garment.load(tmp_path / "a.npz").rest_vertices[:, 1].max())
    assert top < 0.85 * 1.15
