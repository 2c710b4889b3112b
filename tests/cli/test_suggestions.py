"""What a user may have meant: in the one message, with exit status 2."""

from __future__ import annotations

import pytest


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (("fti",), "'fit'"),
        (("eval", "run=x"), "'evaluate'"),
        (("complete",), "'completion'"),
        (("fit", "scnee=R1"), "Did you mean scene?"),
        (("fit", "scnee=R1", "sede=1"), "Did you mean scene?"),
        (("fit", "scene=R1", "optimisation=adam"), "Did you mean optimization?"),
        (("fit", "scene=R1", "simulator/intergrator=bdf2"), "Did you mean simulator/integrator?"),
        (
            ("fit", "scene=R1", "optimization.stages.track.priors.turbulance=3"),
            "Did you mean optimization.stages.track.priors.turbulence?",
        ),
        (
            ("fit", "scene=R1", "optimisation.stages.trck.priors.turbulence=3"),
            "Did you mean optimization.stages.track.priors.turbulence?",
        ),
        (("fit", "scene=R1", "areal_density=0.2"), "Did you mean cloth.areal_density?"),
        (("fit", "scene=R1", "optimization=traking"), "Did you mean optimization=tracking?"),
        (("fit", "scene=R1", "optimization=tracking", "effect=air_drg"), "Did you mean effect=air_drag?"),
        (("diagnose", "scene=R1", "effect@candidates=[gusts,air_drg]"), "Did you mean air_drag?"),
        (("fit", "-m", "scene=R1", "optimization=traking,adam"), "Did you mean optimization=tracking?"),
        (("masks", "video=x", "scene=y", "methd=grabcut"), "Did you mean method?"),
        (("doctor", "scene=R1", "--cfg", "job", "scene.n_frmes=3"), "Did you mean scene.n_frames?"),
        (("fit", "--help", "sede=3"), "Did you mean seed?"),
    ],
)
def test_what_was_meant(toile, arguments, meant) -> None:
    status, out, err = toile(*arguments)
    assert (status, out) == (2, "")
    assert meant in err
    assert err.count("error:") == 1
    assert err.lower().count("did you mean") == 1


@pytest.mark.parametrize("arguments", [("xyzzy",), ("doctor", "scene=R1", "xyzzy=3"), ("fit", "loss=xyzzy")])
def test_nothing_is_close(toile, arguments) -> None:
    status, _, err = toile(*arguments)
    assert status == 2
    assert "xyzzy" in err
    assert "did you mean" not in err.lower()


def test_choices_of_the_users_own_folder(toile, tmp_path) -> None:
    (tmp_path / "mine" / "loss").mkdir(parents=True)
    (tmp_path / "mine" / "loss" / "homemade.yaml").write_text("{}\n")
    _, _, err = toile("fit", "--config-dir", "mine", "scene=R1", "loss=homemad")
    assert "Did you mean loss=homemade?" in err


def test_choices_of_a_list_are_named(toile) -> None:
    """Hydra says no more there than that it could not load one."""
    status, out, err = toile("diagnose", "scene=R1", "effect@candidates=[typo]")
    assert (status, out) == (2, "")
    assert "Available options in 'effect':" in err
    assert "\tair_drag\n" in err
    assert "did you mean" not in err.lower()
