"""``make ablations``: what it would run."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from toile.cli.configuration import CONF, register_resolvers

ROOT = Path(__file__).parents[2]
PAPER = "none,no_silhouette,no_force_regularization,no_turbulence,no_uv,no_successive"
pytestmark = pytest.mark.skipif(
    shutil.which("make") is None or not (ROOT / "Makefile").is_file(), reason="needs make and a checkout"
)


def commands(*settings: str) -> list[list[str]]:
    """Arguments of every ``toile`` that the target calls, without those that make scenes."""
    dry = ("make", "-n", "-o", "setup", "-o", "nowhere/.ready", "ablations", "VENV=nowhere", *settings)
    text = subprocess.run(dry, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    found = re.findall(r"nowhere/bin/toile ((?:\\\n|[^;\n|])*)", text)
    lines = [[a.strip('"') for a in line.replace("\\\n", " ").split()] for line in found]
    return [arguments for arguments in lines if arguments[0] != "generate"]


def test_the_default_recipe_is_fitted_with_every_seed() -> None:
    recording, generated, tables = commands()
    assert {"optimization=tracking", "scene=R1", "seed=0,1,2"} <= set(recording)
    assert {"optimization=tracking", "seed=0", "scene.n_frames=25"} <= set(generated)
    assert {"outputs/ablations/tracking", "name=ablations_tracking"} <= set(tables)
    assert not any(a.startswith("seeds=") for a in tables)


@pytest.mark.parametrize(
    ("settings", "experiment", "name"),
    [
        ((), "paper_network_short", "ablations_paper"),
        (("PROTOCOL=whole",), "paper_network", "ablations_paper_whole"),
    ],
)
def test_the_papers_recipe_is_fitted_once_and_measured_with_every_seed(
    settings: tuple[str, ...], experiment: str, name: str
) -> None:
    *fits, tables = commands("RECIPE=paper", *settings)
    assert len(fits) == 2
    for arguments in fits:
        assert {f"experiment={experiment}", f"ablation={PAPER}", "seed=0"} <= set(arguments)
        # Arguments win over the settings of an ablation: nothing of the optimisation may be one.
        assert not any(a.startswith(("optimization", "scene.n_frames", "loss")) for a in arguments)
        (folder,) = (a.partition("=")[2] for a in arguments if a.startswith("hydra.sweep.dir="))
        assert folder in tables
    assert {f"name={name}", "seeds=[0,1,2]", "published=[R3,R4,R5,R7,R8,R9]"} <= set(tables)


def test_every_cell_of_the_target_can_be_configured() -> None:
    register_resolvers()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        for ablation in PAPER.split(","):
            overrides = ["scene=R1", "experiment=paper_network_short", f"ablation={ablation}"]
            assert compose("fit", overrides).ablation == ablation
