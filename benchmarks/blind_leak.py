"""What the files of graded (or development) blind sets tell a classifier about their labels.

python benchmarks/blind_leak.py standard [standard2 ...]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from toile.blind.leak import leaks_of
from toile.blind.sealing import BlindSet, SealKey


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="+", help="of the sets, which are taken together")
    parser.add_argument("--outputs", type=Path, default=Path("outputs"))
    parser.add_argument("--permutations", type=int, default=1000)
    given = parser.parse_args()
    sets = [
        (
            BlindSet(given.outputs / "blind" / name),
            SealKey.read(given.outputs / "blind_keys" / f"{name}.blindkey"),
        )
        for name in given.names
    ]
    table = leaks_of(sets, permutations=given.permutations)
    print(table.to_markdown(index=False, floatfmt=".3f"))


if __name__ == "__main__":
    main()
