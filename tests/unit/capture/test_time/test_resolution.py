"""Final collision resolution, measured by libigl, which shares nothing with what resolves."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toile.capture.body.subject import Subject, load_subject
from toile.capture.garments import Garment, make_skirt
from toile.capture.test_time.resolution import CollisionResolution
from toile.errors import InputError
from toile.evaluation.penetration import Penetration, penetration


@pytest.fixture(scope="module")
def subject() -> Subject:
    return load_subject()


@pytest.fixture(scope="module")
def skirt(subject: Subject) -> Garment:
    return make_skirt(subject, vertices=450)


@pytest.fixture(scope="module")
def resolution(subject: Subject, skirt: Garment) -> CollisionResolution:
    return CollisionResolution(skirt, subject)


def measured(skirt: Garment, subject: Subject, positions: np.ndarray) -> Penetration:
    return penetration(
        positions,
        skirt.faces.numpy(),
        subject.rest_vertices.numpy()[None],
        subject.faces.numpy(),
        held=skirt.attached.numpy(),
        inactive=subject.parts["arms"].numpy(),
    )


def test_nothing_moves_where_nothing_touches(
    subject: Subject, skirt: Garment, resolution: CollisionResolution
) -> None:
    rest = skirt.rest_vertices.numpy()[None]
    found = resolution(rest, subject.rest_vertices.numpy()[None])
    assert float(np.abs(found.positions - rest).max()) < 1e-9


def test_skirt_pulled_into_the_body_comes_out_and_the_hem_stays(
    subject: Subject, skirt: Garment, resolution: CollisionResolution
) -> None:
    rest = skirt.rest_vertices.numpy()
    middle = rest[:, [0, 2]].mean(0)
    high = rest[:, 1].max()
    # 5 cm narrower over the hips, within 30 cm below the waist.
    narrower = np.clip(1.5 - np.abs(high - 0.12 - rest[:, 1]) / 0.1, 0, 1)[:, None] * 0.05
    radius = np.linalg.norm(rest[:, [0, 2]] - middle, axis=1, keepdims=True)
    start = rest.copy()
    start[:, [0, 2]] -= narrower * (rest[:, [0, 2]] - middle) / radius
    before = measured(skirt, subject, start[None])
    assert before.maximum > 0.02
    assert before.body_maximum > 0.005
    found = resolution(start[None], subject.rest_vertices.numpy()[None])
    after = measured(skirt, subject, found.positions)
    assert after.maximum == 0.0
    assert after.body_maximum < 1e-4
    assert float(found.left.max()) < 1e-3
    low = rest[:, 1] < high - 0.42
    assert float(np.abs(found.positions[0, low] - start[low]).max()) < 2e-3
    # Nothing is moved farther than it had been pulled in, with the distance that is kept.
    moved = np.linalg.norm(found.positions[0] - start, axis=1)
    assert float(moved.max()) < 0.08
    attached = skirt.attached.numpy()
    np.testing.assert_allclose(found.positions[0, attached], rest[attached], atol=1e-9)


def test_frames_are_independent(subject: Subject, skirt: Garment, resolution: CollisionResolution) -> None:
    rest, body = skirt.rest_vertices.numpy(), subject.rest_vertices.numpy()
    pulled = rest + np.array([0.0, 0.0, 0.03])
    both = resolution(np.stack((rest, pulled)), np.stack((body, body))).positions
    alone = resolution(pulled[None], body[None]).positions
    np.testing.assert_array_equal(both[1], alone[0])


def test_what_does_not_fit_is_refused(subject: Subject, resolution: CollisionResolution) -> None:
    body = subject.rest_vertices.numpy()[None]
    with pytest.raises(InputError, match="positions"):
        resolution(np.zeros((1, 3, 3)), body)
    bad = torch.full((1, resolution.n_vertices, 3), torch.nan).numpy()
    with pytest.raises(InputError, match="not finite"):
        resolution(bad, body)
