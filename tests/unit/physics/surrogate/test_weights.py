"""Weights on disk: what is written is read, and nothing else is."""

import pytest
import torch

from toile.errors import InputError
from toile.physics.surrogate.surrogate import Surrogate
from toile.physics.surrogate.weights import describe_weights, load_weights, packaged_weights, save_weights


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "surrogate.pt"
    save_weights(path, Surrogate((4, 8)), {"command": "toile train"})
    return path


def changed(path, **changes):
    content = torch.load(path, weights_only=True)
    torch.save({**content, **changes}, path)


def test_round_trip(path):
    with torch.random.fork_rng():
        torch.manual_seed(1)
        surrogate = Surrogate((4, 8))
    save_weights(path, surrogate, {"seed": 1})
    loaded = load_weights(path)
    for name, tensor in surrogate.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor)
    assert not any(p.requires_grad for p in loaded.parameters())
    assert describe_weights(path) == {"seed": "1"}
    assert list(path.parent.iterdir()) == [path]


def test_equal_weights_are_equal_files(tmp_path):
    surrogate, files = Surrogate((4, 8)), [tmp_path / "one.pt", tmp_path / "two.pt"]
    for file in files:
        save_weights(file, surrogate, {"command": "toile train"})
    assert files[0].read_bytes() == files[1].read_bytes()


def test_the_package_has_weights():
    assert packaged_weights().is_file()
    assert packaged_weights().stat().st_size < 5e6
    assert load_weights().network.n_parameters <= 1e6
    assert "command" in describe_weights()


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        load_weights(tmp_path / "nothing.pt")


def test_something_else(path):
    path.write_bytes(b"not weights")
    with pytest.raises(InputError, match="unusable weights"):
        load_weights(path)
    torch.save({"weights": {}}, path)
    with pytest.raises(InputError, match="without a format"):
        load_weights(path)


def test_pickled_code_is_not_run(path):
    torch.save({"format": Surrogate((4,))}, path)
    with pytest.raises(InputError, match="unusable weights"):
        load_weights(path)


def test_half_a_file(path):
    content = torch.load(path, weights_only=True)
    del content["widths"]
    torch.save(content, path)
    with pytest.raises(InputError, match="without widths"):
        load_weights(path)


@pytest.mark.parametrize("key", ["format", "units"])
def test_other_format_or_units(path, key):
    changed(path, **{key: "another"})
    with pytest.raises(InputError, match=f"{key}: .*\n  got:      another"):
        load_weights(path)


def test_weights_of_another_architecture(path):
    changed(path, widths=[4, 16])
    with pytest.raises(InputError, match=r"network\.\S+ of shape"):
        load_weights(path)
