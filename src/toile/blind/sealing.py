"""Sealed labels: encrypted from the moment they are made, opened only by who has the key.

A set is a folder::

    set.json                what everybody may know
    scenes/<name>/          native layout without truth; of a session a folder of such, with session.yaml
    extended/<name>/        sessions with the clip that their diagnosis has asked for
    sealed/<name>.sealed    label, nonce, true vertices, twin without the effect; encrypted
    commitments.json        sha256(label bytes + nonce bytes) per scene
    opened.json             hash of the predictions that were graded; from then on the set is spent

The key is a file of its own outside this folder. ``make`` writes it, ``grade`` reads it, ``run`` never gets
it: file permissions would not keep anything from a process that runs as root.

Encryption: a keystream from SHAKE-256 over key and a fresh nonce, then HMAC-SHA-256 over nonce and text (both
from the standard library). Key and nonce are 32 random bytes, so no keystream serves twice.
"""

from __future__ import annotations

import hashlib
import hmac
import io
import json
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toile.atomic_file import write_text, written_atomically
from toile.errors import InputError
from toile.former_names import GENERATORS, SET_KEYS, renamed
from toile.json_file import read_json_object
from toile.scenes.session import SESSION_FILE

# Keys of set.json that anything depends on.
_DESCRIBED = {"composition": str, "out_of_family": dict, "blind": bool, "key": str, "scenes": list}
SCHEME = "sha256(label bytes + nonce bytes)"
KEY_SUFFIX = ".blindkey"
_KEY_HEADER = "toile blind key "
_SIZE = 32

Array = NDArray[np.float32]


class SealKey:
    """The secret of a set.

    Args:
        secret: 32 bytes.
    """

    def __init__(self, secret: bytes) -> None:
        if len(secret) != _SIZE:
            raise ValueError(f"expected {_SIZE} bytes, got {len(secret)}")
        self._secret = secret

    @classmethod
    def fresh(cls) -> SealKey:
        """A key that nobody can guess."""
        return cls(secrets.token_bytes(_SIZE))

    @classmethod
    def of_seed(cls, seed: int) -> SealKey:
        """A key that anybody can make again: for tests and development, not for a blind check."""
        return cls(hashlib.sha256(f"toile blind seed {seed}".encode()).digest())

    @classmethod
    def read(cls, path: Path) -> SealKey:
        """Read a key file.

        Raises:
            InputError: there is none, or it holds no key.
        """
        try:
            text = path.read_text()
            return cls(bytes.fromhex(text.removeprefix(_KEY_HEADER).strip()))
        except (OSError, ValueError) as error:
            raise InputError(
                "No key can be read",
                where=str(path),
                expected="the key file that toile blind make has written",
                got=f"{type(error).__name__}: {error}",
            ) from error

    def write(self, path: Path) -> Path:
        """Write the key file, readable for its owner only."""
        write_text(path, f"{_KEY_HEADER}{self._secret.hex()}\n")
        path.chmod(0o600)
        return path

    def derive(self, purpose: str) -> bytes:
        """32 bytes for one purpose; they tell nothing about the key."""
        return hmac.new(self._secret, purpose.encode(), hashlib.sha256).digest()

    @property
    def fingerprint(self) -> str:
        """By which a set knows its key."""
        return self.derive("fingerprint").hex()

    def seal(self, text: bytes) -> bytes:
        """Encrypt and authenticate."""
        nonce = secrets.token_bytes(_SIZE)
        sealed = nonce + self._mixed(text, nonce)
        return hmac.new(self.derive("authentication"), sealed, hashlib.sha256).digest() + sealed

    def open(self, sealed: bytes) -> bytes:
        """Check and decrypt.

        Raises:
            InputError: another key, or a changed file.
        """
        tag, rest = sealed[:_SIZE], sealed[_SIZE:]
        if not hmac.compare_digest(
            tag, hmac.new(self.derive("authentication"), rest, hashlib.sha256).digest()
        ):
            raise InputError(
                "A sealed label cannot be opened",
                where="sealed/",
                expected="the key of this set, and files that nobody has changed",
                got="another authentication code",
            )
        return self._mixed(rest[_SIZE:], rest[:_SIZE])

    def _mixed(self, text: bytes, nonce: bytes) -> bytes:
        stream = hashlib.shake_256(self.derive("encryption") + nonce).digest(len(text))
        mixed = np.frombuffer(text, np.uint8) ^ np.frombuffer(stream, np.uint8)
        return mixed.tobytes()


@dataclass(frozen=True)
class Sealed:
    """What is known of a scene once its label is open.

    Attributes:
        label: JSON values.
        vertices: true positions (F, H, W, 3) [m], float32.
        twin: the same clip without its effects, (F, H, W, 3) [m], float32.
    """

    label: dict[str, Any]
    vertices: Array
    twin: Array


def is_key_file(path: Path) -> bool:
    """Whether a file is a key, by its name or by what it holds."""
    if path.name.endswith(KEY_SUFFIX):
        return True
    if not path.is_file() or path.stat().st_size > 1024:
        return False
    return path.read_bytes().startswith(_KEY_HEADER.encode())


@dataclass(frozen=True)
class BlindSet:
    """Places in a set.

    Attributes:
        folder: of the set.
        part: folder within it that the scenes are in: sessions with one clip more have one of their own.
    """

    folder: Path
    part: str = "scenes"

    @property
    def description(self) -> Path:
        """What everybody may know."""
        return self.folder / "set.json"

    @property
    def scenes(self) -> Path:
        """Folder of the scenes or sessions."""
        return self.folder / self.part

    @property
    def sealed(self) -> Path:
        """Folder of the sealed labels."""
        return self.folder / "sealed"

    @property
    def commitments(self) -> Path:
        """Hashes of the labels."""
        return self.folder / "commitments.json"

    @property
    def spent(self) -> Path:
        """Which predictions the labels were opened for; not there before."""
        return self.folder / "opened.json"

    def sealed_file(self, name: str) -> Path:
        """Sealed label of one scene."""
        return self.sealed / f"{name}.sealed"

    def names(self) -> tuple[str, ...]:
        """Names of the scenes that the set shall have.

        Raises:
            InputError: this is no set.
        """
        return tuple(self.read_description()["scenes"])

    def read_description(self) -> dict[str, Any]:
        """Contents of set.json.

        Raises:
            InputError: this is no set.
        """
        try:
            values = renamed(read_json_object(self.description), SET_KEYS)
            missing = [key for key in _DESCRIBED if not isinstance(values.get(key), _DESCRIBED[key])]
            if missing:
                raise ValueError(f"nothing usable under {', '.join(missing)}")
            # A name becomes a path.
            if not all(isinstance(n, str) and n and n == Path(n).name for n in values["scenes"]):
                raise ValueError("scenes with other than plain names")
        except (OSError, ValueError) as error:
            raise InputError(
                "No blind set",
                where=str(self.folder),
                expected="a folder that toile blind make has written",
                got=f"{type(error).__name__}: {error}",
            ) from error
        return values

    def is_made(self, name: str) -> bool:
        """Whether scene and label are there."""
        return self.is_there(name) and self.sealed_file(name).is_file()

    def is_there(self, name: str) -> bool:
        """Whether a scene or session is there."""
        return any((self.scenes / name / file).is_file() for file in ("scene.json", SESSION_FILE))

    def seal(self, key: SealKey, name: str, sealed: Sealed) -> Path:
        """Write the sealed label of a scene; nothing of it is on disk in the clear at any time."""
        label = json.dumps(sealed.label, sort_keys=True).encode()
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer,
            label=np.frombuffer(label, np.uint8),
            nonce=np.frombuffer(key.derive(f"nonce {name}"), np.uint8),
            vertices=sealed.vertices.astype(np.float32),
            twin=sealed.twin.astype(np.float32),
        )
        # Padded: a null compresses otherwise than a scene whose twin differs from it.
        data = buffer.getvalue()
        room = 2 * sealed.vertices.size * 4 + 64 * 1024
        padded = len(data).to_bytes(8, "big") + data.ljust(room, b"\0")
        path = self.sealed_file(name)
        with written_atomically(path) as temporary:
            temporary.write_bytes(key.seal(padded))
        return path

    def open(self, key: SealKey, name: str) -> Sealed:
        """Open one label and check it against its commitment.

        Raises:
            InputError: another key, a changed file, or a label that is not the one committed to.
        """
        label, nonce, arrays = self._open(key, name)
        committed = read_commitments(self.commitments)
        if committed.get(name) != commitment(label, nonce):
            raise InputError(
                f"The label of {name} is not the one that was committed to",
                where=str(self.commitments),
                expected=str(committed.get(name)),
                got=commitment(label, nonce),
            )
        described = json.loads(label)
        if "generator" in described:
            described["generator"] = GENERATORS.get(described["generator"], described["generator"])
        return Sealed(described, arrays["vertices"], arrays["twin"])

    def commit(self, key: SealKey, names: tuple[str, ...]) -> Path:
        """Write commitments.json from the sealed labels."""
        hashes = {}
        for name in names:
            label, nonce, _ = self._open(key, name)
            hashes[name] = commitment(label, nonce)
        values = {"scheme": SCHEME, "commitments": hashes}
        return write_text(self.commitments, json.dumps(values, indent=1) + "\n")

    def _open(self, key: SealKey, name: str) -> tuple[bytes, bytes, Mapping[str, Array]]:
        padded = key.open(self.sealed_file(name).read_bytes())
        length = int.from_bytes(padded[:8], "big")
        with np.load(io.BytesIO(padded[8 : 8 + length])) as arrays:
            values = {k: arrays[k] for k in arrays.files}
        return values["label"].tobytes(), values["nonce"].tobytes(), values


def commitment(label: bytes, nonce: bytes) -> str:
    """Salted hash of a label, see SCHEME."""
    return hashlib.sha256(label + nonce).hexdigest()


def read_commitments(path: Path) -> dict[str, str]:
    """Hashes by scene.

    Raises:
        InputError: there is no such file, or another scheme.
    """
    try:
        values = read_json_object(path)
    except (OSError, ValueError) as error:
        raise InputError(
            "No commitments", where=str(path), expected="commitments.json", got=str(error)
        ) from error
    if values.get("scheme") != SCHEME or not isinstance(values.get("commitments"), dict):
        raise InputError(
            "Unknown commitments", where=str(path), expected=SCHEME, got=str(values.get("scheme"))
        )
    return dict(values["commitments"])
