"""What toile says to bad input: docs/robustness.md.

    python benchmarks/robustness.py                    # all cases, two at a time; what is known is kept
    python benchmarks/robustness.py --only nested      # those whose text holds a word; writes nothing
    python benchmarks/robustness.py --list

The cases are in benchmarks/bad_inputs. Works in outputs/robustness (or --work), where the folders of bad
cases stay. Exits with 1 if fewer than 95 % of the cases are good or warned.
"""

from __future__ import annotations

import toile.cli  # noqa: F401  # isort: skip  # first, because it sets the number of threads

import argparse
import sys
from pathlib import Path

from bad_inputs.cases import CASES
from bad_inputs.page import page, summary
from bad_inputs.running import Result, fingerprint, run_all

ROOT = Path(__file__).parents[1]
DOCUMENT = ROOT / "docs" / "robustness.md"
REQUIRED = 0.95


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", help="cases whose group or text holds this")
    parser.add_argument("--workers", type=int, default=2, help="cases at a time")
    parser.add_argument(
        "--work", type=Path, default=ROOT / "outputs" / "robustness", help="folder to work in"
    )
    parser.add_argument("--list", action="store_true", help="list the cases, run nothing")
    arguments = parser.parse_args()
    cases = [c for c in CASES if arguments.only.lower() in f"{c.group} {c.wrong} {c.arguments}".lower()]
    if arguments.list:
        print("\n".join(f"{case.group}: {case.wrong}" for case in cases))
        return 0
    code = fingerprint([ROOT / "src", ROOT / "conf", ROOT / "benchmarks" / "bad_inputs"])
    results = run_all(cases, arguments.work.resolve(), code, arguments.workers, _show)
    print(summary(results))
    if not arguments.only:
        from toile import __version__
        from toile.cli.machine import machine

        DOCUMENT.write_text(
            page(results, "{processor}, {processors} cores, {platform}".format(**machine()), __version__)
        )
        print(DOCUMENT.relative_to(ROOT))
    return int(sum(r.kind != "bad" for r in results) < REQUIRED * len(results))


def _show(result: Result) -> None:
    why = f" ({result.why})" if result.why else ""
    print(f"{result.kind:6} {result.seconds:6.1f} s  {result.group}: {result.wrong}{why}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
