"""Losses of the two networks (Li et al. 2021, Eqs. 4 to 8), one per file.

Each sums over what its equation sums over and takes the mean over the B frames of a batch; gradients reach
predictions only, never what they are compared with, unless said otherwise.
"""
