"""Regularisers of embedded graphs (Li et al. 2021, Eq. 3: L_reg)."""

from __future__ import annotations

from torch import Tensor

from toile.capture.deformation.graph import EmbeddedGraph, node_rotations


def rigidity_loss(graph: EmbeddedGraph, A: Tensor, T: Tensor) -> Tensor:
    """L_reg = Σ_k Σ_{l∈N(k)} u_kl ‖R_k (g_l - g_k) + g_k + t_k - (g_l + t_l)‖², mean over frames.

    As rigid as possible: every node should see its neighbours where its own motion takes them (Sorkine and
    Alexa 2007; Sumner et al. 2007), with rigidity weights u (Habermann et al., DeepCap, CVPR 2020).

    Args:
        graph: of the mesh.
        A: Euler angles (B, K, 3) [rad].
        T: translations (B, K, 3) [m].

    Returns:
        Scalar [m²].
    """
    g, R = graph.positions.to(A), node_rotations(A)
    u = graph.rigidity.to(A)
    first, second = graph.edges.to(A.device).unbind(1)
    total = A.new_zeros(())
    for k, other in ((first, second), (second, first)):
        between = g[other] - g[k]
        seen = (R[:, k] @ between[..., None])[..., 0] + T[:, k]
        total = total + (u * (seen - between - T[:, other]).square().sum(-1)).sum(-1).mean()
    return total


def rotation_loss(graph: EmbeddedGraph, A: Tensor) -> Tensor:
    """Σ_{(k,l)} u_kl ½‖R_k - R_l‖²: neighbours turn alike; mean over frames. Ours, not in the paper.

    For small angles it is the square of the angle between the two. Differences of the Euler angles themselves
    would punish a node for being turned by 2π more than its neighbour, which is no turn at all.

    Args:
        graph: of the mesh.
        A: Euler angles (B, K, 3) [rad].

    Returns:
        Scalar [rad²].
    """
    R = node_rotations(A)
    first, second = graph.edges.to(A.device).unbind(1)
    apart = (R[:, first] - R[:, second]).square().sum((-2, -1)) / 2
    return (graph.rigidity.to(A) * apart).sum(-1).mean()
