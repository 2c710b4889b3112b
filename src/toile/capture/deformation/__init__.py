"""Deformation model f(θ, α, A, T): embedded graphs, then dual-quaternion skinning (Li et al. 2021, Eq. 2)."""
