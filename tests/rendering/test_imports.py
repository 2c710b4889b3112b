"""What importing and starting the renderers does, and does not do, to the process."""

import subprocess
import sys

import pytest
import torch

from toile.errors import InputError
from toile.rendering import NvdiffrastRenderer
from toile.rendering.edges import mesh_edges


def run(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)


def test_nvdiffrast_is_not_imported_and_warp_is_quiet():
    code = "import sys, toile.rendering as r; r.WarpRenderer(); r.ReferenceRenderer()\n"
    result = run(code + "assert not [m for m in sys.modules if m.split('.')[0] == 'nvdiffrast'], 'imported'")
    assert result.stdout == result.stderr == ""


def test_missing_nvdiffrast_says_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "nvdiffrast", None)
    monkeypatch.setitem(sys.modules, "nvdiffrast.torch", None)
    with pytest.raises(InputError, match="renderer=warp"):
        NvdiffrastRenderer()


def test_edges_know_the_faces_on_both_sides():
    edges = mesh_edges(torch.tensor([[0, 1, 2], [0, 2, 3]]))
    table = {tuple(e): set(o) for e, o in zip(edges.vertices.tolist(), edges.opposite.tolist(), strict=True)}
    assert table == {(0, 1): {2, -1}, (1, 2): {0, -1}, (0, 2): {1, 3}, (2, 3): {0, -1}, (0, 3): {2, -1}}
    assert mesh_edges(torch.zeros(0, 3, dtype=torch.int64)).vertices.shape == (0, 2)
