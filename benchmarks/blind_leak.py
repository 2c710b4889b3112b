"""What the files of a graded (or development) blind set tell a classifier about its labels.

python benchmarks/blind_leak.py outputs/blind/standard outputs/blind_keys/standard.blindkey
"""

from __future__ import annotations

import argparse
from pathlib import Path

from toile.evaluation.blind_leak import leaks_of
from toile.evaluation.blind_sealing import BlindSet, SealKey


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", type=Path)
    parser.add_argument("key", type=Path)
    parser.add_argument("--permutations", type=int, default=1000)
    given = parser.parse_args()
    table = leaks_of(BlindSet(given.set), SealKey.read(given.key), permutations=given.permutations)
    print(table.to_markdown(index=False, floatfmt=".3f"))


if __name__ == "__main__":
    main()
