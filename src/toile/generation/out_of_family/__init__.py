"""An out-of-family generator: what a fit meets and its model lacks, in forms that the catalogue has not.

The solver of the cloth is the package's own, on a finer grid and with smaller steps; every effect here has
another functional form than its namesake in ``toile.effects``, and some have no namesake at all.
"""
