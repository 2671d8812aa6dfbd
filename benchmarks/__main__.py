"""Run all benchmarks, or those named: ``python -m benchmarks [NAME ...] [--quick] [--json DIR]``.

Each runs in a process of its own, so that one's memory and compiled programs are not another's.
"""

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

NAMES = ("throughput", "filters", "gradient", "compile_time", "commands", "scaling", "gpu")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmarks one after the other; the exit code is the last failure's, or 0."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Run the benchmarks.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}")
    parser.add_argument("--quick", action="store_true", help="smaller problems, in seconds")
    parser.add_argument("--json", type=Path, metavar="DIR", help="write NAME.json in this folder")
    parser.add_argument("--before", metavar="JAXNAV", help="commands: beside another version")
    args = parser.parse_args(argv)
    unknown = [name for name in args.names if name not in NAMES]
    if unknown:
        parser.error(f"no benchmark is called {unknown[0]}; there are {', '.join(NAMES)}")
    if args.json is not None:
        args.json.mkdir(parents=True, exist_ok=True)
    failed = 0
    for name in args.names or NAMES:
        command = [sys.executable, str(Path(__file__).with_name(f"{name}.py"))]
        command += ["--quick"] if args.quick else []
        command += ["--json", str(args.json / f"{name}.json")] if args.json is not None else []
        if args.before is not None and name == "commands":
            command += ["--before", args.before]
        failed = subprocess.run(command).returncode or failed
    return failed


if __name__ == "__main__":
    sys.exit(main())
