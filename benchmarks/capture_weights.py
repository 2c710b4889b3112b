"""The package's weights out of a training: `make capture-weights`, after make capture-demo.

python benchmarks/capture_weights.py [--weights outputs/capture/demo/seed0/physics/weights.pt]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from toile.capture.training.weights import load_networks, shipped_weights

MADE = "make capture-demo: preset demo, 8 clips of walk, twirl, squat and turn; half precision"
LARGEST = 10_000_000


def main() -> None:
    """Write them in half precision."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--weights", type=Path, default=Path("outputs/capture/demo/seed0/physics/weights.pt"))
    parser.add_argument("--output", type=Path, default=shipped_weights())
    given = parser.parse_args()
    networks = load_networks(given.weights)
    path = networks.save(given.output, {**networks.description, "made by": MADE}, half=True)
    size = path.stat().st_size
    if size > LARGEST:
        raise SystemExit(f"{path}: {size} bytes, more than the {LARGEST} that a package should have")
    print(f"{path}: {size} bytes")


if __name__ == "__main__":
    main()
