"""Bad settings from the command line: name, expected and got in one message; nothing is loaded or written."""

from __future__ import annotations

from pathlib import Path


def test_from_the_command_line(toile) -> None:
    status, out, err = toile("fit", "scene=nowhere", "parameters.stretching=-1", "hydra.run.dir=run")
    assert status == 2
    assert "parameters.stretching" in err
    assert "expected: a number > 0 [network units]" in err
    assert "got:      -1" in err
    assert "nowhere" not in err + out
    assert not Path("run/trajectory.npz").exists()


def test_an_accelerator_that_is_not_there(toile, scene_folder) -> None:
    status, _, err = toile("fit", "scene=tiny", "trainer.accelerator=tpu", "hydra.run.dir=run")
    assert status == 2
    assert "where:    trainer" in err
    assert "torch_xla" in err
