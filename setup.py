"""The packages of the wheel: those of src/, and conf/ of the repository as ``toile.conf``."""

from setuptools import find_packages, setup

setup(packages=[*find_packages("src"), "toile.conf"])
