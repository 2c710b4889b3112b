"""Networks on disk: loaded safely, with the subject, garment and graph that they were trained for."""

from __future__ import annotations

import hashlib
import io
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import torch
from torch import Tensor, nn

from toile.atomic_file import written_atomically
from toile.capture.baselines.one_piece import OnePieceDeformation
from toile.capture.body.subject import Subject
from toile.capture.deformation.deform import Deformation
from toile.capture.deformation.graph import embedded_graph, fabric_rigidity
from toile.capture.garments.garment import Garment
from toile.capture.networks.backbone import BackboneSettings
from toile.capture.networks.pose_net import PoseNet
from toile.capture.networks.sim_net import SimNet
from toile.errors import InputError
from toile.limits import Count

_Thing = TypeVar("_Thing", Subject, Garment)

FORMAT = "toile-capture-1"
"""Raised whenever inputs, outputs or units of the networks change their meaning."""

_EXPECTED = "a file weights.pt of toile capture pose, warm, physics or adapt"
_KEYS = ("format", "settings", "subject", "garment", "pose_net", "sim_net", "description")


@dataclass(frozen=True)
class NetworkSettings:
    """Sizes of what is trained.

    Attributes:
        backbone: of both networks.
        nodes: K, of the garment's embedded graph; None: as many as the garment has vertices. A coarser graph
            cannot follow a garment in balance, see docs/capture.md.
        one_piece: whether body and garment are one mesh with one graph of K nodes, as in DeepCap.
    """

    backbone: BackboneSettings = field(default_factory=BackboneSettings)
    nodes: Count | None = None
    one_piece: bool = False

    def __post_init__(self) -> None:
        if self.one_piece and self.nodes is None:
            raise InputError(
                "A graph of body and garment in one piece has no number of nodes of its own",
                where="networks.nodes",
                expected="a number",
                got="null",
            )


@dataclass
class Networks:
    """Both networks and what they belong to.

    Attributes:
        settings: see NetworkSettings.
        deformation: f of the subject and the garment.
        pose_net: PoseNet.
        sim_net: SimNet, or None as long as it has not been trained.
        garment: worn by the subject.
        description: how the weights were made.
    """

    settings: NetworkSettings
    deformation: Deformation
    pose_net: PoseNet
    sim_net: SimNet | None
    garment: Garment
    description: Mapping[str, str] = field(default_factory=dict)

    @property
    def subject(self) -> Subject:
        """Whose networks they are."""
        return self.deformation.subject

    @staticmethod
    def new(
        subject: Subject,
        garment: Garment,
        settings: NetworkSettings,
        seed: int,
        *,
        with_sim_net: bool = False,
    ) -> Networks:
        """Untrained networks; the same seed gives the same ones.

        Raises:
            InputError: more nodes than the garment has vertices, or another setting that does not fit.
        """
        nodes = len(garment.rest_vertices) if settings.nodes is None else settings.nodes
        if settings.one_piece:
            deformation: Deformation = OnePieceDeformation(subject, garment, nodes)
        else:
            graph = embedded_graph(
                garment.rest_vertices, garment.faces, nodes, fabric_rigidity(garment.material)
            )
            deformation = Deformation(subject, garment, graph)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            limits = subject.joint_limits[deformation.driven]
            pose_net = PoseNet(settings.backbone, limits)
            sim_net = SimNet(settings.backbone, nodes) if with_sim_net else None
        return Networks(settings, deformation, pose_net, sim_net, garment)

    def resized(self, settings: NetworkSettings, where: str) -> Networks:
        """The same PoseNet with a garment of another graph, whose SimNet is still to come.

        Args:
            settings: their backbone is that of these networks.
            where: these weights are, for the message.

        Raises:
            InputError: another backbone.
        """
        if settings.backbone != self.settings.backbone:
            raise InputError(
                "Networks have another size",
                where=where,
                expected=str(settings.backbone),
                got=str(self.settings.backbone),
            )
        new = Networks.new(self.subject, self.garment, settings, 0)
        return replace(new, pose_net=self.pose_net, description=self.description)

    def with_sim_net(self) -> Networks:
        """The same with a SimNet that leaves the garment posed only; its backbone begins as PoseNet's.

        What one network has learned to see in a person helps the other; ours, not in the paper.
        """
        # Nothing of it is random: the backbone is a copy, the last layer is zero.
        graph = self.deformation.garment_mesh.graph
        assert graph is not None
        sim_net = SimNet(self.settings.backbone, len(graph))
        sim_net.backbone.load_state_dict(self.pose_net.backbone.state_dict())
        return replace(self, sim_net=sim_net)

    def save(self, path: Path | str, description: Mapping[str, str], *, half: bool = False) -> Path:
        """Write everything atomically; the same networks give the same bytes.

        Args:
            path: file to write.
            description: how they were made: command, seed, data ...
            half: in half precision and compressed, e.g. to be shipped; loaded, they are float32 again.
        """

        def stored(network: nn.Module | None) -> dict[str, Tensor] | None:
            if network is None:
                return None
            weights = {k: v.detach().cpu().contiguous() for k, v in network.state_dict().items()}
            return {k: v.half() if half else v for k, v in weights.items()}

        content = {
            "format": FORMAT,
            "settings": asdict(self.settings),
            "subject": _bytes_of(self.subject),
            "garment": _bytes_of(self.garment),
            "pose_net": stored(self.pose_net),
            "sim_net": stored(self.sim_net),
            "description": {str(k): str(v) for k, v in description.items()},
        }
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        # Given a path, torch would write the temporary file's name into the file.
        with written_atomically(path) as temporary, temporary.open("wb") as file:
            if not half:
                torch.save(content, file)
            else:
                whole = io.BytesIO()
                torch.save(content, whole)
                _compress(whole, file)
        return path

    def check_belongs(self, subject: Subject, garment: Garment, where: str) -> None:
        """Refuse another subject or garment than those of these networks.

        Args:
            subject: of the data.
            garment: of the data.
            where: the data are.

        Raises:
            InputError: it is another one.
        """
        for name, own, other in (
            ("subject", self.subject.rest_vertices, subject.rest_vertices),
            ("garment", self.garment.rest_vertices, garment.rest_vertices),
        ):
            if own.shape != other.shape or not torch.allclose(own, other, atol=1e-6):
                raise InputError(
                    f"Networks belong to another {name}",
                    where=where,
                    expected=f"the {name} that they were trained for, of {len(own)} vertices",
                    got=f"one of {len(other)} vertices",
                )


def shipped_weights() -> Path:
    """The weights of the demo, which come with the package."""
    return Path(str(resources.files("toile.capture.networks") / "demo.pt"))


def load_networks(path: Path | str | None = None, deformation: Deformation | None = None) -> Networks:
    """Networks of a file, those of the package if no path is given; nothing in it is executed.

    Args:
        path: of the file.
        deformation: f that SimNet was trained with, where it is not the one of ``Networks.new``.

    Raises:
        InputError: there is no such file, or it holds something else, or does not fit together.
    """
    path = shipped_weights() if path is None else Path(path)
    content = _read(path)
    try:
        given = content["settings"]
        settings = NetworkSettings(
            BackboneSettings(**given["backbone"]),
            None if given["nodes"] is None else int(given["nodes"]),
            bool(given.get("one_piece", False)),
        )
        subject = _from_bytes(content["subject"], Subject)
        garment = _from_bytes(content["garment"], Garment)
        networks = Networks.new(subject, garment, settings, 0, with_sim_net=content["sim_net"] is not None)
    except InputError as error:
        raise _unusable(path, str(error)) from error
    except (TypeError, KeyError, ValueError, AttributeError) as error:
        raise _unusable(path, f"{type(error).__name__}: {error}") from error
    for name in ("pose_net", "sim_net"):
        network: nn.Module | None = getattr(networks, name)
        if network is not None:
            _fill(network, content[name], path, name)
    description = {str(k): str(v) for k, v in dict(content["description"]).items()}
    networks = replace(networks, description=description)
    return networks if deformation is None else replace(networks, deformation=deformation)


def weights_digest(path: Path) -> str:
    """Short name of a file's content."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _compress(whole: BinaryIO, file: BinaryIO) -> None:
    """A file of torch.save is a zip of what is not compressed; torch.load reads one that is."""
    with (
        zipfile.ZipFile(whole) as old,
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as new,
    ):
        for entry in old.infolist():
            # The day of writing is left out: the same networks give the same bytes.
            plain = zipfile.ZipInfo(entry.filename)
            plain.compress_type = zipfile.ZIP_DEFLATED
            new.writestr(plain, old.read(entry.filename))


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputError("No weights", where=str(path), expected=_EXPECTED, got="no such file")
    try:
        content: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        first = str(error).strip().partition("\n")[0][:120]
        raise _unusable(path, f"{type(error).__name__}: {first}") from error
    if not isinstance(content, dict):
        raise _unusable(path, f"a {type(content).__name__}")
    missing = [key for key in _KEYS if key not in content]
    if missing:
        raise _unusable(path, f"nothing under {', '.join(missing)}")
    if content["format"] != FORMAT:
        raise _unusable(path, f"format {content['format']} instead of {FORMAT}")
    return content


def _fill(network: nn.Module, weights: Any, path: Path, name: str) -> None:
    if not isinstance(weights, dict):
        raise _unusable(path, f"a {type(weights).__name__} under {name}")
    here = {k: tuple(v.shape) for k, v in network.state_dict().items()}
    there = {str(k): tuple(v.shape) for k, v in weights.items() if isinstance(v, Tensor)}
    for key in sorted(here.keys() | there.keys()):
        if here.get(key) != there.get(key):
            found = f"{name}.{key} of shape {there.get(key)} instead of {here.get(key)}"
            raise _unusable(path, found)
    if not all(bool(torch.isfinite(v).all()) for v in weights.values()):
        raise _unusable(path, f"weights of {name} that are not finite")
    network.load_state_dict({k: v.float() for k, v in weights.items()})


def _bytes_of(thing: Subject | Garment) -> Tensor:
    with tempfile.TemporaryDirectory() as folder:
        content = thing.save(Path(folder) / "thing.npz").read_bytes()
    return torch.frombuffer(bytearray(content), dtype=torch.uint8)


def _from_bytes(content: Any, kind: type[_Thing]) -> _Thing:
    if not isinstance(content, Tensor) or content.dtype != torch.uint8:
        raise ValueError(f"no {kind.__name__.lower()}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{kind.__name__.lower()}.npz"
        path.write_bytes(content.numpy().tobytes())
        return kind.load(path)


def _unusable(path: Path, got: str) -> InputError:
    return InputError("Weights cannot be used", where=str(path), expected=_EXPECTED, got=got)
